"""What befalls a TCP connection besides delay: it stalls, or it is reset."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from testbed.errors import UsageError
from testbed.scenario.durations import format_duration, parse_duration


@dataclass(frozen=True)
class Outage:
    """From ``at_ns`` on and for ``for_ns``: nothing is handed on ("stall"), or connections are refused ("reset")."""

    kind: Literal["stall", "reset"]
    at_ns: int
    for_ns: int

    def __str__(self) -> str:
        return f"{self.kind} at {format_duration(self.at_ns)} for {format_duration(self.for_ns)}"


def outage(kind: Literal["stall", "reset"], text: str) -> Outage:
    """Read "5 s + 500 ms": when, and for how long. Raises UsageError."""
    at, _, length = text.partition("+")
    try:
        return Outage(kind, parse_duration(at, zero=True), parse_duration(length, zero=kind == "reset"))
    except ValueError:
        raise UsageError(
            f"--{kind} {text}: when and for how long is not clear; allowed: AT+FOR, such as '5 s + 500 ms'"
        ) from None
