"""The clock of a run in real time: the orchestrator's part of it."""

from __future__ import annotations

from collections.abc import Callable

from testbed.orchestrator.collect import Collector
from testbed.orchestrator.punctuality import Punctuality
from testbed.orchestrator.realtime_figures import RealTime
from testbed.wire.bus import Bus
from testbed.wire.messages import Packet, Status
from testbed.wire.setup import Setup

_LEAD_NS = 250_000_000
"""From the announcement of the start to the start."""
_TURN_NS = 50_000_000
_PATIENCE_NS = 100_000_000
"""So long after a deadline what has not come is said to have missed it: it may have been published in time."""


class Pacing:
    """Announces the start, grants steps before they are due, and looks whether what was due comes.

    grant: called with (step, date of the start). fail: called with the reason why the run cannot go on.
    """

    def __init__(
        self,
        bus: Bus,
        setup: Setup,
        collector: Collector,
        grant: Callable[[int, int], None],
        fail: Callable[[str], None],
    ) -> None:
        self._bus, self._setup, self._collector = bus, setup, collector
        self._grant, self._fail = grant, fail
        self._strict = setup.scenario.clock.deadlines == "strict"
        self._granted = 0
        self._start_ns = 0
        self.priorities: dict[str, int] = {}
        """Role → real-time priority, of the processes that have one."""
        self.times = Punctuality(setup.scenario, len(setup.blocks))

    def begin(self) -> None:
        """Announce when u_0 is due."""
        clock = self._bus.clock
        self.times.start_ns = clock.date_ns() + _LEAD_NS
        self._start_ns = clock.monotonic_of(self.times.start_ns)
        self._turn()

    def note(self, topic: str, packet: Packet) -> None:
        """Take the dates of the packet that is being handled."""
        missed = self.times.note(topic, packet.step, self._bus.published_ns, self._bus.arrived_ns)
        if missed is not None and self._strict:
            self._fail(missed)

    def figures(self, controller: Status | None) -> RealTime:
        """What the summary says."""
        clock = self._bus.clock
        counters = {} if controller is None else controller.counters
        return self.times.figures(
            self.times.due(self._now() - self._setup.scenario.clock.deadline_ns) if self._start_ns else 0,
            self._collector.completed,
            outstanding_allowed=self._setup.window,
            date_set_us=(clock.date_ns() - self._now()) / 1e3 if self._start_ns else 0.0,
            priority=self._setup.scenario.clock.priority,
            priorities=self.priorities,
            held_controls=counters.get("held", 0),
            held_steps_max=counters.get("held_steps", 0),
        )

    def due_in(self, ahead_ns: int) -> int:
        """Steps whose control is due by then."""
        return self.times.due(self._now() + ahead_ns) if self._start_ns else 0

    def _now(self) -> int:
        """The date, as it goes on from the start if nobody sets it."""
        return self.times.start_ns + self._bus.clock.monotonic_ns() - self._start_ns

    def _turn(self) -> None:
        now, steps = self._now(), self._setup.scenario.steps
        due = self.times.due(now)
        target = min(steps, due + self._setup.ahead)
        if target > self._granted:
            self._granted = target
            self._grant(target, self.times.start_ns)
        outstanding, allowed = due - self._collector.completed, self._setup.window
        self.times.outstanding_max = max(self.times.outstanding_max, outstanding)
        if outstanding > allowed:
            self._fail(
                f"step {due} is due and {outstanding} steps are not complete, allowed: {allowed} (clock.window); "
                f"waiting for {self._collector.awaiting()}"
            )
        if self._strict and (absent := self.times.absent(now, _PATIENCE_NS)) is not None:
            self._fail(absent)
        if not self._collector.finished:
            self._bus.at(self._bus.clock.monotonic_ns() + _TURN_NS, self._turn)
