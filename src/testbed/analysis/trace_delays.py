"""Quantiles of delays, with intervals from order statistics that allow for correlation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binom

from testbed.analysis.correlation import correlation_time

LEVELS = (0.5, 0.9, 0.99, 0.999)


@dataclass(frozen=True)
class Quantile:
    """The least delay that a share ``level`` of the packets does not exceed, ns.

    low, high: 95 %; None where the trace is too short to bound it on that side. theory: that of a delay law, if given.
    """

    level: float
    value: int
    low: int | None
    high: int | None
    theory: int | None = None


def quantiles(delays_ns: NDArray[np.int64]) -> tuple[Quantile, ...]:
    """Of delays (n,) in the order of sending, n > 0, at LEVELS.

    Of n independent delays the number below the quantile q is binomial, which gives the ranks of the ends. Delays in a
    row are alike: then it is that of n/τ trials, τ the correlation time of "not above the quantile".
    """
    ordered = np.sort(delays_ns)
    return tuple(_quantile(delays_ns, ordered, level) for level in LEVELS)


def _quantile(delays_ns: NDArray[np.int64], ordered: NDArray[np.int64], level: float) -> Quantile:
    number = len(ordered)
    value = int(ordered[min(number - 1, int(np.ceil(level * number - 1e-9)) - 1)])
    worth = max(1, round(number / correlation_time((delays_ns <= value).astype(np.float64))))
    # P(X_(l) ≤ q-quantile ≤ X_(u)) ≥ P(l ≤ B ≤ u − 1), B binomial; ranks from 1
    low = int(binom.ppf(0.025, worth, level)) * number // worth
    high = -(-(int(binom.ppf(0.975, worth, level)) + 1) * number // worth)
    if level**worth > 0.025:  # the largest of so many may well lie below the quantile
        high = number + 1
    return Quantile(
        level,
        value,
        int(ordered[low - 1]) if low >= 1 else None,
        int(ordered[high - 1]) if high <= number else None,
    )
