"""Figures as text, the same in the report and in the terminal."""

from __future__ import annotations

import math

from testbed.orchestrator.realtime_figures import Quantiles

ABSENT = "—"


def number(value: float | None, digits: int = 4) -> str:
    """`value` to `digits` significant digits; a dash for a figure that does not exist."""
    if value is None:
        return ABSENT
    if value == 0:
        return "0"
    mantissa, _, exponent = f"{value:#.{digits}g}".partition("e")
    mantissa = mantissa.removesuffix(".")
    return _times_ten(mantissa, exponent) if exponent else mantissa


def plus_minus(value: float | None, stderr: float | None) -> str:
    """`value ± stderr`, the error to two significant digits and the value to the same place."""
    if value is None or stderr is None or stderr <= 0:
        return number(value)
    largest = max(abs(value), stderr)
    exponent = math.floor(math.log10(largest))
    exponent = 0 if -3 <= exponent <= 5 else exponent
    places = min(max(0, 1 - math.floor(math.log10(stderr)) + exponent), 9)
    value, stderr = _shifted(value, exponent), _shifted(stderr, exponent)
    if exponent == 0:
        return f"{value:.{places}f} ± {stderr:.{places}f}"
    return _times_ten(f"({value:.{places}f} ± {stderr:.{places}f})", str(exponent))


def micros(quantiles: Quantiles) -> str:
    """Median, 90 %, 99 % and the largest, in whole microseconds."""
    values = (quantiles.p50, quantiles.p90, quantiles.p99, quantiles.max)
    return " · ".join(ABSENT if value is None else count(round(value)) for value in values)


def share(value: float | None) -> str:
    """A share as a percentage."""
    return ABSENT if value is None else f"{100 * value:.0f} %"


def band(limits: tuple[float, float] | None) -> str:
    """An interval."""
    return ABSENT if limits is None else f"[{number(limits[0], 3)}, {number(limits[1], 3)}]"


def steps(first: int, last: int) -> str:
    """A range of steps."""
    return f"{last}" if first == last else f"{first}–{last}"


def count(value: int) -> str:
    """An integer with thin spaces between the thousands."""
    return f"{value:,}".replace(",", "\u2009")


def plural(value: int, noun: str) -> str:
    """`value` and its noun."""
    return f"{count(value)} {noun}" + ("" if value == 1 else "s")


def _shifted(value: float, exponent: int) -> float:
    """value / 10^exponent, in two halves: 10^308 and 10^-308 have no inverse of the same size."""
    half = exponent // 2
    return value / 10.0**half / 10.0 ** (exponent - half)


def _times_ten(mantissa: str, exponent: str) -> str:
    superscript = str(int(exponent)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"{mantissa}·10{superscript}"
