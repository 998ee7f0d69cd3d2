"""The timeline of a run: what happens at which step. Those of estimators and of the plant have files of their own."""

from __future__ import annotations

from typing import Annotated, Any, Literal, get_args

from pydantic import BeforeValidator, Field

from testbed.scenario.base import problem, shown
from testbed.scenario.durations import Duration
from testbed.scenario.estimator_events import (
    AcksEvent,
    AddEvent,
    RemoveEvent,
    ShadowEvent,
    SwapEvent,
)
from testbed.scenario.estimators import Name
from testbed.scenario.moments import AnyEvent
from testbed.scenario.plant_events import InputEvent, PlantEvent

LinkName = Literal["control", "observation", "ack"]
LABEL_PATTERN = r"^[^\x00-\x1f\x7f]+$"


def _table(value: object) -> dict[str, Any]:
    if not isinstance(value, dict) or not value:
        raise problem(f"got {shown(value)}; allowed: a table with keys of the link, such as {{ loss.failure = 0.4 }}")
    return value


class LinkEvent(AnyEvent):
    """Some keys of a link get other values, for the packets sent at that step or later."""

    action: Literal["set"] = Field(description="Keys of a link get other values.")
    link: LinkName = Field(description="Which link.")
    set: Annotated[dict[str, Any], BeforeValidator(_table)] = Field(
        description="The keys of the link's table and their new values; 'none' removes a stage."
    )


def _which(value: object) -> object:
    names = get_args(LinkName)
    if not isinstance(value, list | tuple) or not value or any(entry not in names for entry in value):
        raise problem(f"got {shown(value)}; allowed: a list of {', '.join(names)}; left out: all")
    if len(set(value)) < len(value):
        raise problem(f"got {shown(value)}; allowed: each link once")
    return tuple(value)


_Links = Annotated[tuple[LinkName, ...], BeforeValidator(_which)]


class PartitionEvent(AnyEvent):
    """Nothing gets through some links, until they are healed."""

    action: Literal["partition"] = Field(description="Links are cut.")
    links: _Links | None = Field(default=None, description="Which links; left out: all of the run.")


class HealEvent(AnyEvent):
    """Links that were cut carry packets again; their losses go on as if they had not been cut."""

    action: Literal["heal"] = Field(description="Links are whole again.")
    links: _Links | None = Field(default=None, description="Which links; left out: all that are cut.")


class MarkEvent(AnyEvent):
    """A mark in the results; it changes nothing."""

    action: Literal["mark"] = Field(description="A mark in the results.")
    name: str = Field(min_length=1, max_length=64, pattern=LABEL_PATTERN, description="What it says, on one line.")


class SnapshotEvent(AnyEvent):
    """The whole state of an estimator goes into a file of the run: the one from which that step goes on."""

    action: Literal["snapshot"] = Field(description="The state of an estimator is written down.")
    estimator: Name = Field(description="Which estimator.")
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")] | None = Field(
        default=None, description="The file is snapshots/NAME-STEP.bin; left out: the name of the estimator."
    )


class KillEvent(AnyEvent):
    """A process is killed before that step, with all estimates before it there."""

    action: Literal["kill"] = Field(description="A process is killed.")
    role: str = Field(description="Its role, such as 'plant', 'link.control' or 'estimator.aoe'.")


class PauseEvent(AnyEvent):
    """A process stands still for a while on the wall clock."""

    action: Literal["pause"] = Field(description="A process is stopped and continued.")
    role: str = Field(description="Its role, such as 'plant', 'link.control' or 'estimator.aoe'.")
    lasts: Duration = Field(alias="for", description="How long.")


class RestartEvent(AnyEvent):
    """A process is ended and started anew."""

    action: Literal["restart"] = Field(description="A process is ended and started anew.")
    role: str = Field(description="Its role, such as 'plant', 'link.control' or 'estimator.aoe'.")


CutEvent = PartitionEvent | HealEvent
ProcessEvent = KillEvent | PauseEvent | RestartEvent
PROCESS_EVENTS: tuple[type[ProcessEvent], ...] = get_args(ProcessEvent)
Event = Annotated[
    LinkEvent
    | SwapEvent
    | AddEvent
    | ShadowEvent
    | RemoveEvent
    | AcksEvent
    | PartitionEvent
    | HealEvent
    | InputEvent
    | PlantEvent
    | MarkEvent
    | SnapshotEvent
    | KillEvent
    | PauseEvent
    | RestartEvent,
    Field(discriminator="action"),
]
