"""Whether the events of a timeline fit the rest of the scenario."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pydantic_core import PydanticCustomError

from testbed.errors import UsageError, did_you_mean
from testbed.scenario.base import problem, shown
from testbed.scenario.changes import changed
from testbed.scenario.closed_loop import ClosedLoop
from testbed.scenario.conditions import Condition, Names
from testbed.scenario.drift import check_plant
from testbed.scenario.estimator_events import ESTIMATOR_EVENTS, AcksEvent, AddEvent, ShadowEvent, SwapEvent
from testbed.scenario.estimators import EstimatorSpec
from testbed.scenario.events import CutEvent, Event, LinkEvent, MarkEvent, ProcessEvent, SnapshotEvent
from testbed.scenario.inputs import Input, TableInput, check_channels
from testbed.scenario.link_timeline import LinkWalk
from testbed.scenario.links import Links
from testbed.scenario.plant_events import InputEvent, PlantEvent
from testbed.scenario.system import System
from testbed.scenario.transport import Clock

EXACT = (LinkEvent, CutEvent, InputEvent, PlantEvent, MarkEvent)
"""Those whose step is exact in real time, too: the roles know it, or nobody needs to."""


@dataclass(frozen=True)
class Surroundings:
    """What events are checked against."""

    system: System
    estimators: Sequence[EstimatorSpec]
    input: Input | None
    links: Links
    clock: Clock
    steps: int

    @classmethod
    def of(cls, source: Any) -> Surroundings | None:
        """From a scenario, or from its parts as far as they are valid; None where some are not."""
        parts: Mapping[str, Any] = source if isinstance(source, Mapping) else vars(source)
        names = cls.__dataclass_fields__
        return cls(**{name: parts[name] for name in names}) if names.keys() <= parts.keys() else None


def names_of(around: Surroundings, events: Sequence[Event]) -> Names:
    """What a condition may speak of: also the estimators that join while the run goes."""
    links = [name for name in Links.model_fields if name != "ack" or around.links.ack.mode != "none"]
    return Names(tuple(possible_names(around.estimators, events)), tuple(links), around.clock.period_ns)


def possible_names(specs: Sequence[EstimatorSpec], events: Sequence[Event]) -> list[str]:
    """The names of all estimators that there may be at some time."""
    names = [spec.name for spec in specs]
    names += [event.estimator for event in events if isinstance(event, AddEvent)]
    return [*names, *(event.name for event in events if isinstance(event, ShadowEvent))]


def check_events(events: Sequence[Event], around: Surroundings) -> None:
    """A problem of validation where an event does not fit; the order of estimators along the run is not looked at."""
    walk = LinkWalk(around.links)
    order = sorted((i for i, event in enumerate(events) if event.timed), key=lambda i: _step(events[i], around))
    for i, event in enumerate(events):
        check_event(event, around, events, f"[{i}]")
    for i in order:
        event = events[i]
        if isinstance(event, LinkEvent | CutEvent):
            walk.take(event, f"[{i}]")


def check_event(event: Event, around: Surroundings, events: Sequence[Event], at: str = "") -> None:
    """A problem of validation where one event does not fit, whatever the others do before it.

    ``events``: all of the scenario, whose estimators it may name.
    """
    if around.clock.mode == "real" and isinstance(event, SnapshotEvent):
        raise problem("got 'snapshot' with clock mode 'real', which does not stand still for it", f"{at}.action")
    if event.timed:
        _check_step(event, around, at)
    else:
        _check_condition(event, around, events, at)
    if isinstance(event, InputEvent):
        _check_input(event, around, at)
    elif isinstance(event, PlantEvent):
        try:
            check_plant(around.system, event)
        except UsageError as error:
            raise problem(str(error), at) from None
    elif isinstance(event, SnapshotEvent):
        _check_name(event.estimator, around, events, f"{at}.estimator")
    elif isinstance(event, AcksEvent) and event.acks == "link" and around.links.ack.mode != "link":
        raise problem(f"got 'link' with mode {around.links.ack.mode!r}; allowed: none, perfect", f"{at}.acks")


def _step(event: Event, around: Surroundings) -> int:
    return event.step(around.clock.period_ns)


def _check_step(event: Event, around: Surroundings, at: str) -> None:
    if isinstance(event, ESTIMATOR_EVENTS):
        return  # looked at with the others
    step, steps = _step(event, around), around.steps
    if step > steps:
        raise problem(f"got {shown(event.at)}; allowed: at most {steps}, the steps of the scenario", f"{at}.at")
    if event.at == 0 and isinstance(event, ProcessEvent | SnapshotEvent):
        raise problem(f"got 0; allowed: a step 1 … {steps}, those of the scenario", f"{at}.at")


def _check_condition(event: Event, around: Surroundings, events: Sequence[Event], at: str) -> None:
    try:
        Condition.parse(event.when or "", names_of(around, events))
    except UsageError as error:
        raise problem(str(error), f"{at}.when") from None
    if isinstance(event, LinkEvent):
        LinkWalk(around.links)._there(event.link, f"{at}.link")
        try:
            changed(getattr(around.links, event.link), event.set)
        except UsageError as error:
            raise problem(str(error), f"{at}.set") from None
    elif isinstance(event, ESTIMATOR_EVENTS):
        _check_waiting(event, around, events, at)


def _check_waiting(event: Event, around: Surroundings, events: Sequence[Event], at: str) -> None:
    """An event of estimators whose step is not known: the names that it needs are looked for among all."""
    if not isinstance(event, AddEvent) and event.estimator is not None:  # type: ignore[union-attr]
        _check_name(event.estimator, around, events, f"{at}.estimator")  # type: ignore[union-attr]
    if isinstance(event, SwapEvent) and isinstance(event.to, str):
        _check_name(event.to, around, events, f"{at}.to")
    if isinstance(event, AddEvent | ShadowEvent):
        own, key = (event.estimator, "estimator") if isinstance(event, AddEvent) else (event.name, "name")
        if possible_names(around.estimators, events).count(own) > 1:
            raise problem(f"got {own!r} a second time; allowed: a name of its own", f"{at}.{key}")


def _check_name(name: str, around: Surroundings, events: Sequence[Event], at: str) -> None:
    names = possible_names(around.estimators, events)
    if name not in names:
        raise problem(f"got {name!r}; allowed: {', '.join(names) or 'none'}{did_you_mean(name, names)}", at)


def _check_input(event: InputEvent, around: Surroundings, at: str) -> None:
    source, system = event.input, around.system
    if isinstance(around.input, ClosedLoop):
        raise problem(f"got an input, but the loop is closed ({around.input.kind}); allowed: with open-loop inputs", at)
    if system.B is None:
        raise problem("got an input, but system.B is not given; allowed: only with system.B", at)
    try:
        check_channels(source, system)
    except PydanticCustomError as error:
        context = error.context or {}
        raise problem(context["text"], f"{at}.input.{context['at']}") from None
    if isinstance(source, TableInput) and len(source.values) < around.steps:
        raise problem(
            f"got {len(source.values)} rows; allowed: at least {around.steps}, one for each step of the run",
            f"{at}.input.values",
        )
