"""Which estimators there are along a run: those of the scenario, and what its events make of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from testbed.errors import did_you_mean
from testbed.scenario.base import problem, shown
from testbed.scenario.estimator_events import (
    AcksEvent,
    AddEvent,
    EstimatorEvent,
    HandOver,
    RemoveEvent,
    ShadowEvent,
    SwapEvent,
)
from testbed.scenario.estimators import EstimatorSpec


@dataclass(frozen=True)
class Planned:
    """One event of estimators, resolved; that of ACKs gives one for each estimator.

    step: the first at which it holds, 1 or more. name: whose estimates it is about. spec: the estimator that begins,
    under the name of its results; None where none does. source: the one from which it is handed the knowledge, or which
    leaves; None where there is none. promoted: the name under which it has run until then. place: its event's among
    all.
    """

    event: EstimatorEvent
    name: str
    step: int
    spec: EstimatorSpec | None
    source: EstimatorSpec | None
    handover: HandOver | None
    promoted: str | None = None
    place: int = 0

    @property
    def replaces(self) -> bool:
        """Whether another service goes on with the name."""
        return isinstance(self.event, SwapEvent | AcksEvent)


def planned(
    specs: Sequence[EstimatorSpec],
    events: Sequence[tuple[EstimatorEvent, int]],
    *,
    steps: int,
    followed: str | None,
    places: Sequence[int] | None = None,
) -> list[Planned]:
    """The events in the order of time; ``events``: each with its step; ``followed``: the estimator of a closed loop.

    places: where each event stands among all. Raises a problem of validation, with the place below the events, where
    one does not fit what is there by then.
    """
    walk = _Walk({spec.name: spec for spec in specs}, steps, followed)
    order = sorted(range(len(events)), key=lambda i: events[i][1])
    out: list[Planned] = []
    for i in order:
        place = i if places is None else places[i]
        plans = walk.take(events[i][0], max(1, events[i][1]), f"[{place}]")
        out += [replace(plan, place=place) for plan in plans]
    return out


class _Walk:
    def __init__(self, now: dict[str, EstimatorSpec], steps: int, followed: str | None) -> None:
        self._now, self._steps, self._followed = now, steps, followed
        self._names = set(now)
        self._touched: dict[str, int] = {}

    def take(self, event: EstimatorEvent, step: int, at: str) -> list[Planned]:
        if (isinstance(event.at, int) and not 1 <= event.at <= self._steps) or step > self._steps:
            raise problem(
                f"got {shown(event.at)}; allowed: a step 1 … {self._steps}, those of the scenario", f"{at}.at"
            )
        if isinstance(event, AcksEvent):
            return self._switch(event, step, at)
        return [self._take_one(event, step, at)]

    def _take_one(self, event: AddEvent | ShadowEvent | RemoveEvent | SwapEvent, step: int, at: str) -> Planned:
        if isinstance(event, AddEvent):
            spec = self._begin(event.estimator, event.to.named(event.estimator), step, f"{at}.estimator", f"{at}.to")
            return Planned(event, spec.name, step, spec, None, "cold")
        source = self._there(event.estimator, step, f"{at}.estimator")
        if isinstance(event, ShadowEvent):
            spec = self._begin(event.name, event.to.named(event.name, source), step, f"{at}.name", f"{at}.to")
            return Planned(event, spec.name, step, spec, source, event.handover or "moments")
        self._once(event.estimator, step, f"{at}.estimator")
        if isinstance(event, RemoveEvent):
            self._not_followed(event.estimator, f"{at}.estimator")
            del self._now[event.estimator]
            return Planned(event, event.estimator, step, None, source, None)
        return self._swap(event, source, step, at)

    def _switch(self, event: AcksEvent, step: int, at: str) -> list[Planned]:
        """Each estimator is swapped for one like it."""
        names = sorted(name for name, spec in self._now.items() if spec.until is None or step <= spec.until)
        out = []
        for name in names if event.estimator is None else [event.estimator]:
            source = self._there(name, step, f"{at}.estimator")
            self._once(name, step, f"{at}.estimator")
            spec = source.model_copy(update={"acks": None if event.acks == "link" else event.acks})
            self._now[name] = spec
            out.append(Planned(event, name, step, spec, source, "full"))
        return out

    def _swap(self, event: SwapEvent, source: EstimatorSpec, step: int, at: str) -> Planned:
        if not isinstance(event.to, str):
            spec = event.to.named(event.estimator, source)
            self._until(spec, step, f"{at}.to")
            self._now[event.estimator] = spec
            return Planned(event, spec.name, step, spec, source, event.handover or "moments")
        if event.handover is not None:
            raise problem(f"got {event.handover!r}; allowed: none, for {event.to!r} has a state", f"{at}.handover")
        promoted = self._there(event.to, step, f"{at}.to")
        if event.to == event.estimator:
            raise problem(f"got {event.to!r}, the estimator itself; allowed: another one that runs", f"{at}.to")
        self._not_followed(event.to, f"{at}.to")
        self._once(event.to, step, f"{at}.to")
        spec = promoted.model_copy(update={"name": event.estimator})
        self._until(spec, step, f"{at}.to")
        del self._now[event.to]
        self._now[event.estimator] = spec
        return replace(Planned(event, spec.name, step, spec, source, None), promoted=event.to)

    def _there(self, name: str, step: int, at: str) -> EstimatorSpec:
        spec = self._now.get(name)
        if spec is None:
            names = sorted(self._now)
            there = ", ".join(names) if names else "none is there"
            raise problem(f"got {name!r}; allowed at step {step}: {there}{did_you_mean(name, names)}", at)
        if spec.until is not None and step > spec.until + 1:
            raise problem(f"got {name!r}, which ends at step {spec.until}; allowed: one that runs at step {step}", at)
        return spec

    def _begin(self, name: str, spec: EstimatorSpec, step: int, at: str, at_spec: str) -> EstimatorSpec:
        if name in self._names:
            raise problem(f"got {name!r} a second time; allowed: a name of its own", at)
        self._until(spec, step, at_spec)
        self._names.add(name)
        self._now[name] = spec
        self._touched[name] = step
        return spec

    def _until(self, spec: EstimatorSpec, step: int, at: str) -> None:
        if spec.until is not None and not step <= spec.until <= self._steps:
            raise problem(f"got {spec.until}; allowed: {step} … {self._steps}", f"{at}.until")
        if spec.until is not None and spec.until < self._steps and spec.name == self._followed:
            raise problem(f"got {spec.until}; allowed: none, for the controller follows {spec.name!r}", f"{at}.until")

    def _once(self, name: str, step: int, at: str) -> None:
        if self._touched.get(name) == step:
            raise problem(f"got {name!r} a second time at step {step}; allowed: one event of it a step", at)
        self._touched[name] = step

    def _not_followed(self, name: str, at: str) -> None:
        if name == self._followed:
            raise problem(f"got {name!r}, which the controller follows; allowed: another estimator", at)
