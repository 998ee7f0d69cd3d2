"""A link as a service: takes what is published on its ``sent`` key and publishes what it delivers on ``delivered``."""

from __future__ import annotations

from collections import Counter
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.channel.carriers import carriers_of
from testbed.channel.instant import InstantBlock
from testbed.channel.packets import packet_bytes
from testbed.channel.processes import FateProcess, process_of
from testbed.channel.real.pace import Pace
from testbed.channel.real.service import RealLinkService
from testbed.channel.real.timer import Timer
from testbed.channel.steps import SteppedLink
from testbed.channel.timed import TimedBlock, blanked, room, timed_counters
from testbed.numerics.lanes import Mask, any_of
from testbed.numerics.streams import Stream
from testbed.scenario import AckLink, Link, Loss, NoLoss, Scenario
from testbed.scenario.backend import real_links
from testbed.scenario.changes import changed
from testbed.scenario.links import SteppedImpairments
from testbed.wire.keys import LinkName
from testbed.wire.messages import Acknowledgement, Change, Control, Observation, Packet
from testbed.wire.node import ORCHESTRATOR, Node, PacketHandler
from testbed.wire.setup import Setup
from testbed.wire.state import pack, unpack

_TYPES: dict[LinkName, tuple[type[Packet], str, str]] = {
    "control": (Control, "controller", "u"),
    "observation": (Observation, "plant", "y"),
    "ack": (Acknowledgement, "plant", "nu"),
}
"""Type, sender and content."""
FIRST_STEP: dict[LinkName, int] = {link: model.FIRST_STEP for link, (model, _, _) in _TYPES.items()}
"""The step of packet 0."""


def role_of(link: LinkName) -> str:
    return f"link.{link}"


def builder(link: LinkName) -> Any:
    """What builds the service of one link."""

    def build(node: Node, setup: Setup) -> LinkService | RealLinkService:
        if getattr(setup.scenario.links, link).is_real:
            model, sender, name = _TYPES[link]
            return RealLinkService(node, setup, link=link, model=model, sender=sender, name=name)
        return LinkService(node, setup, link=link)

    return build


def loss_of(scenario: Scenario, link: LinkName) -> Loss:
    """The loss of a link; that of an ACK link that is none or perfect loses nothing."""
    settings = getattr(scenario.links, link)
    loss: Loss = settings.loss if isinstance(settings, Link) or settings.mode == "link" else NoLoss()
    return loss


def loss_process(scenario: Scenario, link: LinkName, lane: int, lanes: int) -> FateProcess:
    """The loss process of a block of lanes of a link; the same draws wherever it runs."""
    return _process(scenario, link, loss_of(scenario, link), lane, lanes)


def _process(scenario: Scenario, link: LinkName, loss: Loss, lane: int, lanes: int) -> FateProcess:
    def stream(purpose: str) -> Stream:
        return Stream(scenario.seed, role_of(link), purpose, width=1, lane=lane, lanes=lanes)

    return process_of(loss, stream, lanes)


def timed_block(scenario: Scenario, link: LinkName, lane: int, lanes: int, size: int) -> TimedBlock:
    """A block of lanes of a link that takes time; size: bytes of a packet of one lane."""
    settings: SteppedImpairments = getattr(scenario.links, link)
    period_ns = scenario.clock.period_ns
    carriers = carriers_of(settings, scenario.seed, role_of(link), lane, lanes)
    stepped = SteppedLink(carriers, size, period_ns, settings.deadline_ns(period_ns))
    model, _, name = _TYPES[link]
    batch = settings.batch if isinstance(settings, AckLink) else 1
    keep = room(scenario.lanes, 8 * max(scenario.system.p, scenario.system.q), batch)
    return TimedBlock(stepped, lanes, name, first_step=model.FIRST_STEP, keep=keep, batch=batch)


