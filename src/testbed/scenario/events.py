"""The timeline of a run: what changes at which step."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from testbed.scenario.base import COUNT_MAX, Part, problem, shown
from testbed.scenario.durations import format_duration, parse_duration


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


class LinkEvent(Part):
    """Some keys of a link get other values, for the packets sent at that step or later."""

    at: Annotated[int | str, BeforeValidator(_moment)] = Field(
        description="When: a step k, or a duration since the start; then the first step that is not earlier."
    )
    action: Literal["set"] = Field(description="What happens; set: keys of a link get other values.")
    link: Literal["control", "observation", "ack"] = Field(description="Which link.")
    set: Annotated[dict[str, Any], BeforeValidator(_table)] = Field(
        description="The keys of the link's table and their new values; 'none' removes a stage."
    )

    def step(self, period_ns: int) -> int:
        """The first step at which it holds: for y_k and the ACK of step k, and for u_k."""
        return self.at if isinstance(self.at, int) else -(-parse_duration(self.at, zero=True) // period_ns)
