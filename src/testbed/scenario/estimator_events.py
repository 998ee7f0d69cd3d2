"""Events of estimators: who gives the estimates of which name."""

from __future__ import annotations

from typing import Annotated, Literal, get_args

from pydantic import BeforeValidator, Discriminator, Field, Tag

from testbed.scenario.base import problem, shown
from testbed.scenario.estimators import Name, NewService
from testbed.scenario.moments import AnyEvent

HandOver = Literal["cold", "moments", "full"]


def _service(value: object) -> object:
    if not isinstance(value, str | dict | NewService):
        raise problem(
            f"got {shown(value)}; allowed: a table with the kind of the new estimator, or the name of one that runs"
        )
    return value


def _form(value: object) -> str:
    return "name" if isinstance(value, str) else "table"


Successor = Annotated[
    Annotated[NewService, Tag("table")] | Annotated[Name, Tag("name")],
    Discriminator(_form),
    BeforeValidator(_service),
]


class SwapEvent(AnyEvent):
    """Another service gives the estimates of a name from that step on."""

    action: Literal["swap"] = Field(description="Another service takes over an estimator.")
    estimator: Name = Field(description="The name whose estimates it gives from then on.")
    to: Successor = Field(
        description="The new estimator as a table with its kind, or the name of one that runs, such as a shadow."
    )
    handover: HandOver | None = Field(
        default=None,
        description="What it starts from: the prior, the mean and covariance (if left out), or the whole state of the "
        "old one. Not with the name of one that runs.",
    )


class AddEvent(AnyEvent):
    """A further estimator from that step on; it knows the prior and no more."""

    action: Literal["add"] = Field(description="A further estimator.")
    estimator: Name = Field(description="Its name in the results; one of its own.")
    to: NewService = Field(description="What it is: a table with its kind.")


class ShadowEvent(AnyEvent):
    """An estimator beside one that runs, with its knowledge, under a name of its own; a swap may promote it."""

    action: Literal["shadow"] = Field(description="An estimator beside one that runs.")
    estimator: Name = Field(description="The one beside which it runs.")
    name: Name = Field(description="Its name in the results; one of its own.")
    to: NewService = Field(description="What it is: a table with its kind.")
    handover: HandOver | None = Field(
        default=None, description="What it starts from, as in a swap; the other one goes on."
    )


class RemoveEvent(AnyEvent):
    """An estimator leaves; the step before is its last."""

    action: Literal["remove"] = Field(description="An estimator leaves.")
    estimator: Name = Field(description="Which one.")


class AcksEvent(AnyEvent):
    """ACKs are switched on or off: each estimator is swapped for one like it, with all that it knows."""

    action: Literal["acks"] = Field(description="ACKs on or off.")
    estimator: Name | None = Field(default=None, description="Which estimator; left out: all that run.")
    acks: Literal["none", "perfect", "link"] = Field(
        description="What it is told of the control packets from then on: nothing, everything at once, or what comes "
        "over [links.ack], which then has mode 'link'."
    )


EstimatorEvent = SwapEvent | AddEvent | ShadowEvent | RemoveEvent | AcksEvent
ESTIMATOR_EVENTS: tuple[type[EstimatorEvent], ...] = get_args(EstimatorEvent)