class LinkService:
    """Emulates one link, lane by lane.

    A packet that arrives in some lanes is passed on with its mask and zeros elsewhere; one that arrives in none is
    passed on as a bare mask, which tells the receiver that the step is over (virtual time has no other way).
    What arrives late goes with the packet of the step in which it does; late control packets are dropped.
    Where the scenario says that noise is received in place of a lost observation, that stands there with mask 0.

    Its state, on a link that takes no time: the state of the loss process and the counts. On one that does: the
    contents under way, and the rest is worked out again from packet 0 on, since fates do not depend on contents; that
    takes as long as the link took with them, about 10 µs a packet and lane without a transport, 40 µs with tcp.
    """

    def __init__(self, node: Node, setup: Setup, *, link: LinkName) -> None:
        model, sender, self._content = _TYPES[link]
        scenario = setup.scenario
        self._node, self._first_step, self._lanes = node, model.FIRST_STEP, dict(setup.blocks)
        self._changes = scenario.changes_of(link)
        settings: SteppedImpairments = getattr(scenario.links, link)
        self._now = {lane: (0, settings) for lane, _ in setup.blocks}
        """By block of lanes: how many changes were made, and the link after them."""
        timed = scenario.takes_time(link)
        self._instant = {
            lane: InstantBlock(loss_process(scenario, link, lane, lanes), lanes)
            for lane, lanes in setup.blocks
            if not timed
        }
        self._process_of = partial(_process, scenario, link)
        size = packet_bytes(scenario, link)
        self._timed = {lane: timed_block(scenario, link, lane, lanes, size) for lane, lanes in setup.blocks if timed}
        self._keeps_late = link != "control"
        self._deliver = node.sender(node.keys.delivered(link), model, tap=True)
        noise = link == "observation" and scenario.links.observation.on_loss == "noise"
        self._instead = "noise" if noise else None
        needs = (self._content, self._instead) if self._instead else (self._content,)
        handler: PacketHandler[Packet] = self._pass_on_timed if timed else self._pass_on
        if link == "control" and real_links(scenario):
            handler = Pace(node, node.leaving.enter_context(Timer(node.bus.call)), scenario.clock.period_ns, handler)
        node.on(node.keys.sent(link), model, sender, handler, needs=needs)
        node.on(node.keys.change(link), Change, ORCHESTRATOR, self._note)

    @property
    def counters(self) -> dict[str, int]:
        if self._timed:
            return timed_counters(list(self._timed.values()), self._keeps_late)
        total: Counter[str] = Counter()
        for block in self._instant.values():
            total.update(block.counts.as_counters())
        cut = sum(block.cut for block in self._instant.values())
        causes = {"dropped_cut": cut, "dropped_loss": total["dropped"] - cut} if cut else {}
        return {**total, **causes}

    @property
    def gives_state(self) -> bool:
        return True

    def state(self, lane: int) -> bytes:
        made, block = self._now[lane][0], self._timed.get(lane)
        if block is not None:
            return pack(block.on_the_way(), step=block.packets, changes=made)
        arrays, numbers = self._instant[lane].state()
        return pack(arrays, step=self._instant[lane].packets, changes=made, **numbers)

    def resume(self, lane: int, step: int, state: bytes) -> None:
        """Raises UsageError for what is no state of this link after so many packets and changes."""
        given, lanes, block = unpack(state), self._lanes[lane], self._timed.get(lane)
        given.expect(step=step)
        if block is None:
            self._change(lane, lanes, self._first_step + step - 1)
            self._instant[lane].resume(given)
        else:
            for number in range(step):
                self._change(lane, lanes, self._first_step + number)
                if self._keeps_late:
                    block.again(number)
                else:
                    block.in_time(number)
            block.recall(given)
        given.expect(changes=self._now[lane][0])
        given.end()

    def _note(self, change: Change, _: dict[str, NDArray[Any]]) -> None:
        """Take an order to change from a step on that is still to come; the orchestrator has checked it."""
        self._changes.append((change.step, change.set))
        self._changes.sort(key=lambda entry: entry[0])

    def _change(self, lane: int, lanes: int, step: int) -> None:
        """What is to hold from this step on, holds."""
        made, settings = self._now[lane]
        while made < len(self._changes) and self._changes[made][0] <= step:
            settings = changed(settings, self._changes[made][1])
            made += 1
            self._now[lane] = made, settings
            if self._timed:
                self._timed[lane].change(settings)
            else:
                self._instant[lane].change(self._process_of(settings.loss, lane, lanes))

    def _pass_on(self, packet: Packet, arrays: dict[str, NDArray[Any]]) -> None:
        lane = packet.lane
        if self._changes:
            self._change(lane, packet.lanes, packet.step)
        number = packet.step - self._first_step
        arrived = self._instant[lane].arrives(number, up=self._now[lane][1].up)
        self._deliver(packet.step, lane, packet.lanes, self._content_of(arrays, arrived))
        self._node.done(number + 1, lane)

    def _pass_on_timed(self, packet: Packet, arrays: dict[str, NDArray[Any]]) -> None:
        lane, number = packet.lane, packet.step - self._first_step
        if self._changes:
            self._change(lane, packet.lanes, packet.step)
        if self._keeps_late:
            delivered = self._timed[lane].pass_on(number, arrays[self._content])
        else:
            arrived = self._timed[lane].in_time(number)
            delivered = self._content_of(arrays, arrived if packet.lanes > 1 else bool(arrived[0]))
        self._deliver(packet.step, lane, packet.lanes, delivered)
        self._node.done(number + 1, lane)

    def _content_of(self, arrays: dict[str, NDArray[Any]], arrived: Mask) -> dict[str, NDArray[Any]]:
        if self._instead is not None:
            mask = np.atleast_1d(np.asarray(arrived, dtype=np.bool_))
            content = np.where(mask[:, None], arrays[self._content], arrays[self._instead])
            return {self._content: content, "mask": mask.astype(np.uint8)}
        if not any_of(arrived):
            lanes = 1 if isinstance(arrived, bool) else len(arrived)
            return {"mask": np.zeros(lanes, dtype=np.uint8)}
        content = arrays[self._content]
        if isinstance(arrived, bool):
            return {self._content: content, "mask": _ARRIVED}
        return {self._content: blanked(content, arrived), "mask": arrived.astype(np.uint8)}


_ARRIVED = np.ones(1, dtype=np.uint8)
