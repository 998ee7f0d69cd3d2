"""A link through real sockets as a service: real packets, real time, the same messages on the bus as any link."""

from __future__ import annotations

import sys
import time
from collections import Counter, deque
from contextlib import suppress
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.channel.real.books import accounted
from testbed.channel.real.fates import Fates
from testbed.channel.real.middle import middle_of, scheme_of
from testbed.channel.real.outstanding import Outstanding
from testbed.channel.real.pace import Arrays, Pace
from testbed.channel.real.path import Path
from testbed.channel.real.timer import Timer
from testbed.channel.timed import TimedBlock, room, timed_counters
from testbed.errors import RunFailed, TestbedError
from testbed.scenario.changes import changed
from testbed.scenario.links import AckLink, SteppedImpairments
from testbed.wire.keys import LinkName
from testbed.wire.messages import Change, Packet
from testbed.wire.node import ORCHESTRATOR, Node
from testbed.wire.setup import Setup

_PATIENCE = 0.8
"""Share of the run's deadline that the path may take to open, so that its own error comes first."""
_CHECK_NS = 500_000_000
_SWITCH_S = 0.0005
"""Threads of this process that handle packets take turns as often."""


class RealLinkService:
    """Sends each message over the path as it is, and hands on what arrives, block by block in the order of steps.

    A message whose deadline passes before it arrives is lost for its step: that is said then, and if it comes after
    all, it goes with the next step of its block; late control packets are dropped. The control link keeps the pace of
    the run, where the controller does not; the other links send at once.
    """

    def __init__(
        self, node: Node, setup: Setup, *, link: LinkName, model: type[Packet], sender: str, name: str
    ) -> None:
        """model, sender, name: type and source of the messages, and the name of their content."""
        scenario = setup.scenario
        settings: SteppedImpairments = getattr(scenario.links, link)
        self._node, self._name, self._first_step = node, name, model.FIRST_STEP
        self._deadline_ns = settings.deadline_ns(scenario.clock.period_ns)
        self._keeps_late = link != "control"
        self._settings, self._in_order = settings, scheme_of(settings) == "tcp"
        self._changes = scenario.changes_of(link)
        batch = settings.batch if isinstance(settings, AckLink) else 1
        keep = room(scenario.lanes, 8 * max(scenario.system.p, scenario.system.q), batch)
        self._fates = {lane: Fates(lanes) for lane, lanes in setup.blocks}
        self._blocks = {
            lane: TimedBlock(self._fates[lane], lanes, name, first_step=model.FIRST_STEP, keep=keep, batch=batch)
            for lane, lanes in setup.blocks
        }
        self._contents: dict[int, deque[NDArray[Any]]] = {lane: deque() for lane in self._blocks}
        """Of packets whose fate is not told yet."""
        self._lanes = max(lanes for _, lanes in setup.blocks)
        self._sent = 0
        self._newest = -1
        self._under_way: Outstanding[tuple[int, int, int]] = Outstanding()
        """By message: lane, number, place in the order of sending."""
        sys.setswitchinterval(_SWITCH_S)
        call = node.bus.call
        self._timer = node.leaving.enter_context(Timer(call))
        middle = middle_of(settings, scenario.seed, node.name)
        key = f"{node.keys.prefix}/{link}/path"
        arrived, failed = (lambda m: call(partial(self._arrived, m))), (lambda e: call(partial(_fail, e)))
        path = Path(middle, settings, key, arrived, failed, patience_s=_PATIENCE * setup.transport.deadline_ns * 1e-9)
        self._path = node.leaving.enter_context(path)
        self._deliver = node.sender(node.keys.delivered(link), model, tap=True)
        self._pace = Pace(node, self._timer, scenario.clock.period_ns, self._send)
        take = self._pace if link == "control" and not setup.real else self._send
        node.on(node.keys.sent(link), model, sender, take, needs=(name,))
        node.on(node.keys.change(link), Change, ORCHESTRATOR, self._note)
        self._check()

    @property
    def counters(self) -> dict[str, int]:
        total = Counter(timed_counters(list(self._blocks.values()), self._keeps_late))
        books: dict[str, dict[str, int]] = {}
        with suppress(TestbedError):  # the run has failed, and said why
            books = self._path.books()
        over = sum(fates.waiting_late for fates in self._fates.values())
        missing = total.pop("in_flight") - over
        in_flight = self._sent - 1 - self._newest if self._in_order else None
        refused = self._path.refused
        parts = accounted(missing, self._lanes, books.get("forward", {}), refused=refused, in_flight=in_flight)
        total["in_flight"] = over
        total.update(parts)
        total["dropped"] += sum(count for key, count in parts.items() if key.startswith("dropped_"))
        around = {"behind": self._pace.behind, "repeated": sum(fates.repeated for fates in self._fates.values())}
        around |= {f"{where}_{key}": count for where, counts in books.items() for key, count in counts.items()}
        return {**total, **{f"real_{key}": count for key, count in around.items()}}

    @property
    def gives_state(self) -> bool:
        """What is under way is in sockets, and cannot be given."""
        return False

    def _note(self, change: Change, _: dict[str, NDArray[Any]]) -> None:
        """Take an order to change from a step on that is still to come; the orchestrator has checked it."""
        self._changes.append((change.step, change.set))
        self._changes.sort(key=lambda entry: entry[0])

    def _send(self, packet: Packet, arrays: Arrays) -> None:
        self._change(packet.step)
        lane, number, message = packet.lane, self._fates[packet.lane].sent(), self._node.payload
        self._contents[lane].append(np.array(arrays[self._name]))
        self._under_way.add(message, (lane, number, self._sent))
        self._sent += 1
        self._path.send(message)
        self._timer.at(time.monotonic_ns() + self._deadline_ns, partial(self._give_up, lane, number))

    def _change(self, step: int) -> None:
        while self._changes and self._changes[0][0] <= step:
            self._settings = changed(self._settings, self._changes.pop(0)[1])
            self._path.change(self._settings)

    def _arrived(self, message: bytes) -> None:
        found = self._under_way.find(message)
        if found is None:
            self._node.rejected["foreign"] += 1
            return
        lane, number, place = found
        self._newest = max(self._newest, place)
        self._fates[lane].arrived(number)
        self._tell(lane)

    def _give_up(self, lane: int, number: int) -> None:
        self._fates[lane].give_up(number)
        self._tell(lane)

    def _tell(self, lane: int) -> None:
        fates, block, contents = self._fates[lane], self._blocks[lane], self._contents[lane]
        while fates.ready:
            number, content = fates.next, contents.popleft()
            if self._keeps_late:
                arrays = block.pass_on(number, content)
            else:
                arrived = block.in_time(number)
                arrays = {"mask": arrived.astype(np.uint8)}
                if arrived.any():
                    arrays = {self._name: content, **arrays}
            self._deliver(number + self._first_step, lane, len(content), arrays)

    def _check(self) -> None:
        """Whether what is between the ends still lives, now and then."""
        self._path.books()
        self._timer.at(time.monotonic_ns() + _CHECK_NS, self._check)


def _fail(error: TestbedError) -> None:
    raise error if isinstance(error, RunFailed) else RunFailed(str(error))
