"""When an event of the timeline happens: at a step, at a time, or once a condition holds."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BeforeValidator, Field, model_validator

from testbed.scenario.base import COUNT_MAX, Part, problem, shown
from testbed.scenario.durations import format_duration, parse_duration


def _moment(value: object) -> int | str:
    if isinstance(value, str):
        return format_duration(parse_duration(value, zero=True))
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= COUNT_MAX:
        raise problem(f"got {shown(value)}; allowed: a step, 0 or more, or a duration such as '500 ms'")
    return value


class AnyEvent(Part):
    """What every event has: ``at`` or ``when``."""

    at: Annotated[int | str, BeforeValidator(_moment)] | None = Field(
        default=None,
        description="When: a step k, or a duration since the start; then the first step that is not earlier. "
        "Either this or when.",
    )
    when: str | None = Field(
        default=None,
        min_length=1,
        description="When: a condition on figures of the run (see the reference of conditions). The event happens "
        "once, at the step after the first at which it holds.",
    )

    @model_validator(mode="before")
    @classmethod
    def _one_moment(cls, data: Any) -> Any:
        if isinstance(data, dict):
            given = [key for key in ("at", "when") if data.get(key) is not None]
            if len(given) != 1:
                told = "both" if given else "neither"
                raise problem(f"got {told} of at and when; allowed: exactly one of them", "at")
        return data

    @property
    def timed(self) -> bool:
        """Whether its step is known beforehand."""
        return self.at is not None

    def step(self, period_ns: int) -> int:
        """The first step at which it holds: for y_k and the ACK of step k, for u_k, and for the estimates of step k.

        Raises ValueError for one that waits for a condition.
        """
        if self.at is None:
            raise ValueError("an event with a condition has no step beforehand")
        return self.at if isinstance(self.at, int) else -(-parse_duration(self.at, zero=True) // period_ns)
