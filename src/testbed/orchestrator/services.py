"""Which service gives the estimates of which name, and how that changes while the run goes.

A change takes effect at one exact step s. The clock is not granted beyond s − 1 until it is decided, so that every
service has done exactly s − 1 steps: the old one gives its state, the new one takes it, the old one leaves, and the
clock goes on. Where anything fails before the old one has left, it stays in charge, and the run goes on.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Literal

from testbed.errors import RunFailed, TestbedError, UsageError
from testbed.estimator.service import builder, role_of
from testbed.orchestrator.collect import Collector
from testbed.orchestrator.roles import RoleSpec
from testbed.orchestrator.summary import Downtime, Happened
from testbed.scenario import EstimatorSpec
from testbed.scenario.estimator_events import EstimatorEvent
from testbed.scenario.estimators import NewService
from testbed.scenario.services import Planned
from testbed.wire.bus import Bus, BusError
from testbed.wire.handover import Behind, Order, ask
from testbed.wire.keys import Keys
from testbed.wire.setup import Setup

START_S = 3.0
"""A process is started so long before its step, at the speed of the run until then."""


@dataclass
class Turn:
    """One service that gives the estimates of a name from step ``first`` on; ``carried``: with the old one's books."""

    first: int
    role: str
    spec: EstimatorSpec
    carried: bool = False


@dataclass(frozen=True)
class Origin:
    """Who asked for an event, its number, and for which condition it waited, since when that held."""

    by: Literal["timeline", "command", "condition"]
    number: int
    when: str | None = None
    true_at: int | None = None


@dataclass
class _Pending:
    """A change that is not decided yet. step: None until the service that somebody asked for is there."""

    plan: Planned
    origin: Origin
    step: int | None
    role: RoleSpec | None = None
    launched_s: float | None = None
    held_s: float | None = None
    present: bool = False


