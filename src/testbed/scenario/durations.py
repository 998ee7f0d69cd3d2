"""Durations with units: text in the scenario, integer nanoseconds inside."""

import re
from decimal import Decimal
from typing import Annotated

from pydantic import BeforeValidator, Field

from testbed.scenario.base import problem, shown

UNITS_NS = {"ns": 1, "us": 1_000, "ms": 1_000_000, "s": 1_000_000_000, "min": 60_000_000_000}
DURATION_NS_MAX = 2**63 - 1

_NUMBER = r"[0-9]{1,19}(?:\.[0-9]{1,19})?"
_FORM = re.compile(rf"({_NUMBER})\s*([A-Za-z]+)", re.ASCII)
_ALLOWED = f"a duration with a unit ({', '.join(UNITS_NS)}), such as '10 ms'"


def parse_duration(value: object, *, zero: bool = False) -> int:
    """Nanoseconds of a text such as "10 ms", "1 s", "2.5 us", "5 min".

    Raises a problem of validation if it has no number or no unit, is not positive (zero: or zero), is no whole number
    of nanoseconds, or does not fit into 63 bits.
    """
    match = _FORM.fullmatch(value.strip()) if isinstance(value, str) else None
    if match is None or match[2] not in UNITS_NS:
        raise problem(f"got {shown(value)}; allowed: {_ALLOWED}")
    ns = Decimal(match[1]) * UNITS_NS[match[2]]
    least = 0 if zero else 1
    if ns != int(ns) or not least <= ns <= DURATION_NS_MAX:
        raise problem(f"got {shown(value)}; allowed: a whole number of nanoseconds, {least} … 2**63 - 1")
    return int(ns)


def format_duration(ns: int) -> str:
    """The shortest exact text: the largest unit that leaves a whole number."""
    if ns == 0:
        return "0 s"
    unit = max((name for name in UNITS_NS if ns % UNITS_NS[name] == 0), key=UNITS_NS.__getitem__)
    return f"{ns // UNITS_NS[unit]} {unit}"


def _canonical(value: object) -> str:
    return format_duration(parse_duration(value))


def _canonical_or_zero(value: object) -> str:
    return format_duration(parse_duration(value, zero=True))


_PATTERN = rf"^{_NUMBER}\s*({'|'.join(UNITS_NS)})$"
Duration = Annotated[str, Field(pattern=_PATTERN), BeforeValidator(_canonical)]
"""A duration as canonical text; `parse_duration` gives its nanoseconds."""
DurationOrZero = Annotated[str, Field(pattern=_PATTERN), BeforeValidator(_canonical_or_zero)]
"""The same, zero allowed."""
