"""What happens while a run goes: the events of its scenario, those whose condition holds, and those that are ordered.

An event at step s holds for y_s, u_s and the estimates of s. Roles know the events of the scenario with a step; of all
others they are told before s is granted. What needs all that came before (processes, snapshots, estimators) is done
while the clock stands at s − 1 and every estimate up to it is there. While an event waits for a condition the clock
goes one step at a time: a condition that begins to hold at step k takes effect at k + 1, whatever the timing.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, get_args

from pydantic import Field, ValidationError
from pydantic_core import PydanticCustomError

from testbed.channel.real.check import check_link
from testbed.control.service import ROLE as CONTROLLER
from testbed.errors import TestbedError, UsageError
from testbed.orchestrator.collect import Collector
from testbed.orchestrator.preflight import check_role, plan_of
from testbed.orchestrator.processes import NoProcesses, Processes
from testbed.orchestrator.services import Origin, Services
from testbed.orchestrator.summary import Happened
from testbed.orchestrator.watching import Watch
from testbed.plant.service import ROLE as PLANT
from testbed.scenario import parse_duration
from testbed.scenario.base import Part
from testbed.scenario.conditions import Condition
from testbed.scenario.estimator_events import ESTIMATOR_EVENTS
from testbed.scenario.event_checks import Surroundings, check_event, names_of
from testbed.scenario.events import (
    CutEvent,
    Event,
    KillEvent,
    LinkEvent,
    PauseEvent,
    ProcessEvent,
    SnapshotEvent,
)
from testbed.scenario.explain import explain
from testbed.scenario.link_timeline import LinkWalk
from testbed.scenario.plant_events import InputEvent, PlantEvent
from testbed.wire.bundle import bundle
from testbed.wire.bus import Bus
from testbed.wire.codec import encode
from testbed.wire.keys import Keys, LinkName
from testbed.wire.messages import Change
from testbed.wire.node import ORCHESTRATOR
from testbed.wire.setup import Setup

SNAPSHOTS = "snapshots"
"""Folder of the run for them."""


@dataclass
class _Due:
    """What is done between two steps: before step ``step``."""

    event: ProcessEvent | SnapshotEvent
    origin: Origin
    step: int


@dataclass
class _Waiting:
    event: Event
    origin: Origin
    text: str


class _Ordered(Part):
    events: Annotated[tuple[Event, ...], Field(strict=False)]


class Timeline:
    """``processes`` and ``folder`` are set by who owns them; without a folder no snapshot can be written."""

    def __init__(
        self, bus: Bus, setup: Setup, collector: Collector, services: Services, say: Callable[[str], None]
    ) -> None:
        self._bus, self._setup, self._collector, self._services, self._say = bus, setup, collector, services, say
        self.processes: Processes = NoProcesses()
        self.folder: Path | None = None
        self.held_at: int | None = None
        """The last step that may be granted until somebody lets the clock go on; None: all."""
        self.told: list[tuple[str, Change]] = []
        """The changes that roles were told of, which are not in the scenario: (part, change)."""
        scenario = setup.scenario
        keys = Keys(setup.run)
        parts = (*get_args(LinkName), PLANT, CONTROLLER)
        self._tell = {part: bus.publisher(keys.change(part)) for part in parts}
        self._seq: Counter[str] = Counter()
        self._ordered = 0
        self._start_ns: int | None = None
        self._events: list[tuple[Event, Happened]] = []
        """Those that need nobody but the roles: they hold from their step on, whatever happens."""
        self.others: list[Happened] = []
        """What was done to processes and with snapshots, and what was refused."""
        self.accepted: Callable[[Any, int, bool], None] = lambda event, number, timed: None
        """Called with an event that somebody ordered, its number, and whether it is to be at a certain moment."""
        self.decided: Callable[[Any, Origin, int], None] = lambda event, origin, step: None
        """Called with what takes effect, and the step."""
        self.refused: Callable[[Happened], None] = lambda entry: None
        self._due: list[_Due] = []
        self._waiting: dict[int, _Waiting] = {}
        self._watch = Watch([lane for lane, _ in setup.blocks], self._runs)
        collector.watch = self._watch.note
        cuts = self._cuts()
        for number, event in enumerate(scenario.events):
            if not event.timed:
                self._wait(event, Origin("condition", number, event.when), 0)
            elif not isinstance(event, ESTIMATOR_EVENTS):
                step = event.step(scenario.clock.period_ns)
                origin = Origin("timeline", number)
                if isinstance(event, ProcessEvent | SnapshotEvent):
                    self._due.append(_Due(event, origin, max(1, step)))
                else:
                    self._events.append((event, happened(event, origin, step, cuts.get(number))))

    def _cuts(self) -> dict[int, list[str]]:
        """By event of the scenario: the links that it cuts or heals."""
        walk, events = LinkWalk(self._setup.scenario.links), self._setup.scenario.events
        timed = [(e.step(self._setup.scenario.clock.period_ns), n, e) for n, e in enumerate(events) if e.timed]
        order = sorted(timed, key=lambda entry: entry[:2])
        tables = {n: walk.take(event) for _, n, event in order if isinstance(event, LinkEvent | CutEvent)}
        return {number: list(taken) for number, taken in tables.items()}

    @property
    def links_watched(self) -> set[str]:
        """The links whose packets a condition of the scenario counts."""
        names = names_of(self._around, self._setup.scenario.events)
        texts = [event.when for event in self._setup.scenario.events if event.when is not None]
        return {link for text in texts for link in Condition.parse(text, names).links}

    @property
    def pending(self) -> bool:
        """Whether anything holds the clock, or may."""
        return bool(self._due or self._watch or self._services.pending or self.held_at is not None)

    @property
    def numbers(self) -> set[int]:
        """Of the events that are not decided yet."""
        return {due.origin.number for due in self._due} | set(self._waiting) | self._services.numbers

    def count(self, link: str, step: int, lane: int, sent: int, lost: int) -> None:
        """Take in what became of a packet of a link that a condition counts."""
        self._watch.count(link, step, lane, sent, lost)

    def limit(self, steps: int) -> int:
        """The last step that the clock may grant now."""
        limits = [self._services.limit(steps), *(due.step - 1 for due in self._due)]
        if self._watch:
            limits.append(self._watch.evaluated + 1)
        if self.held_at is not None:
            limits.append(self.held_at)
        return min(limits)

    def proceed(self, granted: int, estimated: int) -> bool:
        """Do what can be done now; whether anything was decided."""
        decided = self._look(granted, estimated)
        for due in [d for d in self._due if d.step == granted + 1 == estimated + 1]:
            self._due.remove(due)
            self._do(due)
            decided = True
        return self._services.proceed(granted, estimated) or decided

    def proceed_real(self, granted: int, estimated: int) -> None:
        """The same where the wall clock keeps the period: only conditions are looked at."""
        while self._look(granted, estimated):
            pass

    def begin_real(self, start_ns: int) -> None:
        """u_0 is due at ``start_ns`` of the monotonic clock: what is to be done to processes is done in time."""
        self._start_ns = start_ns
        for due in self._due:
            self._schedule(due)

    def order(self, table: dict[str, Any], granted: int) -> int:
        """Let an event happen: at its step, once its condition holds, or as soon as can be; its number.

        Raises UsageError, of one line, where that cannot be.
        """
        number = len(self._setup.scenario.events) + self._ordered
        event = self._checked(table, granted)
        timed = table.get("at") is not None
        step = event.step(self._setup.scenario.clock.period_ns) if event.timed else granted + 1
        if timed and step <= granted:
            raise UsageError(f"at: got {table['at']!r}; allowed: {granted + 1} or later, what is not granted yet")
        if not event.timed:
            names = names_of(self._around, self._setup.scenario.events)
            links = Condition.parse(event.when or "", names).links - self.links_watched
            if links:
                raise UsageError(f"when: got loss_rate({min(links)}); allowed: in a condition of the scenario only")
            self._wait(event, Origin("condition", number, event.when), granted)
        elif isinstance(event, ESTIMATOR_EVENTS):
            plans = plan_of(self._setup, self._services, event, step)
            self._services.add(plans, Origin("command", number), step if timed else None)
        else:
            self._take(event, Origin("command", number), step)
        self._ordered += 1
        self.accepted(event, number, timed)
        return number

    def told_to(self, part: str) -> list[bytes]:
        """The changes that a part was told of, as they were sent."""
        return [encode(change) for to, change in self.told if to == part]

    def tell_again(self, part: str) -> None:
        """Send them again, to who may not have heard some of them."""
        if part in self._tell:
            for message in self.told_to(part):
                self._tell[part](message)

    def name_origins(self, origins: Mapping[int, Origin], numbers: int) -> None:
        """Of a run that goes on: who asked for events of the scenario, by their place; numbers: how many were given."""
        for due in self._due:
            due.origin = origins.get(due.origin.number, due.origin)
        self._events = [
            (
                event,
                entry
                if (new := origins.get(-1 if entry.number is None else entry.number)) is None
                else entry.model_copy(update=asdict(new)),
            )
            for event, entry in self._events
        ]
        self._ordered = max(0, numbers - len(self._setup.scenario.events))

    def begin_after(self, step: int) -> None:
        """What was to be done up to a step is done."""
        self._due = [due for due in self._due if due.step > step]

    def give_up(self) -> None:
        """The run is over: what has not happened will not."""
        self._services.give_up()
        step = self._collector.completed
        for waiting in self._waiting.values():
            self._refuse(waiting.event, waiting.origin, step, "its condition did not begin to hold")
        for due in self._due:
            if due.origin.by != "timeline":
                self._refuse(due.event, due.origin, due.step, "the run was over before")
        self._waiting.clear()
        self._due.clear()

    def happened(self, until: int) -> list[Happened]:
        """What took effect up to a step, in order of time, and what was refused."""
        done = [entry for _, entry in self._events]
        done += [*self.others, *self._services.happened]
        return sorted((e for e in done if e.step <= until or not e.ok), key=lambda e: e.step)

    @property
    def _around(self) -> Surroundings:
        around = Surroundings.of(self._setup.scenario)
        assert around is not None
        return around

    def _runs(self, name: str, step: int) -> bool:
        return self._services.role_at(name, step) is not None

    def _wait(self, event: Event, origin: Origin, after: int) -> None:
        condition = Condition.parse(event.when or "", names_of(self._around, self._setup.scenario.events))
        text = str(condition)
        self._waiting[origin.number] = _Waiting(event, replace(origin, when=text), text)
        self._watch.add(origin.number, condition, after)

    def _look(self, granted: int, estimated: int) -> bool:
        """Tell the conditions what is there of them; whether one more step is looked at."""
        before = self._watch.evaluated
        for number, step in self._watch.tell(estimated):
            waiting = self._waiting.pop(number)
            self._watch.drop(number)
            origin = replace(waiting.origin, true_at=step)
            first = granted + 1
            if first > self._setup.scenario.steps:
                self._refuse(waiting.event, origin, step, "the run had no step left")
                continue
            try:
                if isinstance(waiting.event, ESTIMATOR_EVENTS):
                    self._services.add(plan_of(self._setup, self._services, waiting.event, first), origin, first)
                else:
                    self._take(waiting.event, origin, first)
            except UsageError as error:
                self._refuse(waiting.event, origin, first, str(error))
        return self._watch.evaluated > before

    def _checked(self, table: dict[str, Any], granted: int) -> Event:
        """The event, which fits the scenario; with neither ``at`` nor ``when`` it is at the next step."""
        given = table.get("at") is not None or table.get("when") is not None
        events = self._setup.scenario.events
        try:
            made = _Ordered.model_validate({"events": (table if given else {**table, "at": granted + 1},)}).events[0]
            check_event(made, self._around, events)
        except ValidationError as error:
            raise UsageError(explain(error, _Ordered).removeprefix("events[0]").lstrip(".: ")) from None
        except PydanticCustomError as error:
            raise UsageError(_line(error)) from None
        if isinstance(made, ProcessEvent):
            check_role(self._setup.scenario, made.role, "role: ")
        return made

    def _take(self, event: Event, origin: Origin, step: int) -> None:
        """Let an event that concerns no estimator happen at a step that is not granted. Raises UsageError."""
        if isinstance(event, ProcessEvent | SnapshotEvent):
            due = _Due(event, origin, step)
            self._due.append(due)
            if self._start_ns is not None:
                self._schedule(due)
            return
        links: list[str] | None = None
        if isinstance(event, LinkEvent | CutEvent):
            tables = self._link_tables(event, step)
            links = list(tables)
            for link, table in tables.items():
                self._send(link, step, table)
        elif isinstance(event, InputEvent | PlantEvent):
            part = CONTROLLER if isinstance(event, InputEvent) else PLANT
            self._send(part, step, event.model_dump(mode="json", exclude_none=True))
        self.decided(event, origin, step)
        self._events.append((event, happened(event, origin, step, links)))

    def _link_tables(self, event: LinkEvent | CutEvent, step: int) -> dict[str, dict[str, Any]]:
        """What it does to which link, with all that is to come there. Raises UsageError."""
        scenario = self._setup.scenario
        known = [(e, h.step) for e, h in self._events if isinstance(e, LinkEvent | CutEvent)]
        walk, tables = LinkWalk(scenario.links), {}
        try:
            for other, _ in sorted([*known, (event, step)], key=lambda entry: entry[1]):
                taken = walk.take(other)
                if other is event:
                    tables = taken
                    changed = {name: walk.now[name] for name in taken}
        except PydanticCustomError as error:
            raise UsageError(_line(error)) from None
        for name, link in changed.items():
            check_link(scenario, name, link)
            if link.takes_time and not scenario.takes_time(name):
                raise UsageError(
                    f"link {name!r} began without time: allowed in this run: another loss; for more, begin with a "
                    "delay, such as { kind = 'constant', by = '0 s' }"
                )
        return tables

    def _send(self, part: str, step: int, table: dict[str, Any]) -> None:
        order = Change(run=self._setup.run, source=ORCHESTRATOR, seq=self._seq[part], step=step, set=table)
        self._seq[part] += 1
        self.told.append((part, order))
        self._tell[part](encode(order))

    def _schedule(self, due: _Due) -> None:
        assert self._start_ns is not None
        period_ns = self._setup.scenario.clock.period_ns

        def now() -> None:
            if due in self._due:
                self._due.remove(due)
                self._do(due)

        self._bus.at(self._start_ns + (due.step - 1) * period_ns, now)

    def _do(self, due: _Due) -> None:
        event, update = due.event, {}
        try:
            if isinstance(event, SnapshotEvent):
                update = self._snapshot(event, due.step)
            elif isinstance(event, KillEvent):
                self.processes.kill(self._role(event.role, due.step))
            elif isinstance(event, PauseEvent):
                self.processes.pause(self._role(event.role, due.step), parse_duration(event.lasts) / 1e9)
            else:
                self.processes.restart(self._role(event.role, due.step))
        except TestbedError as error:
            self._refuse(event, due.origin, due.step, str(error))
            return
        self.decided(event, due.origin, due.step)
        self.others.append(happened(event, due.origin, due.step).model_copy(update=update))

    def _role(self, role: str, step: int) -> str:
        """The role by its name in the scenario: for an estimator whoever serves it now. Raises UsageError."""
        name = role.removeprefix("estimator.")
        if name == role or name not in self._services.turns:
            return role
        serving = self._services.role_at(name, step - 1) or self._services.role_at(name, step)
        if serving is None:
            raise UsageError(f"estimator {name!r} does not run then")
        return serving

    def _snapshot(self, event: SnapshotEvent, step: int) -> dict[str, Any]:
        """Write the state down: a bundle of a snapshot for each block of lanes."""
        if self.folder is None:
            raise UsageError("the run has no folder")
        data = bundle(self._services.state_of(event.estimator, step - 1))
        name = f"{event.name or event.estimator}-{step}.bin"
        try:
            self.folder.mkdir(exist_ok=True)
            (self.folder / name).write_bytes(data)
        except OSError as error:
            raise UsageError(f"cannot write {self.folder / name}: {(error.strerror or str(error)).lower()}") from None
        return {"file": f"{SNAPSHOTS}/{name}", "bytes": len(data)}

    def _refuse(self, event: Event, origin: Origin, step: int, reason: str) -> None:
        entry = happened(event, origin, step).model_copy(update={"ok": False, "reason": reason})
        self.others.append(entry)
        self.refused(entry)
        self._say(f"step {step}: {entry.text}")


def happened(event: Event, origin: Origin, step: int, links: list[str] | None = None) -> Happened:
    """An event as it stands in the results; ``links``: those that it cuts or heals."""
    table = event.model_dump(mode="json", exclude_none=True, exclude={"at", "when"})
    if isinstance(event, PlantEvent):
        table = {"action": event.action, "plant": {k: v for k, v in table.items() if k != "action"}}
    if isinstance(event, CutEvent) and links is not None:
        table["links"] = links
    return Happened.model_validate({**table, **asdict(origin), "step": step})


def _line(error: PydanticCustomError) -> str:
    """The text of a problem, with the key below the event."""
    context = error.context or {}
    return str(context.get("text", error))
