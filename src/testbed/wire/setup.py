"""What a role needs to know to join a run."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, get_args

from testbed.scenario import ClosedLoop, Scenario, Transport, parse_scenario, to_toml
from testbed.scenario.backend import real_links
from testbed.scenario.estimator_events import AcksEvent
from testbed.scenario.estimators import NewService
from testbed.scenario.events import Event, KillEvent, RestartEvent
from testbed.wire.begin import AT_START, Begin
from testbed.wire.bus import Bus
from testbed.wire.codec import Sizes
from testbed.wire.keys import Keys, LinkName
from testbed.wire.node import Node

_WINDOW_MAX = 256
_BYTES_IN_FLIGHT = 24_000_000
_REAL_WINDOW = 8  # steps
_CLOSED_LOOP_CREDIT = 64  # steps
_BYTES_BEHIND = 1_000_000  # less than what waits for a process that has stopped before its senders do
_MESSAGE_OVERHEAD = 250  # bytes
_AHEAD_NS = 500_000_000
_DIRECT_MAX = 8_192  # bytes
_KEPT_BYTES = 64_000_000
_KEPT_STEPS = 2_000
_SHARED_MIN = 65_536  # bytes of the largest packet from which shared memory pays


@dataclass(frozen=True)
class Setup:
    """One run: its identity and its scenario. All roles are given the same."""

    run: str
    scenario: Scenario
    single: bool = False
    """Whether everything is in one process, none of which can be lost unless that is asked for."""

    @cached_property
    def sizes(self) -> Sizes:
        s = self.scenario
        per_packet = min(s.transport.lanes_per_packet or s.lanes, s.lanes)
        return Sizes(s.system.n, s.system.p, s.system.q, s.lanes, s.steps, per_packet)

    @cached_property
    def blocks(self) -> tuple[tuple[int, int], ...]:
        """(first lane, number of lanes) of each packet of a step."""
        lanes, size = self.scenario.lanes, self.sizes.lanes_per_packet or self.scenario.lanes
        return tuple((lane, min(size, lanes - lane)) for lane in range(0, lanes, size))

    @property
    def closed_loop(self) -> bool:
        return isinstance(self.scenario.input, ClosedLoop)

    @cached_property
    def window(self) -> int:
        """Steps in flight at most: 1 in a closed loop; else the scenario's, or as many as fit into a few megabytes.

        Over real links a few are enough, and what is known of them is not to wait behind what is to be sent later. In
        real time: steps that may have been due and are not complete, which does not hold back the clock.
        """
        if self.real:
            return self.scenario.clock.window or self._behind
        if self.closed_loop:
            return 1
        if self.scenario.clock.window is not None:
            return self.scenario.clock.window
        if real_links(self.scenario):
            return _REAL_WINDOW
        n, p, q = self.sizes.n, self.sizes.p, self.sizes.q
        bytes_a_step = 8 * self.scenario.lanes * (2 * q + 2 * p + 2 * n + n * n)
        return max(4, min(_WINDOW_MAX, _BYTES_IN_FLIGHT // bytes_a_step))

    @property
    def real(self) -> bool:
        """Whether the wall clock keeps the period."""
        return self.scenario.clock.real

    @cached_property
    def _behind(self) -> int:
        """As many steps as fit into the deadline of the transport, and into the buffers before one that sleeps."""
        n, p, q = self.sizes.n, self.sizes.p, self.sizes.q
        bytes_a_step = 8 * self.scenario.lanes * max(p + q + 1, n + n * n) + 3 * _MESSAGE_OVERHEAD * len(self.blocks)
        in_time = self.scenario.transport.deadline_ns // self.scenario.clock.period_ns
        return max(4, min(in_time, _BYTES_BEHIND // bytes_a_step))

    @property
    def ahead(self) -> int:
        """In real time: steps that are granted before they are due."""
        return max(2, -(-_AHEAD_NS // self.scenario.clock.period_ns))

    @property
    def credit(self) -> int:
        """Steps that the clock grants ahead: in a closed loop the estimate holds back the next step, not the clock."""
        return _CLOSED_LOOP_CREDIT if self.closed_loop else self.window

    @property
    def express(self) -> bool:
        """Whether each message is sent at once instead of with others."""
        return self.real or self.window == 1

    @property
    def direct(self) -> bool:
        """Whether roles handle packets on the thread that receives them: with one small packet in flight.

        A thread hand-over less; but a role that sends does not receive meanwhile.
        """
        return self.express and len(self.blocks) == 1 and self._largest <= _DIRECT_MAX

    @property
    def _largest(self) -> int:
        """Bytes of the largest packet, an estimate."""
        return 8 * self.blocks[0][1] * self.sizes.n * (1 + self.sizes.n)

    @property
    def transport(self) -> Transport:
        """The scenario's transport, with what it leaves to the run decided."""
        transport = self.scenario.transport
        if transport.shared_memory is not None:
            return transport
        local = transport.endpoint is None or "127.0.0.1" in transport.endpoint
        return transport.model_copy(update={"shared_memory": local and self._largest >= _SHARED_MIN})

    @property
    def tap(self) -> int:
        """Lanes whose packets are recorded."""
        return {"none": 0, "first": 1, "all": self.scenario.lanes}[self.scenario.record]

    @property
    def copied(self) -> int:
        """Lanes whose packets roles copy for the recording; in real time the orchestrator sees all packets anyway."""
        return 0 if self.real else self.tap

    @property
    def acks_are_of_use(self) -> bool:
        """Whether anybody takes the plant's ACKs: an ack link, an estimator that gets them directly, the recording."""
        s = self.scenario
        specs = [*s.estimators, *(planned.spec for planned in s.swaps)]
        told = any(spec is not None and spec.acks == "perfect" for spec in specs)
        told = told or any(_asks_for_acks(event) for event in s.events if not event.timed)
        return s.links.ack.mode != "none" or s.record != "none" or told

    @property
    def costs_input(self) -> bool:
        """Whether the collector needs the input that was applied."""
        return self.scenario.cost is not None and self.sizes.q > 0

    @cached_property
    def snapshot_every(self) -> int:
        """Steps from one snapshot of a role to the next; 0: none."""
        recovery = self.scenario.recovery
        ended = any(isinstance(event, KillEvent | RestartEvent) for event in self.scenario.events)
        if recovery.nothing_kept or (self.single and not (recovery.asked or ended)):
            return 0
        return recovery.every or max(8, min(_KEPT_STEPS, _KEPT_BYTES // self._bytes_a_step))

    @property
    def kept(self) -> tuple[str, ...]:
        """Keys on which senders keep what they sent for roles that are started anew: those that roles listen to."""
        if not self.snapshot_every:
            return ()
        keys = Keys(self.run)
        links = get_args(LinkName)
        source = self.scenario.input
        followed = (keys.estimate(source.estimator),) if isinstance(source, ClosedLoop) else ()
        return (*map(keys.sent, links), *map(keys.delivered, links), *followed)

    @property
    def _bytes_a_step(self) -> int:
        """Of all that links take and deliver, an estimate."""
        return 2 * (8 * self.scenario.lanes * (self.sizes.q + self.sizes.p + 1) + 3 * _MESSAGE_OVERHEAD)

    def join(self, bus: Bus, name: str, begin: Begin = AT_START) -> Node:
        """The node of a role."""
        return Node(
            bus, self.run, name, self.sizes, self.copied, begin=begin, every=self.snapshot_every, kept=self.kept
        )

    def to_json(self) -> bytes:
        return json.dumps({"run": self.run, "scenario": to_toml(self.scenario)}).encode()

    @classmethod
    def from_json(cls, payload: bytes) -> Setup:
        data = json.loads(payload)
        return cls(data["run"], parse_scenario(data["scenario"]))


def _asks_for_acks(event: Event) -> bool:
    """Whether an estimator may be told of every control packet after an event that waits."""
    if isinstance(event, AcksEvent):
        return event.acks == "perfect"
    to = getattr(event, "to", None)
    return isinstance(to, NewService) and to.acks == "perfect"


class Role(Protocol):
    """A service of the loop. It subscribes in its constructor; the bus does the rest."""

    @property
    def counters(self) -> dict[str, int]:
        """What it has to report at the end."""
        ...


Build = Callable[[Node, Setup], Role]