class Services:
    """The services of estimators in turn. ``launch`` starts a role, ``drop`` ends one that is not wanted.

    Both are set by who owns the processes; ``launch`` may raise a TestbedError. ``joins`` and ``leaves`` are told of
    roles that become part of the run and of those that leave it as they should.
    """

    def __init__(self, bus: Bus, setup: Setup, collector: Collector, say: Callable[[str], None]) -> None:
        scenario = setup.scenario
        self._bus, self._setup, self._collector, self._say = bus, setup, collector, say
        self._keys = Keys(setup.run)
        self.turns: dict[str, list[Turn]] = {
            spec.name: [Turn(1, role_of(spec.name), spec)] for spec in scenario.estimators
        }
        self.last: dict[str, int] = {spec.name: spec.until or scenario.steps for spec in scenario.estimators}
        """The last step at which a name has estimates."""
        self.pending = [_Pending(plan, Origin("timeline", plan.place), plan.step) for plan in scenario.swaps]
        self.happened: list[Happened] = []
        self.downtimes: list[Downtime] = []
        self.launch: Callable[[RoleSpec], None] = _nobody
        self.drop: Callable[[str], None] = lambda role: None
        self.made: list[tuple[EstimatorEvent, int]] = []
        """The changes that were made, each with its step."""
        self.watch: Callable[[str, str], None] = lambda role, name: None
        """Called with a role before it is launched, and the name of its estimates."""
        self.joins: Callable[[str, str, int], None] = lambda role, name, first: None
        self.leaves: Callable[[str], None] = lambda role: None
        self.taken: Callable[[RoleSpec, EstimatorSpec, int, list[tuple[Order, bytes]]], None] = lambda *given: None
        """Called with a service that begins after a step, and what it was told for that."""
        self.decided: Callable[[Any, Origin, int], None] = lambda event, origin, step: None
        """Called with what takes effect, and the step."""
        self.refused: Callable[[Happened], None] = lambda entry: None
        self.retry: Callable[[], None] = lambda: None
        """Called where a service is not there yet: let ``proceed`` be called once more, soon."""
        self.comes_back: Callable[[str], bool] = lambda role: False
        """Whether a role that does not answer will be started anew."""
        self.served: Callable[[str, Order], None] = lambda role, order: None
        """Called with a role and what it was told on its way."""
        self.failed: Callable[[str], None] = lambda reason: None
        self.unwanted: set[str] = set()
        """Roles that were started and are not needed any more; how they end is of no interest."""
        self._count = Counter({role_of(spec.name): 1 for spec in scenario.estimators})
        self._began_s: float | None = None

    def role_at(self, name: str, step: int) -> str | None:
        """Whose estimate of a step counts; None where there is to be none."""
        turns = self.turns.get(name, [])
        if step > self.last.get(name, 0):
            return None
        return next((turn.role for turn in reversed(turns) if turn.first <= step), None)

    def limit(self, steps: int) -> int:
        """The last step that the clock may grant now."""
        return min([steps, *(p.step - 1 for p in self.pending if p.step is not None)])

    def add(self, plans: list[Planned], origin: Origin, step: int | None) -> None:
        """Changes that somebody asks for: at a step that is not granted; None: as soon as their services are there."""
        self.pending += [_Pending(plan, origin, step) for plan in plans]

    @property
    def numbers(self) -> set[int]:
        """Of the events that are not decided yet."""
        return {entry.origin.number for entry in self.pending if entry.origin.by != "timeline"}

    def all_are_there(self) -> bool:
        """Whether the run can begin."""
        return True

    def deciding(self, role: str) -> bool:
        """Whether a role may have begun to serve without our knowing."""
        return False

    def swaps(self) -> tuple[Downtime, ...]:
        """What the changes that were made cost."""
        return tuple(self.downtimes)

    def proceed(self, granted: int, estimated: int) -> bool:
        """Launch what is due, and make the changes for which everything is there; whether any was decided."""
        before = len(self.pending)
        self._launch_due(granted, estimated)
        for entry in list(self.pending):
            if entry.step is None and (entry.present or not self._needs_service(entry)):
                entry.step = granted + 1
                if entry.step > self._setup.scenario.steps:
                    self._refuse(entry, "the run had no step left")
        due = [p for p in self.pending if p.step is not None and p.step == granted + 1 == estimated + 1]
        for entry in due:
            entry.held_s = entry.held_s if entry.held_s is not None else time.monotonic()
        ready = [p for p in due if p.present or not self._needs_service(p)]
        for entry in ready:
            self._make(entry)
        return len(self.pending) < before

    def overdue(self, deadline_s: float) -> bool:
        """Refuse what was not there in time; whether there was any."""
        now = time.monotonic()
        late = [p for p in self.pending if p.launched_s is not None and not p.present]
        late = [p for p in late if p.launched_s is not None and now - p.launched_s > deadline_s]
        for entry in late:
            self._refuse(entry, f"{_name(entry)} did not join within {deadline_s:g} s")
        return bool(late)

    def here(self, role: str) -> bool:
        """Whether the role that is present now is one that is awaited."""
        entry = self._of(role)
        if entry is not None:
            entry.present = True
        return entry is not None

    def lost(self, role: str, reason: str) -> bool:
        """Whether a role that is gone or has failed was not in charge of anything; then its change is refused."""
        entry = self._of(role)
        if entry is not None:
            self._refuse(entry, reason)
        return entry is not None

    def count_again(self) -> None:
        """Number the services that are to come behind those that there were."""
        roles = {turn.role for turns in self.turns.values() for turn in turns}
        for role in roles:
            base, _, number = role.removeprefix(_PREFIX).partition(".")
            self._count[_PREFIX + base] = max(self._count[_PREFIX + base], int(number or 1))

    def ended(self, role: str, last: int) -> None:
        """A service is lost, and its estimates end after a step."""
        name = next(name for name, turns in self.turns.items() if turns[-1].role == role)
        self.last[name] = min(self.last[name], last)

    def give_up(self) -> None:
        """The run is over: what has not happened will not."""
        for entry in list(self.pending):
            if entry.origin.by != "timeline":
                self._refuse(entry, "the run was over before")

    def _of(self, role: str) -> _Pending | None:
        return next((p for p in self.pending if p.role is not None and p.role.name == role), None)

    def _needs_service(self, entry: _Pending) -> bool:
        return entry.plan.spec is not None and entry.plan.promoted is None

    def _launch_due(self, granted: int, estimated: int) -> None:
        now = time.monotonic()
        ahead = self._ahead(now, estimated)
        for entry in list(self.pending):
            if entry.launched_s is not None or not self._needs_service(entry):
                continue
            if entry.step is None or entry.step - 1 <= max(granted, estimated + ahead):
                self._launch(entry, now)

    def _ahead(self, now: float, estimated: int) -> float:
        """Steps before its own at which a service is launched."""
        if self._began_s is None:
            self._began_s = now
        elapsed = now - self._began_s
        return START_S * estimated / elapsed if elapsed > 0.1 else 0.0

    def _launch(self, entry: _Pending, now: float) -> None:
        spec = entry.plan.spec
        assert spec is not None
        base = role_of(spec.name)
        self._count[base] += 1
        name = base if self._count[base] == 1 else f"{base}.{self._count[base]}"
        arguments = ("--name", spec.name, "--role", name, "--spec", spec.model_dump_json())
        entry.role = RoleSpec(name, builder(spec.name, spec), "testbed.estimator", arguments)
        entry.launched_s = now
        self._listen(name)
        self.watch(name, spec.name)
        try:
            self.launch(entry.role)
        except TestbedError as error:
            self._refuse(entry, str(error))

    def _listen(self, role: str) -> None:
        """To a role that is about to be launched."""

    def _make(self, entry: _Pending) -> None:
        """Make a change now, between two steps."""
        assert entry.step is not None
        plan, done, handed = entry.plan, entry.step - 1, 0
        try:
            self._check_still_there(plan)
            if not self._are_ready(plan, done):
                self.retry()
                return
            if entry.role is not None:
                handed = self._hand_over(plan, entry.role, done)
            elif plan.promoted is not None:
                order = Order(action="serve", step=done, name=plan.name)
                ask(self._bus, self._key(self._serving(plan.promoted)), order)
                self.served(self._serving(plan.promoted), order)
        except TestbedError as error:
            self._refuse(entry, str(error))
            return
        if plan.source is not None and (plan.replaces or plan.spec is None):
            leaving = self._serving(plan.source.name)
            self.leaves(leaving)
            try:
                ask(self._bus, self._key(leaving), Order(action="leave", step=done))
            except TestbedError as error:
                self.failed(f"{leaving} did not leave at step {entry.step}: {error}")
        self._count_on(entry, entry.step)
        self._settle(entry, entry.step, handed)

    def _are_ready(self, plan: Planned, done: int) -> bool:
        """Whether the services that a change builds on are there; not while one is started anew."""
        for name in (plan.source.name if plan.source is not None else None, plan.promoted):
            if name is None:
                continue
            role = self._serving(name)
            try:
                ask(self._bus, self._key(role), Order(action="ready", step=done))
            except Behind:
                return False
            except BusError:
                if self.comes_back(role):
                    return False
                raise
        return True

    def _hand_over(self, plan: Planned, to: RoleSpec, done: int) -> int:
        """Block by block of lanes; the bytes that went over."""
        form, told = plan.handover or "cold", list[tuple[Order, bytes]]()
        for lane, _ in self._setup.blocks:
            data = b""
            if form != "cold" and plan.source is not None:
                data = ask(
                    self._bus,
                    self._key(self._serving(plan.source.name)),
                    Order(action="give", step=done, lane=lane, form=form),
                )
            told.append((Order(action="take", step=done, lane=lane, form=form), data))
            ask(self._bus, self._key(to.name), *told[-1])
        assert plan.spec is not None
        self.taken(to, plan.spec, done, told)
        return sum(len(data) for _, data in told)

    def _count_on(self, entry: _Pending, step: int) -> None:
        """Whose estimates count from now on."""
        plan, steps = entry.plan, self._setup.scenario.steps
        if plan.promoted is not None:
            role = self._serving(plan.promoted)
            self._end(plan.promoted, step - 1)
        else:
            role = entry.role.name if entry.role is not None else ""
        if plan.spec is None:
            assert plan.source is not None
            self._end(plan.source.name, step - 1)
        else:
            name = plan.spec.name
            carried = plan.handover == "full" and plan.replaces
            self.turns.setdefault(name, []).append(Turn(step, role, plan.spec, carried))
            self.last[name] = plan.spec.until or steps
            self._collector.expect(name, step, self.last[name])

    def _settle(self, entry: _Pending, step: int, handed: int) -> None:
        """Everybody has agreed."""
        plan = entry.plan
        if entry.role is not None and plan.spec is not None:
            self.joins(entry.role.name, plan.spec.name, step)
        self.pending.remove(entry)
        self.decided(plan.event, entry.origin, step)
        self.made.append((plan.event, step))
        self.happened.append(_happened(entry, step).model_copy(update={"bytes": handed}))
        if entry.held_s is not None:
            waited = 1e3 * (time.monotonic() - entry.held_s)
            self.downtimes.append(Downtime(step=step, estimator=plan.name, ms=waited))

    def state_of(self, name: str, done: int) -> list[bytes]:
        """The whole state of an estimator after so many steps, a snapshot for each block of lanes.

        Raises a TestbedError where it does not run, or has none to give.
        """
        role = self.role_at(name, done + 1)
        if role is None:
            raise UsageError(f"there is no estimator {name!r}")
        orders = [Order(action="give", step=done, lane=lane, form="full") for lane, _ in self._setup.blocks]
        return [ask(self._bus, self._key(role), order) for order in orders]

    def _end(self, name: str, last: int) -> None:
        self.last[name] = min(self.last[name], last)
        self._collector.expect(name, 0, self.last[name])

    def _check_still_there(self, plan: Planned) -> None:
        """Raises UsageError where an earlier change that was refused took away what this one builds on."""
        for name in (plan.source.name if plan.source is not None else None, plan.promoted):
            if name is not None and name not in self.turns:
                raise UsageError(f"there is no estimator {name!r}")

    def _serving(self, name: str) -> str:
        return self.turns[name][-1].role

    def _key(self, role: str) -> str:
        return self._keys.handover(role)

    def _refuse(self, entry: _Pending, reason: str) -> None:
        self.pending.remove(entry)
        step = entry.step if entry.step is not None else self._collector.estimated + 1
        happened = _happened(entry, step).model_copy(update={"ok": False, "reason": reason})
        self.happened.append(happened)
        self.refused(happened)
        self._say(f"step {step}: {happened.text}")
        if entry.role is not None:
            self.unwanted.add(entry.role.name)
            self.drop(entry.role.name)


_PREFIX = role_of("")


def _happened(entry: _Pending, step: int) -> Happened:
    event = entry.plan.event
    to = getattr(event, "to", None)
    return Happened(
        step=step,
        **asdict(entry.origin),
        action=event.action,
        estimator=event.estimator or entry.plan.name,
        name=getattr(event, "name", None),
        to=to if to is None or isinstance(to, str) else _table(to),
        handover=entry.plan.handover,
        acks=getattr(event, "acks", None),
        due=entry.plan.step if entry.origin.by == "timeline" and step > entry.plan.step else None,
    )


def _table(to: NewService) -> dict[str, Any]:
    """As in the file."""
    return {**to.model_dump(mode="json", exclude_none=True, exclude={"options"}), **to.options}


def _name(entry: _Pending) -> str:
    return entry.role.name if entry.role is not None else "the service"


def _nobody(role: RoleSpec) -> None:
    raise RunFailed(f"nobody can start {role.name}")
