"""Changes of estimators in real time: told ahead, for the clock does not stand still.

The step s of a change is fixed so far ahead that everybody can know it. First the service in charge is told to hand
over its state after step s − 1 and to hold back its later estimates; then the new one to begin from that state. When
the new one has begun, the old one is told to leave. Where the new one refuses or is lost before, the old one is told to
stay, and publishes what it has held back. Who does not hear in time says so, and the change is made a little later.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from testbed.errors import UsageError
from testbed.orchestrator.collect import Collector
from testbed.orchestrator.pacing import Pacing
from testbed.orchestrator.services import START_S, Services, _Pending
from testbed.orchestrator.summary import Downtime
from testbed.wire.ahead import Ahead, Word, unpack
from testbed.wire.bus import Bus
from testbed.wire.handover import Order
from testbed.wire.setup import Setup

_LEAD_NS = 50_000_000
"""From the first word of a change to its step, at least."""
_LEAD_STEPS = 3
_PATIENCE_S = 1.0
"""So long after its step a service that has not begun is given up; the estimates are late until then."""
_SPARE = 8
"""Services that are started before the run begins, so many at most."""
_WATCHED = 10
"""Estimates after a change whose lateness is told."""


@dataclass
class _Talk:
    """What is being agreed on one change. old, new: the roles; number: of the order whose word is awaited."""

    entry: _Pending
    step: int
    old: str | None
    new: str | None
    number: int = -1
    asked: str = ""
    agreed: bool = False
    """The old one hands over, and holds back."""
    counted: bool = False
    """The estimates of the new one are expected."""
    last_before: int | None = None
    """The last step of the name before that; None where it was not there."""
    since_s: float = field(default_factory=time.monotonic)
    given_up: str | None = None
    """Why; its process is being ended."""


class ServicesInTime(Services):
    """As ``Services``, while the clock goes on."""

    def __init__(
        self, bus: Bus, setup: Setup, collector: Collector, say: Callable[[str], None], pacing: Pacing
    ) -> None:
        super().__init__(bus, setup, collector, say)
        self._pacing = pacing
        self._talks: dict[int, _Talk] = {}
        self._handed: dict[str, dict[tuple[int, int], bytes]] = {}
        """By new role: the states that it was handed, by step and first lane."""
        self._untold: dict[str, _Talk] = {}
        """Of new services that have begun: not all they were handed is known here."""
        self._numbers = 0
        period_ns = setup.scenario.clock.period_ns
        self._lead_ns = max(_LEAD_NS, _LEAD_STEPS * period_ns)
        self._early = START_S * 1e9 / period_ns
        for turns in self.turns.values():
            self._listen(turns[0].role)

    def all_are_there(self) -> bool:
        """Whether the services of the first changes are there, or refused; started later they take time from others."""
        for entry in list(self.pending[:_SPARE]):
            if entry.launched_s is None and self._needs_service(entry):
                self._launch(entry, time.monotonic())
        return all(entry.present for entry in self.pending if entry.launched_s is not None)

    def deciding(self, role: str) -> bool:
        return any(talk.new == role and talk.asked == "begin" for talk in self._talks.values())

    def swaps(self) -> tuple[Downtime, ...]:
        out = []
        for entry in self.happened:
            name = entry.estimator if entry.action != "shadow" else entry.name
            if entry.ok and entry.action != "remove" and name is not None:
                late_ms, missed = self._pacing.times.after(name, entry.step, _WATCHED)
                name = entry.estimator or name
                out.append(Downtime(step=entry.step, estimator=name, ms=0.0, late_ms=late_ms, missed=missed))
        return tuple(out)

    def proceed(self, granted: int, estimated: int) -> bool:
        """Launch what is due, and begin to agree on what is near; whether any was decided."""
        before = len(self.pending)
        self._launch_due(0, estimated)
        soonest = self._pacing.due_in(self._lead_ns) + 1
        near = self._pacing.due_in(2 * self._lead_ns) + 1
        for entry in list(self.pending):
            if id(entry) in self._talks or (self._needs_service(entry) and not entry.present):
                continue
            if (entry.step or 0) <= near and not self._must_wait(entry):
                self._open(entry, max(entry.step or 0, soonest))
        return len(self.pending) < before

    def overdue(self, deadline_s: float) -> bool:
        """As there; and end the process of what does not begin."""
        period_s, now = self._setup.scenario.clock.period_ns / 1e9, time.monotonic()
        for talk in self._talks.values():
            over = now - talk.since_s > _PATIENCE_S + 2 * self._lead_ns / 1e9 + period_s
            if over and talk.given_up is None and talk.entry.role is not None:
                talk.given_up = f"{talk.entry.role.name} did not begin within {_PATIENCE_S:g} s"
                self.drop(talk.entry.role.name)
        return super().overdue(deadline_s)

    def lost(self, role: str, reason: str) -> bool:
        """As there; a change of one that is lost on the way is put off until it is back."""
        entry = self._of(role)
        if entry is None:
            for affected in [talk for talk in self._talks.values() if role in (talk.old, talk.new)]:
                if role == affected.new or not self._is_handed(affected):
                    self._put_off(affected)
            return False
        own = self._talks.get(id(entry))
        return super().lost(role, reason if own is None else own.given_up or reason)

    def give_up(self) -> None:
        """The run is over: what has not happened will not."""
        for entry in list(self.pending):
            if entry.origin.by != "timeline" or self._collector.finished:
                self._refuse(entry, "the run was over before")

    def _ahead(self, now: float, estimated: int) -> float:
        return self._early

    def _listen(self, role: str) -> None:
        self._bus.subscribe(self._keys.said(role), partial(self._said, role))
        self._bus.subscribe(self._keys.handed(role), partial(self._is_given, role))

    def _is_given(self, role: str, _: str, payload: bytes) -> None:
        """A role is handed a state: it is to have that again should it be lost."""
        handed, data = unpack(payload)
        self._handed.setdefault(role, {})[handed.step, handed.lane] = data
        if role in self._untold:
            self._tell_origin(self._untold[role])

    def _is_handed(self, talk: _Talk) -> bool:
        states = self._handed.get(talk.new or "", {})
        return all((talk.step - 1, lane) in states for lane, _ in self._setup.blocks)

    def _tell_origin(self, talk: _Talk) -> None:
        """Say from what a new service has begun, once that is known."""
        plan, to, done = talk.entry.plan, talk.entry.role, talk.step - 1
        assert to is not None
        assert plan.spec is not None
        if talk.old is not None and not self._is_handed(talk):
            self._untold[to.name] = talk
            return
        self._untold.pop(to.name, None)
        form, states = plan.handover or "cold", self._handed.pop(to.name, {})
        orders = [
            (Order(action="take", step=done, lane=lane, form=form), states.get((done, lane), b""))
            for lane, _ in self._setup.blocks
        ]
        self.taken(to, plan.spec, done, orders)

    def _must_wait(self, entry: _Pending) -> bool:
        """Whether another change is to be made first, or is being made, of what this one builds on."""
        place = self.pending.index(entry)
        at = entry.step or self._pacing.due_in(self._lead_ns)
        for i, other in enumerate(self.pending):
            before = id(other) in self._talks or (i < place and (other.step or 0) <= at)
            if before and other is not entry and _changed(other) & _used(entry):
                return True
        return False

    def _open(self, entry: _Pending, step: int) -> None:
        """Begin to agree on a change at a step."""
        plan = entry.plan
        entry.step = step
        if step > self._setup.scenario.steps:
            self._refuse(entry, "the run had no step left")
            return
        try:
            self._check_still_there(plan)
        except UsageError as error:
            self._refuse(entry, str(error))
            return
        old = self._serving(plan.source.name) if plan.source is not None else None
        new = entry.role.name if entry.role is not None else None
        if plan.promoted is not None:
            new = self._serving(plan.promoted)
        talk = self._talks[id(entry)] = _Talk(entry, step, old, new)
        if plan.event.action == "remove":
            self._tell(talk, old, "leave")
        elif old is None:
            self._let_begin(talk)
        else:
            self._tell(talk, old, "hand", form=plan.handover or "cold", to=new, stop=plan.replaces)

    def _said(self, role: str, _: str, payload: bytes) -> None:
        """A word of a service."""
        word = Word.model_validate_json(payload)
        talk = next((talk for talk in self._talks.values() if talk.number == word.number), None)
        if talk is None:
            return
        if word.state == "refused":
            self._refuse(talk.entry, word.detail)
        elif word.state == "late":
            self._put_off(talk)
        elif word.state == "begun":
            self._begun(talk, word.bytes)
        elif talk.asked == "hand":
            talk.agreed = True
            self._let_begin(talk)
        elif talk.asked == "leave":
            self._end_at(talk)
        elif talk.asked == "serve":
            self._expect(talk)
        self.proceed(0, self._collector.estimated)

    def _let_begin(self, talk: _Talk) -> None:
        if self._collector.completed >= talk.step:
            self._put_off(talk)
        elif talk.entry.plan.promoted is not None:
            self._tell(talk, talk.new, "serve", name=talk.entry.plan.name)
        else:
            self._expect(talk)
            self._tell(talk, talk.new, "begin", form=talk.entry.plan.handover or "cold", handed=talk.old is not None)

    def _begun(self, talk: _Talk, size: int) -> None:
        """The new one serves."""
        del self._talks[id(talk.entry)]
        if talk.entry.role is not None:
            self._tell_origin(talk)
        elif talk.new is not None:
            self._handed.pop(talk.new, None)
            self.served(talk.new, Order(action="serve", step=talk.step - 1, name=talk.entry.plan.name))
        if talk.entry.plan.replaces and talk.old is not None:
            self.leaves(talk.old)
            self._tell(talk, talk.old, "leave")
        self._settle(talk.entry, talk.step, size)
        if talk.entry.origin.by == "timeline" and talk.step > talk.entry.plan.step:
            self._say(f"step {talk.step}: {self.happened[-1].text}")

    def _end_at(self, talk: _Talk) -> None:
        """The old one leaves after the step before, and none comes in its place."""
        del self._talks[id(talk.entry)]
        assert talk.old is not None
        self.leaves(talk.old)
        self._count_on(talk.entry, talk.step)
        self._settle(talk.entry, talk.step, 0)

    def _expect(self, talk: _Talk) -> None:
        """Let the estimates of the new one count from the step on."""
        plan = talk.entry.plan
        assert plan.spec is not None
        assert talk.new is not None
        name = plan.spec.name
        talk.counted, talk.last_before = True, self.last.get(name)
        self._count_on(talk.entry, talk.step)
        self._pacing.times.serve(name, talk.new, talk.step, self.last[name])

    def _take_back(self, talk: _Talk) -> None:
        """Nobody has begun: all is as it was."""
        plan = talk.entry.plan
        assert plan.spec is not None
        name = plan.spec.name
        self.turns[name].pop()
        if talk.last_before is not None:
            self.last[name] = talk.last_before
            self._collector.expect(name, 0, self.last[name])
            self._pacing.times.serve(name, self._serving(name), 0, self.last[name])
        else:
            del self.turns[name], self.last[name]
            self._collector.forget(name)
            self._pacing.times.forget(name)

    def _end(self, name: str, last: int) -> None:
        super()._end(name, last)
        self._pacing.times.ends(name, self.last[name])

    def _put_off(self, talk: _Talk) -> None:
        """Somebody has heard too late."""
        self._undo(talk)
        talk.entry.step = talk.step + 1

    def _undo(self, talk: _Talk) -> None:
        del self._talks[id(talk.entry)]
        if talk.counted:
            self._take_back(talk)
        if talk.agreed:
            self._tell(talk, talk.old, "stay", to=talk.new)
        if talk.asked == "serve":
            self._tell(talk, talk.new, "stay")

    def _refuse(self, entry: _Pending, reason: str) -> None:
        talk = self._talks.get(id(entry))
        if talk is not None:
            self._undo(talk)
        super()._refuse(entry, reason)

    def _tell(self, talk: _Talk, role: str | None, action: Any, **more: Any) -> None:
        assert role is not None
        self._numbers += 1
        talk.number, talk.asked = self._numbers, action
        order = Ahead(action=action, number=talk.number, step=talk.step - 1, **more)
        self._bus.publisher(self._keys.told(role))(order.model_dump_json().encode())


def _changed(entry: _Pending) -> set[str]:
    """The names whose services another change must not build on while this one is made."""
    plan = entry.plan
    new = {plan.name}
    return new | ({plan.promoted} if plan.promoted is not None else set())


def _used(entry: _Pending) -> set[str]:
    plan = entry.plan
    return _changed(entry) | ({plan.source.name} if plan.source is not None else set())
