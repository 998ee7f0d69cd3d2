"""The timeline of a run: what happens at which step."""

from __future__ import annotations

from typing import Annotated, Any, Literal, get_args

from pydantic import BeforeValidator, Discriminator, Field, Tag

from testbed.scenario.base import COUNT_MAX, Part, problem, shown
from testbed.scenario.durations import format_duration, parse_duration
from testbed.scenario.estimators import Name, NewService

HandOver = Literal["cold", "moments", "full"]


def _moment(value: object) -> int | str:
    if isinstance(value, str):
        return format_duration(parse_duration(value, zero=True))
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= COUNT_MAX:
        raise problem(f"got {shown(value)}; allowed: a step, 0 or more, or a duration such as '500 ms'")
    return value


def _table(value: object) -> dict[str, Any]:
    if not isinstance(value, dict) or not value:
        raise problem(f"got {shown(value)}; allowed: a table with keys of the link, such as {{ loss.failure = 0.4 }}")
    return value


class _Event(Part):
    at: Annotated[int | str, BeforeValidator(_moment)] = Field(
        description="When: a step k, or a duration since the start; then the first step that is not earlier."
    )

    def step(self, period_ns: int) -> int:
        """The first step at which it holds: for y_k and the ACK of step k, for u_k, and for the estimates of step k."""
        return self.at if isinstance(self.at, int) else -(-parse_duration(self.at, zero=True) // period_ns)


class LinkEvent(_Event):
    """Some keys of a link get other values, for the packets sent at that step or later."""

    action: Literal["set"] = Field(description="Keys of a link get other values.")
    link: Literal["control", "observation", "ack"] = Field(description="Which link.")
    set: Annotated[dict[str, Any], BeforeValidator(_table)] = Field(
        description="The keys of the link's table and their new values; 'none' removes a stage."
    )


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


class SwapEvent(_Event):
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


class AddEvent(_Event):
    """A further estimator from that step on; it knows the prior and no more."""

    action: Literal["add"] = Field(description="A further estimator.")
    estimator: Name = Field(description="Its name in the results; one of its own.")
    to: NewService = Field(description="What it is: a table with its kind.")


class ShadowEvent(_Event):
    """An estimator beside one that runs, with its knowledge, under a name of its own; a swap may promote it."""

    action: Literal["shadow"] = Field(description="An estimator beside one that runs.")
    estimator: Name = Field(description="The one beside which it runs.")
    name: Name = Field(description="Its name in the results; one of its own.")
    to: NewService = Field(description="What it is: a table with its kind.")
    handover: HandOver | None = Field(
        default=None, description="What it starts from, as in a swap; the other one goes on."
    )


class RemoveEvent(_Event):
    """An estimator leaves; the step before is its last."""

    action: Literal["remove"] = Field(description="An estimator leaves.")
    estimator: Name = Field(description="Which one.")


EstimatorEvent = SwapEvent | AddEvent | ShadowEvent | RemoveEvent
ESTIMATOR_EVENTS: tuple[type[EstimatorEvent], ...] = get_args(EstimatorEvent)
Event = Annotated[
    LinkEvent | SwapEvent | AddEvent | ShadowEvent | RemoveEvent,
    Field(discriminator="action"),
]
