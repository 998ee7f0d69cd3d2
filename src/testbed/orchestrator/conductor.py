"""The orchestrator's part of a run, on either bus: wait for the roles, drive the clock, collect, stop."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any, Literal, cast, get_args

from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, ValidationError

from testbed.channel.real.check import check_link
from testbed.channel.service import role_of as link_role
from testbed.control.service import ROLE as CONTROLLER
from testbed.errors import UsageError, did_you_mean
from testbed.estimator.bounds_service import ROLE as BOUNDS
from testbed.orchestrator.collect import Collector
from testbed.orchestrator.pacing import Pacing
from testbed.orchestrator.preflight import plan_of
from testbed.orchestrator.recorder import Recorder
from testbed.orchestrator.services import Services
from testbed.orchestrator.services_in_time import ServicesInTime
from testbed.orchestrator.summary import Happened
from testbed.plant.service import ROLE as PLANT
from testbed.scenario.changes import in_turn
from testbed.scenario.events import LinkEvent
from testbed.wire.bus import Bus
from testbed.wire.codec import Rejected, encode
from testbed.wire.keys import LinkName
from testbed.wire.messages import (
    Acknowledgement,
    BoundsMessage,
    Change,
    ClockMessage,
    Command,
    Control,
    EstimateMessage,
    Observation,
    Packet,
    Status,
    Truth,
)
from testbed.wire.node import OPEN, ORCHESTRATOR, Gate, Node
from testbed.wire.setup import Setup

Arrays = dict[str, NDArray[Any]]


class Asked(BaseModel):
    """What somebody asks of a run that goes: to change a link, a change of estimators, how it is, or to stop."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    link: str | None = None
    set: dict[str, Any] | None = None
    event: dict[str, Any] | None = None
    do: Literal["status", "stop"] | None = None


