"""Delay laws: from a uniform draw to a delay in ns, by the inverse of the distribution function."""

from __future__ import annotations

import math
from collections.abc import Callable
from statistics import NormalDist

from testbed.scenario.durations import UNITS_NS, parse_duration
from testbed.scenario.impairments import ConstantDelay, Delay, LogNormalDelay, NormalDelay, TableDelay, UniformDelay

Law = Callable[[float], int]
"""From u, uniform on [0, 1), to ns."""

_HALF = 2.0**-54
_BELOW_ONE = 1.0 - 2.0**-53
_STANDARD = NormalDist()


def law_of(delay: Delay) -> Law:
    """The quantile function of a delay, in whole ns."""
    if isinstance(delay, ConstantDelay):
        by = _ns(delay.by)
        return lambda _: by
    if isinstance(delay, UniformDelay):
        low, width = _ns(delay.low), _ns(delay.high) - _ns(delay.low)
        return lambda u: low + round(u * width)
    if isinstance(delay, NormalDelay):
        return _cut_normal(_ns(delay.mean), _ns(delay.std), _ns(delay.minimum))
    if isinstance(delay, LogNormalDelay):
        return _log_normal(_ns(delay.median), delay.sigma, _ns(delay.minimum))
    return _empirical(delay)


def cdf_of(delay: Delay) -> Callable[[int], float]:
    """P(delay ≤ ns): the distribution function that ``law_of`` inverts, but for rounding to whole ns."""
    if isinstance(delay, ConstantDelay):
        by = _ns(delay.by)
        return lambda ns: float(ns >= by)
    if isinstance(delay, UniformDelay):
        low, high = _ns(delay.low), _ns(delay.high)
        return lambda ns: float(ns >= low) if low == high else min(1.0, max(0.0, (ns - low) / (high - low)))
    if isinstance(delay, NormalDelay):
        mean, std, least = _ns(delay.mean), _ns(delay.std), _ns(delay.minimum)
        above = _below((mean - least) / std)
        return lambda ns: 0.0 if ns < least else 1.0 - _below((mean - ns) / std) / above
    if isinstance(delay, LogNormalDelay):
        median, sigma, least = _ns(delay.median), delay.sigma, _ns(delay.minimum)
        if sigma == 0.0:
            return lambda ns: float(ns >= least + median)
        return lambda ns: 0.0 if ns <= least else _below(math.log((ns - least) / median) / sigma)
    values = sorted(_values(delay))
    return lambda ns: sum(value <= ns for value in values) / len(values)


def _ns(text: str) -> int:
    return parse_duration(text, zero=True)


def _below(z: float) -> float:
    """P(a standard normal is at most z), to the last digits in both tails."""
    return 0.5 * math.erfc(-z / math.sqrt(2.0))


def _cut_normal(mean: int, std: int, least: int) -> Law:
    """Drawn from the lower tail of the mirrored law: so near 1 a probability has too few digits to be inverted."""
    inverse, above = _STANDARD.inv_cdf, min(_BELOW_ONE, _below((mean - least) / std))
    return lambda u: max(least, round(mean - std * inverse(above * (1.0 - u - _HALF))))


def _log_normal(median: int, sigma: float, least: int) -> Law:
    inverse, exp = _STANDARD.inv_cdf, math.exp

    def law(u: float) -> int:
        z = inverse(u + _HALF) if u < 0.5 else -inverse(1.0 - u - _HALF)
        return least + round(median * exp(sigma * z))

    return law


def _values(delay: TableDelay) -> list[int]:
    unit = UNITS_NS[delay.unit]
    return [round(value * unit) for value in delay.values]


def _empirical(delay: TableDelay) -> Law:
    values = sorted(_values(delay))
    count = len(values)
    return lambda u: values[int(u * count)]
