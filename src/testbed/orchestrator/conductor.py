"""The orchestrator's part of a run, on either bus: wait for the roles, drive the clock, collect, stop."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Literal, cast, get_args

from numpy.typing import NDArray

from testbed.channel.service import role_of as link_role
from testbed.control.service import ROLE as CONTROLLER
from testbed.errors import UsageError, did_you_mean
from testbed.estimator.bounds_service import ROLE as BOUNDS
from testbed.orchestrator.asked import answer
from testbed.orchestrator.collect import Collector
from testbed.orchestrator.pacing import Pacing
from testbed.orchestrator.recorder import Recorder
from testbed.orchestrator.recovery import Recovery
from testbed.orchestrator.roles import RoleSpec
from testbed.orchestrator.services import Services
from testbed.orchestrator.services_in_time import ServicesInTime
from testbed.orchestrator.summary import Happened
from testbed.orchestrator.timeline import Timeline
from testbed.orchestrator.watchdog import Watchdog
from testbed.plant.service import ROLE as PLANT
from testbed.scenario import ClosedLoop
from testbed.scenario.recovery import Policy
from testbed.wire.begin import AT_START, Begin
from testbed.wire.bus import Bus
from testbed.wire.codec import Rejected, encode
from testbed.wire.keys import LinkName
from testbed.wire.messages import (
    Acknowledgement,
    BoundsMessage,
    ClockMessage,
    Command,
    Control,
    EstimateMessage,
    Observation,
    Packet,
    Status,
    Truth,
)
from testbed.wire.node import OPEN, ORCHESTRATOR, Gate
from testbed.wire.setup import Setup

Arrays = dict[str, NDArray[Any]]


_LINKS: dict[LinkName, tuple[type[Packet], str]] = {
    "control": (Control, CONTROLLER),
    "observation": (Observation, PLANT),
    "ack": (Acknowledgement, PLANT),
}
"""What goes over a link, and who sends it."""


class Conductor:
    """States: waiting for roles, running, finished or failed, stopped.

    ``failure`` is the first reason the run cannot go on; ``reports`` the last word of each role.
    """

    def __init__(
        self,
        bus: Bus,
        setup: Setup,
        roles: Sequence[RoleSpec],
        recorder: Recorder | None,
        policies: Mapping[str, Policy] | None = None,
        begin: int = 0,
    ) -> None:
        """policies: what becomes of a role that is lost; of one that is not among them, the run fails.

        begin: the step after which the run goes on.
        """
        self.setup, self.collector = setup, Collector(setup)
        self.failure: str | None = None
        self.reports: dict[str, Status] = {}
        self.stop_asked = ""
        """Why the run is to end before its end; empty: nobody asked for it."""
        self.activity = 0
        """Grows with every message that was of use."""
        self.on_started: Callable[[], None] = lambda: None
        self.on_present: Callable[[str], None] = lambda role: None
        """Called with each role that comes while the run goes."""
        self.on_progress: Callable[[], None] = lambda: None
        """Called when all roles are there, when steps are complete, and when events are decided."""
        self.say: Callable[[str], None] = lambda line: None
        self._roles = [role.name for role in roles]
        self._present: set[str] = set()
        self._gone: list[str] = []
        """Roles that have left as they should."""
        self._begun = self._going = False
        self._granted = 0
        self._told = 0
        self._steps, self._credit = setup.scenario.steps, setup.credit
        self._stopping = False
        self._recorder = recorder
        self.recorded: list[str] = []
        """The topics of the links that are recorded."""
        self.node = setup.join(bus, ORCHESTRATOR, Begin(begin))
        self._commands = 0
        self._command = bus.publisher(self.node.keys.command)
        self.pacing = Pacing(bus, setup, self.collector, self._grant, self.fail) if setup.real else None
        parts = bus, setup, self.collector, lambda line: self.say(line)
        self.services = Services(*parts) if self.pacing is None else ServicesInTime(*parts, self.pacing)
        self.timeline = Timeline(bus, setup, self.collector, self.services, lambda line: self.say(line))
        self._clock = bus.publisher(self.node.keys.clock)  # behind the others: what is held back is sent in this order
        self._clock_seq = 0
        self.services.watch, self.services.joins = self._watch, self._joins
        self.services.leaves, self.services.failed = self._leaves, self.fail
        self.recovery = Recovery(setup, self.collector, self.services, roles, dict(policies or {}))
        self.recovery.forget = self._forget
        self.recovery.changes = lambda role: self.timeline.told_to(role.removeprefix("link."))
        self.recovery.missed, self.recovery.rejected = self._missed, self.node.rejected
        self.services.retry, self.services.comes_back = self._advance_soon, self._comes_back
        self.services.taken, self.services.served = self.recovery.taken, self.recovery.served
        self.ending: Callable[[str], str | None] = lambda role: None
        """How a role's process has ended, if it has."""
        self.watchdog = Watchdog(setup, self.collector, lambda: self._order("ping"))
        self._gates: dict[str, Gate] = {}
        source = setup.scenario.input
        followed = [source.estimator] if setup.kept and isinstance(source, ClosedLoop) else []
        self._remembered = {name: self.node.remember(self.node.keys.estimate(name)) for name in followed}
        self._subscribe()
        bus.answer(self.node.keys.begin, self._begin_of)
        bus.answer(self.node.keys.ask, partial(answer, self))
        bus.answer(self.node.keys.scenario, lambda _: setup.to_json())
        self.node.announce()
        bus.watch(self.node.keys.presence("*"), self._presence)

    @property
    def started(self) -> bool:
        return self._begun

    @property
    def over(self) -> bool:
        """Nothing more will be collected."""
        return self.collector.finished or self.failure is not None

    @property
    def granted(self) -> int:
        """The last step that the clock has let begin."""
        return self._granted

    @property
    def resting(self) -> bool:
        """Whether everything is done up to the step at which the clock is held."""
        held = self.timeline.held_at
        return self._begun and held is not None and self.collector.completed >= held

    @property
    def held_at(self) -> int | None:
        """The step beyond which the clock does not go, and that it has reached; None where it goes on."""
        held = self.timeline.held_at
        return self._granted if held is not None and self._granted >= held else None

    @property
    def missing(self) -> list[str]:
        """Roles that are not there."""
        return [role for role in self._roles if role not in self._present]

    def fail(self, reason: str) -> None:
        """Note why the run cannot go on; the first reason stays."""
        if self.failure is None and not self.collector.finished:
            self.failure = reason

    def awaiting(self) -> str:
        """What the run is waiting for now."""
        if self.started and self.services.pending and self.collector.estimated == self._granted:
            return f"a service of {self.services.pending[0].plan.event.estimator} to join"
        return self.collector.awaiting() if self.started else f"roles to join: {', '.join(self.missing)}"

    def outcome(self, number: int) -> Happened | None:
        """What became of an order; None as long as that is to come."""
        return next((e for e in self.timeline.happened(self._granted + 1) if e.number == number), None)

    def change_link(self, link: str, change: dict[str, Any]) -> int:
        """Let keys of a link have other values from the next step on that is not granted yet; that step.

        Raises UsageError where that cannot be.
        """
        names = get_args(LinkName)
        if link not in names:
            raise UsageError(f"link {link!r}: no such link; allowed: {', '.join(names)}{did_you_mean(link, names)}")
        if link_role(cast(LinkName, link)) not in self._roles:
            raise UsageError(f"link {link!r}: this run has none")
        self._check_going()
        self.timeline.order({"action": "set", "link": link, "set": change}, self._granted)
        return self._granted + 1

    def order(self, event: dict[str, Any]) -> int:
        """Let an event happen, given as in a scenario; without ``at`` and ``when`` as soon as can be. Its number.

        Raises UsageError where that cannot be.
        """
        if not self.started:
            raise UsageError(f"the run has not begun; waiting for {self.awaiting()}")
        self._check_going()
        number = self.timeline.order(event, self._granted)
        self._advance()
        return number

    def hold(self, step: int) -> None:
        """Let the clock not go beyond a step, or beyond what is granted already.

        Raises UsageError in real time, but for step 0 before it begins.
        """
        if self.pacing is not None and (step or self._going):
            raise UsageError("the run keeps real time, which cannot be held; allowed: in virtual time")
        self.timeline.held_at = step
        self._go()

    def release(self) -> None:
        """Let the clock go on."""
        self.timeline.held_at = None
        self._go()

    def _go(self) -> None:
        """Begin, unless the clock is held at the beginning, or go on."""
        if not self._begun or self._stopping:
            return
        if not self._going and self.timeline.held_at != 0:
            self._going = True
            self.on_started()
            if self.pacing is not None:
                self.pacing.begin()
                self.timeline.begin_real(self.node.bus.clock.monotonic_of(self.pacing.times.start_ns))
        self._advance()

    def _check_going(self) -> None:
        if self.over or self._granted >= self._steps:
            raise UsageError("the run has no step left that could change")

    @property
    def happened(self) -> list[Happened]:
        """What has changed so far, in order of time; what was refused is among it."""
        return self.timeline.happened(self.collector.completed)

    def tick(self, deadline_s: float) -> None:
        """From time to time: launch what will be needed, and give up what does not come."""
        if self.started and not self.over:
            self.recovery.proceed()
            busy = bool(self.recovery.down) or self.resting
            for role in self.watchdog.hung(self._present - {role for role in self._present if self._fails(role)}, busy):
                self._is_lost(role, f"gave no sign of life for {self.watchdog.patience_s:g} s")
        if self.resting:
            self.activity += 1  # who holds the clock knows that nothing moves
        if self.timeline.pending and not self.over:
            if self.services.overdue(deadline_s):
                self.activity += 1
            if self.started:
                self._advance()
                self.on_progress()
            else:
                self._begin()

    def ended(self, role: str, how: str) -> None:
        """A role's process has ended; fail unless it has reported, can be recovered, or was not in charge yet."""
        if self.services.deciding(role):
            return  # what it has sent comes before the news that it is gone
        if role not in self.reports and role not in self._gone:
            self.recovery.down.pop(role, None)
            self._is_lost(role, f"ended: {how}")

    def restart(self, role: str) -> None:
        """Start a role anew. Raises UsageError where the scenario does not let that be."""
        if self.recovery.policy(role) != "restart":
            raise UsageError(f"{role} cannot be started anew: its policy of recovery is {self.recovery.policy(role)}")
        self._is_lost(role, "was restarted")

    def end(self, reason: str) -> None:
        """Somebody asks for the end before the end; the first reason stays."""
        self.stop_asked = self.stop_asked or reason

    def stop(self) -> None:
        """Tell all roles to report and leave."""
        if not self._stopping:
            self._stopping = True
            self._order("stop")

    @property
    def all_reported(self) -> bool:
        """Whether every role that is still there has reported."""
        return all(role in self.reports for role in [*self._roles, *self._gone] if role in self._present)

    def _subscribe(self) -> None:
        node, keys, scenario = self.node, self.node.keys, self.setup.scenario
        for role in self._roles:
            self._listen(role)
        needs = ("applied",) if self.setup.costs_input else ()
        node.on(keys.truth, Truth, PLANT, self._truth, needs=needs)
        for spec in scenario.estimators:
            self._take_estimates(spec.name, OPEN)
        if scenario.bounds:
            node.on(keys.bounds, BoundsMessage, BOUNDS, self._bounds)
        for link in self.timeline.links_watched:
            self._count(cast(LinkName, link))
        if self._recorder is not None or self.pacing is not None:
            self._subscribe_for_recording()

    def _count(self, link: LinkName) -> None:
        """Tell conditions what becomes of the packets of a link; that of u_{k−1} counts at step k."""
        model, _ = _LINKS[link]
        ahead = 1 - model.FIRST_STEP

        def count(packet: Packet, arrays: Arrays) -> None:
            arrived = int(arrays["mask"].sum())
            self.timeline.count(link, packet.step + ahead, packet.lane, packet.lanes, packet.lanes - arrived)
            self._advance()

        self.node.on(self.node.keys.delivered(link), model, link_role(link), count, needs=("mask",))

    def _take_estimates(self, name: str, gate: Gate) -> None:
        def is_due(packet: EstimateMessage) -> bool:
            role = self.services.role_at(name, packet.step)
            if role is None:
                raise Rejected("range", f"step {packet.step} of {name}")
            return packet.source == role

        take = partial(self._estimate, name, f"estimate/{name}")
        self.node.on(self.node.keys.estimate(name), EstimateMessage, is_due, take, gate=gate)

    def _watch(self, role: str, name: str) -> None:
        """Listen to a role that is about to be launched."""
        self._listen(role)
        if name not in self.services.turns:
            self._gates[name] = Gate(None)
            self._take_estimates(name, self._gates[name])

    def _joins(self, role: str, name: str, first: int) -> None:
        self._roles.append(role)
        self._present.add(role)
        if name in self._gates:
            self._gates.pop(name).passed_over = first - 1

    def _leaves(self, role: str) -> None:
        self._roles.remove(role)
        self._gone.append(role)
        self.recovery.down.pop(role, None)

    def _lost(self, role: str, reason: str) -> bool:
        """Whether a role that is lost is of no consequence but for the change that it was to make."""
        if role in self._gone and role not in self.reports and self.services.awaited(role):
            self._gone.remove(role)
            self._roles.append(role)
        if role in self._gone or role in self.services.unwanted:
            return True
        if not self.services.lost(role, reason):
            return False
        self.activity += 1
        self._advance()
        self.on_progress()
        return True

    def _listen(self, role: str) -> None:
        keys = self.node.keys
        self.node.on(keys.status(role), Status, role, partial(self._status, role))
        if self.setup.snapshot_every:
            self.node.bus.subscribe(keys.state(role), lambda _, payload: self.recovery.take(role, payload))

    def _begin_of(self, role: bytes) -> bytes:
        name = role.decode(errors="replace")
        known = name in self.recovery.specs
        return (self.recovery.begin(name, late=self.started) if known else AT_START).to_bytes()

    def begin_after(self, step: int, reports: Mapping[str, Status]) -> None:
        """Go on after a step; reports: the last words of roles that have left before."""
        self._granted = step
        self.reports.update(reports)
        self._gone += reports
        for name in self.services.turns:
            if name not in {spec.name for spec in self.setup.scenario.estimators}:
                self._take_estimates(name, OPEN)

    @property
    def last_words(self) -> dict[str, Status]:
        """Of roles that have left."""
        return {role: self.reports[role] for role in self._gone if role in self.reports}

    @property
    def awaited_words(self) -> bool:
        """Whether a role that has left has not reported yet."""
        return any(role in self._present and role not in self.reports for role in self._gone)

    def _advance_soon(self) -> None:
        self.activity += 1
        self.node.bus.call(self._advance)

    def _comes_back(self, role: str) -> bool:
        return self.recovery.policy(role) == "restart"

    def _fails(self, role: str) -> bool:
        return self.recovery.policy(role) == "fail"

    def _is_lost(self, role: str, how: str) -> None:
        """A role is not there any more, or does nothing: go on without it if that can be."""
        if self._lost(role, f"{role} {how}"):
            return
        if self._stopping or not self.recovery.lost(role, how, started=self.started):
            self.fail(f"{role} {how}{self.recovery.reason(role)}")
            return
        self._present.discard(role)
        self.activity += 1
        if role in self.recovery.down:
            self.node.expect_anew(self.node.keys.status(role))
        self.say(self.recovery.happened[-1].text)

    def _missed(self, role: str, last: int) -> None:
        """The run goes on without an estimator."""
        self._leaves(role)
        self.services.ended(role, last)
        self._advance()

    def _is_back(self, role: str) -> None:
        """A role that was started anew is there: tell it what it has not heard."""
        self.recovery.back(role)
        self.timeline.tell_again(role.removeprefix("link."))
        if self._granted:
            self._grant(self._granted, None if self.pacing is None else self.pacing.times.start_ns)
        if self._stopping:
            self._order("stop")
        elif self.started:
            self._advance()

    def _forget(self, step: int) -> None:
        self.node.forget(step)
        self._order("forget", step)

    def _order(self, action: Literal["stop", "ping", "forget"], step: int | None = None) -> None:
        command = Command(run=self.setup.run, source=ORCHESTRATOR, seq=self._commands, action=action, step=step)
        self._commands += 1
        self._command(encode(command))

    def _subscribe_for_recording(self) -> None:
        keys = self.node.keys
        for link in get_args(LinkName):
            model, sender = _LINKS[link]
            self._record(keys.sent(link), model, sender, f"{link}/sent")
            if link_role(link) in self._roles:
                self._record(keys.delivered(link), model, link_role(link), f"{link}/delivered")

    def _record(self, key: str, model: type[Packet], source: str, topic: str) -> None:
        self.recorded.append(topic)
        whole = self.setup.real or self.setup.tap >= self.setup.sizes.lanes
        taken = key if whole else self.node.keys.tap(key)
        self.node.on(taken, model, source, partial(self._write, topic), cut=not whole)

    def _write(self, topic: str, packet: Packet, arrays: Arrays) -> None:
        if self.pacing is not None:
            self.pacing.note(topic, packet)
        if self._recorder is not None:
            self._recorder.write(topic, packet, arrays, self.node.payload, self.node.bus.published_ns)

    def _presence(self, key: str, alive: bool) -> None:
        role = key.rsplit("/", 1)[1]
        if alive and self.started:
            self.on_present(role)
        if alive and self.services.here(role):
            self.activity += 1
            if self.started:
                self._advance()
            else:
                self._begin()
            return
        if not alive and not self._stopping and self._lost(role, f"{role} is gone"):
            self._present.discard(role)
            return
        if role not in self._roles:
            return
        if not alive:
            self._present.discard(role)
            if not self._stopping and role not in self.recovery.down and role not in self.reports:
                how = self.ending(role)
                self._is_lost(role, "is gone" if how is None else f"ended: {how}")
            return
        self._present.add(role)
        self.activity += 1
        if role in self.recovery.down:
            self._is_back(role)
        self._begin()

    def _begin(self) -> None:
        """Once everybody is there."""
        if not self.started and self.services.all_are_there() and not self.missing:
            self._begun = True
            self.on_progress()
            self._go()

    def _status(self, role: str, status: Status, _: Arrays) -> None:
        if status.state == "alive":
            self.watchdog.alive.add(role)
            return
        self.reports[role] = status
        if status.state != "failed" or self._lost(role, status.detail):
            return
        if self.recovery.policy(role) == "continue":
            self._is_lost(role, f"failed: {status.detail}")
        else:  # it would fail again where it begins anew
            self.fail(f"{role}: {status.detail}")

    def _truth(self, packet: Truth, arrays: Arrays) -> None:
        self.collector.truth(packet.step, packet.lane, arrays)
        self._collected("truth", packet, arrays)

    def _estimate(self, name: str, topic: str, packet: EstimateMessage, arrays: Arrays) -> None:
        if name in self._remembered:
            self._remembered[name](packet.seq)
        self.collector.estimate(name, packet.step, packet.lane, arrays)
        self._collected(topic, packet, arrays)

    def _bounds(self, packet: BoundsMessage, arrays: Arrays) -> None:
        self.collector.bound(packet.step, packet.lane, arrays)
        self._collected("bounds", packet, arrays)

    def _collected(self, topic: str, packet: Packet, arrays: Arrays) -> None:
        self.activity += 1
        self._write(topic, packet, arrays)
        if self.collector.completed != self._told:
            self._told = self.collector.completed
            self.on_progress()
        self._advance()

    def _advance(self) -> None:
        """Grant the steps that may be in flight, several at a time, up to where estimators change.

        In real time the clock does. While a role is started anew nothing is granted or changed.
        """
        if self.recovery.down:
            return
        if self.pacing is not None:
            self.timeline.proceed_real(self._granted, self.collector.estimated)
            if self.services.pending and not self.over:
                self.services.proceed(self._granted, self.collector.estimated)
            return
        self._grant_more()
        while (
            self.timeline.pending and not self.over and self.timeline.proceed(self._granted, self.collector.estimated)
        ):
            self._grant_more()
            self.on_progress()

    def _grant_more(self) -> None:
        steps, credit = self._steps, self._credit
        if self.timeline.pending:
            steps = self.timeline.limit(steps)
        target = min(steps, self.collector.estimated + credit)
        if target > self._granted and (target == steps or target - self._granted >= max(1, credit // 4)):
            self._grant(target)

    def _grant(self, step: int, start_ns: int | None = None) -> None:
        self._granted = step
        clock = ClockMessage(run=self.setup.run, source=ORCHESTRATOR, seq=self._clock_seq, step=step, start_ns=start_ns)
        self._clock_seq += 1
        self._clock(encode(clock))