class Conductor:
    """States: waiting for roles, running, finished or failed, stopped.

    ``failure`` is the first reason the run cannot go on; ``reports`` the last word of each role.
    """

    def __init__(self, bus: Bus, setup: Setup, roles: list[str], recorder: Recorder | None) -> None:
        self.setup, self.collector = setup, Collector(setup)
        self.failure: str | None = None
        self.reports: dict[str, Status] = {}
        self.stop_asked = False
        """Somebody outside asked for the end."""
        self.activity = 0
        """Grows with every message that was of use."""
        self.on_started: Callable[[], None] = lambda: None
        self.on_joined: Callable[[str], None] = lambda role: None
        """Called with a role that has come while the run goes."""
        self.say: Callable[[str], None] = lambda line: None
        self._roles = list(roles)
        self._present: set[str] = set()
        self._gone: list[str] = []
        """Roles that have left as they should."""
        self._begun = False
        self._granted = 0
        self._steps, self._credit = setup.scenario.steps, setup.credit
        self._stopping = False
        self._recorder = recorder
        self.node = Node(bus, setup.run, ORCHESTRATOR, setup.sizes)
        self._command = bus.publisher(self.node.keys.command)
        self.pacing = Pacing(bus, setup, self.collector, self._grant, self.fail) if setup.real else None
        self._tell_link = {link: bus.publisher(self.node.keys.change(link)) for link in get_args(LinkName)}
        self._clock = bus.publisher(self.node.keys.clock)  # behind the others: what is held back is sent in this order
        self._clock_seq = 0
        self._changes: Counter[str] = Counter()
        self.events = [
            Happened(step=event.step(setup.scenario.clock.period_ns), by="timeline", link=event.link, set=event.set)
            for event in setup.scenario.events
            if isinstance(event, LinkEvent)
        ]
        """Which links change, or have changed, at which step."""
        parts = bus, setup, self.collector, lambda line: self.say(line)
        self.services = Services(*parts) if self.pacing is None else ServicesInTime(*parts, self.pacing)
        self.services.watch, self.services.joins = self._watch, self._joins
        self.services.leaves, self.services.failed = self._leaves, self.fail
        self._gates: dict[str, Gate] = {}
        self._subscribe()
        bus.answer(self.node.keys.ask, self._asked)
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

    def change_link(self, link: str, change: dict[str, Any]) -> int:
        """Let keys of a link have other values from the next step on that is not granted yet; that step.

        Raises UsageError where that cannot be.
        """
        names = get_args(LinkName)
        if link not in names:
            raise UsageError(f"link {link!r}: no such link; allowed: {', '.join(names)}{did_you_mean(link, names)}")
        name = cast(LinkName, link)
        if link_role(name) not in self._roles:
            raise UsageError(f"link {link!r}: this run has none")
        if self.over or self._granted >= self._steps:
            raise UsageError("the run has no step left that could change")
        event = Happened(step=self._granted + 1, by="command", link=link, set=change)
        events = sorted((e for e in [*self.events, event] if e.link == link), key=lambda e: e.step)
        after = in_turn(getattr(self.setup.scenario.links, link), [e.set or {} for e in events])
        check_link(self.setup.scenario, name, after[-1])
        if any(variant.takes_time for variant in after) and not self.setup.scenario.takes_time(name):
            raise UsageError(
                f"link {link!r} began without time: allowed in this run: another loss; for more, begin with a delay, "
                "such as { kind = 'constant', by = '0 s' }"
            )
        order = Change(run=self.setup.run, source=ORCHESTRATOR, seq=self._changes[link], step=event.step, set=change)
        self._changes[link] += 1
        self.events.append(event)
        self._tell_link[name](encode(order))
        return event.step

    def _asked(self, question: bytes) -> bytes:
        """Answer what somebody asks of the run: {"link": …, "set": {…}}; with {"step": k}, or {"error": …}.

        {"event": {…}} is an event without ``at``; with {"number": n}. {"do": "status"} and {"do": "stop"}; with status.
        """
        try:
            asked = Asked.model_validate_json(question)
            if asked.event is not None:
                return json.dumps({"number": self.change_estimators(asked.event)}).encode()
            if asked.do == "stop":
                self.stop_asked = True
            if asked.do is not None:
                return json.dumps(self.status()).encode()
            return json.dumps({"step": self.change_link(asked.link or "", asked.set or {})}).encode()
        except (UsageError, ValidationError) as error:
            return json.dumps({"error": " ".join(str(error).split())}).encode()

    def change_estimators(self, event: dict[str, Any]) -> int:
        """Let an event of estimators, without ``at``, happen as soon as its service is there; its number.

        Raises UsageError where that cannot be.
        """
        if not self.started:
            raise UsageError(f"the run has not begun; waiting for {self.awaiting()}")
        if self.over or self._granted >= self._steps:
            raise UsageError("the run has no step left that could change")
        plan = plan_of(self.setup, self.services, event, self._granted + 1)
        number = self.services.add(plan)
        self._advance()
        return number

    def status(self) -> dict[str, Any]:
        """How far the run is, who estimates, and what has happened."""
        at = self._granted
        roles = {name: self.services.role_at(name, at) for name in self.services.turns}
        return {
            "completed": self.collector.completed,
            "granted": at,
            "steps": self._steps,
            "estimators": {
                name: {"role": role, "kind": next(t.spec.kind for t in self.services.turns[name] if t.role == role)}
                for name, role in roles.items()
                if role is not None
            },
            "pending": [entry.number for entry in self.services.pending],
            "events": [
                event.model_dump(mode="json", exclude_none=True)
                for event in sorted([*self.events, *self.services.happened], key=lambda event: event.step)
                if event.step <= at + 1 or not event.ok
            ],
        }

    @property
    def happened(self) -> list[Happened]:
        """What has changed so far, in order of time; what was refused is among it."""
        done = [e for e in self.events if e.step <= self.collector.completed]
        done += [e for e in self.services.happened if e.step <= self.collector.completed or not e.ok]
        return sorted(done, key=lambda e: e.step)

    def tick(self, deadline_s: float) -> None:
        """From time to time: launch what will be needed, and give up what does not come."""
        if self.services.pending and not self.over:
            if self.services.overdue(deadline_s):
                self.activity += 1
            if self.started:
                self._advance()
            else:
                self._begin()

    def ended(self, role: str, how: str) -> None:
        """A role's process has ended; fail unless it has reported, or was not in charge of anything yet."""
        if self.services.deciding(role):
            return  # what it has sent comes before the news that it is gone
        if role not in self.reports and role not in self._gone and not self._lost(role, f"{role} ended: {how}"):
            self.fail(f"{role} ended: {how}")

    def stop(self) -> None:
        """Tell all roles to report and leave."""
        if not self._stopping:
            self._stopping = True
            self._command(encode(Command(run=self.setup.run, source=ORCHESTRATOR, seq=0, action="stop")))

    @property
    def all_reported(self) -> bool:
        """Whether every role that is still there has reported."""
        return all(role in self.reports for role in [*self._roles, *self._gone] if role in self._present)

    def _subscribe(self) -> None:
        node, keys, scenario = self.node, self.node.keys, self.setup.scenario
        for role in self._roles:
            node.on(keys.status(role), Status, role, partial(self._status, role))
        needs = ("applied",) if self.setup.costs_input else ()
        node.on(keys.truth, Truth, PLANT, self._truth, needs=needs)
        for spec in scenario.estimators:
            self._take_estimates(spec.name, OPEN)
        if scenario.bounds:
            node.on(keys.bounds, BoundsMessage, BOUNDS, self._bounds)
        if self._recorder is not None or self.pacing is not None:
            self._subscribe_for_recording()

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
        self.node.on(self.node.keys.status(role), Status, role, partial(self._status, role))
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

    def _lost(self, role: str, reason: str) -> bool:
        """Whether a role that is lost is of no consequence but for the change that it was to make."""
        if role in self._gone or role in self.services.unwanted:
            return True
        if not self.services.lost(role, reason):
            return False
        self.activity += 1
        self._advance()
        return True

    def _subscribe_for_recording(self) -> None:
        keys = self.node.keys
        types: dict[LinkName, tuple[type[Packet], str]] = {
            "control": (Control, CONTROLLER),
            "observation": (Observation, PLANT),
            "ack": (Acknowledgement, PLANT),
        }
        for link in get_args(LinkName):
            model, sender = types[link]
            self._record(keys.sent(link), model, sender, f"{link}/sent")
            if link_role(link) in self._roles:
                self._record(keys.delivered(link), model, link_role(link), f"{link}/delivered")

    def _record(self, key: str, model: type[Packet], source: str, topic: str) -> None:
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
        if alive and self.services.here(role):
            self.activity += 1
            if self.started:
                self.on_joined(role)
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
            if not self._stopping:
                self.fail(f"{role} is gone")
            return
        self._present.add(role)
        self.activity += 1
        self._begin()

    def _begin(self) -> None:
        """Once everybody is there."""
        if not self.started and self.services.all_are_there() and not self.missing:
            self._begun = True
            self.on_started()
            if self.pacing is not None:
                self.pacing.begin()
            self._advance()

    def _status(self, role: str, status: Status, _: Arrays) -> None:
        self.reports[role] = status
        if status.state == "failed" and not self._lost(role, status.detail):
            self.fail(f"{role}: {status.detail}")

    def _truth(self, packet: Truth, arrays: Arrays) -> None:
        self.collector.truth(packet.step, packet.lane, arrays)
        self._collected("truth", packet, arrays)

    def _estimate(self, name: str, topic: str, packet: EstimateMessage, arrays: Arrays) -> None:
        self.collector.estimate(name, packet.step, packet.lane, arrays)
        self._collected(topic, packet, arrays)

    def _bounds(self, packet: BoundsMessage, arrays: Arrays) -> None:
        self.collector.bound(packet.step, packet.lane, arrays)
        self._collected("bounds", packet, arrays)

    def _collected(self, topic: str, packet: Packet, arrays: Arrays) -> None:
        self.activity += 1
        self._write(topic, packet, arrays)
        self._advance()

    def _advance(self) -> None:
        """Grant the steps that may be in flight, several at a time, up to where estimators change.

        In real time the clock does.
        """
        if self.pacing is not None:
            if self.services.pending and not self.over:
                self.services.proceed(self._granted, self.collector.estimated)
            return
        self._grant_more()
        while (
            self.services.pending and not self.over and self.services.proceed(self._granted, self.collector.estimated)
        ):
            self._grant_more()

    def _grant_more(self) -> None:
        steps, credit = self._steps, self._credit
        if self.services.pending:
            steps = self.services.limit(steps)
        target = min(steps, self.collector.estimated + credit)
        if target > self._granted and (target == steps or target - self._granted >= max(1, credit // 4)):
            self._grant(target)

    def _grant(self, step: int, start_ns: int | None = None) -> None:
        self._granted = step
        clock = ClockMessage(run=self.setup.run, source=ORCHESTRATOR, seq=self._clock_seq, step=step, start_ns=start_ns)
        self._clock_seq += 1
        self._clock(encode(clock))
