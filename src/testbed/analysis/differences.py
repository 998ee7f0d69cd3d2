"""Differences of means with 95 % intervals: of pairs, of independent samples; and p-values of many at once."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import stdtr, stdtrit

from testbed.analysis.bootstrap import bca
from testbed.analysis.fit_intervals import Interval, wilson
from testbed.numerics.lanes import Floats

LEVEL = 0.95
FEW = 30
"""Samples below this number get a bootstrap interval besides."""
SKEWED = 0.01
"""So do those of which skewness moves the error of one tail of the t interval by more than this."""
ROUNDING = 1e-12
"""Pairs that differ by less, relatively, count as equal."""
_Z = 1.959963984540054

Method = Literal["paired t", "Welch", "batch means"]


@dataclass(frozen=True)
class Difference:
    """mean(a) − mean(b). What cannot be had is None.

    number: pairs, lanes of both, or batches; left_out: pairs or lanes with a value that is not finite.
    p_value: of the same mean, two-sided. ratio: mean(a) / mean(b), where both are positive.
    a_smaller: share of the pairs with a < b, those with a = b left out; its interval needs no moments of a or b.
    """

    method: Method
    number: int
    left_out: int
    mean_a: float | None
    mean_b: float | None
    difference: float | None
    stderr: float | None = None
    interval: Interval | None = None
    p_value: float | None = None
    bootstrap: Interval | None = None
    ratio: float | None = None
    ratio_interval: Interval | None = None
    a_smaller: float | None = None
    a_smaller_interval: Interval | None = None
    note: str | None = None


def paired(a: Floats, b: Floats, *, heavy: bool = False) -> Difference:
    """Of pairs (M,), independent of each other, by Student's t; ``heavy``: with a bootstrap interval in any case."""
    kept = np.isfinite(a) & np.isfinite(b)
    left_out, a, b = int(np.count_nonzero(~kept)), a[kept], b[kept]
    n = len(a)
    if n == 0:
        return Difference("paired t", 0, left_out, None, None, None)
    d = np.where(np.abs(a - b) <= ROUNDING * np.maximum(np.abs(a), np.abs(b)), 0.0, a - b)
    mean_a, mean_b, mean = average(a), average(b), average(d)
    stderr = _stderr(d)
    smaller, decided = int(np.count_nonzero(d < 0)), int(np.count_nonzero(d))
    return Difference(
        "paired t",
        n,
        left_out,
        mean_a,
        mean_b,
        mean,
        stderr,
        t_interval(mean, stderr, n - 1),
        t_test(mean, stderr, n - 1),
        bca(d) if heavy or n < FEW or _tail_error(d) > SKEWED else None,
        *_ratio(mean_a, mean_b, None if stderr is None else _relative(a, mean_a) - _relative(b, mean_b), n),
        a_smaller=smaller / decided if decided else None,
        a_smaller_interval=wilson(smaller, decided) if decided else None,
    )


def welch(a: Floats, b: Floats) -> Difference:
    """Of two independent samples (M,) and (N,) whose variances may differ.

    B. L. Welch: The generalization of "Student's" problem when several different population variances are involved.
    Biometrika 34 (1947) 28–35. Number of degrees: Satterthwaite's.
    """
    left_out = int(np.count_nonzero(~np.isfinite(a)) + np.count_nonzero(~np.isfinite(b)))
    a, b = a[np.isfinite(a)], b[np.isfinite(b)]
    number = len(a) + len(b)
    if not len(a) or not len(b):
        return Difference("Welch", number, left_out, None, None, None)
    mean_a, mean_b = average(a), average(b)
    error_a, error_b = _stderr(a), _stderr(b)
    if error_a is None or error_b is None:
        return Difference("Welch", number, left_out, mean_a, mean_b, mean_a - mean_b)
    stderr = math.hypot(error_a, error_b)
    degrees = _satterthwaite(error_a, len(a), error_b, len(b))
    ratio, ratio_interval = None, None
    if mean_a > 0.0 < mean_b:
        ratio = mean_a / mean_b
        ratio_interval = _times(ratio, _t(degrees) * math.hypot(error_a / mean_a, error_b / mean_b))
    return Difference(
        "Welch",
        number,
        left_out,
        mean_a,
        mean_b,
        mean_a - mean_b,
        stderr,
        t_interval(mean_a - mean_b, stderr, degrees),
        t_test(mean_a - mean_b, stderr, degrees),
        ratio=ratio,
        ratio_interval=ratio_interval,
    )


def holm(p_values: Sequence[float | None]) -> list[float | None]:
    """Adjusted p-values: those below α reject with a probability of at most α that any of them is wrong.

    S. Holm: A simple sequentially rejective multiple test procedure. Scand. J. Statist. 6 (1979) 65–70.
    """
    known = sorted((p, i) for i, p in enumerate(p_values) if p is not None)
    adjusted: list[float | None] = [None] * len(p_values)
    least = 0.0
    for rank, (p, i) in enumerate(known):
        least = adjusted[i] = max(least, min(1.0, (len(known) - rank) * p))
    return adjusted


def average(values: Floats) -> float:
    """The mean, also of values whose sum overflows."""
    scale = float(np.max(np.abs(values)))
    return scale * float(np.mean(values / scale)) if scale > 0.0 else 0.0


def t_interval(mean: float, stderr: float | None, degrees: float) -> Interval | None:
    """mean ± t · stderr."""
    if stderr is None:
        return None
    half = stderr * _t(degrees) if stderr > 0.0 else 0.0
    return Interval(mean - half, mean + half)


def t_test(mean: float, stderr: float | None, degrees: float) -> float | None:
    """The two-sided p-value of mean 0; without any spread 1 for zero and else 0."""
    if stderr is None:
        return None
    if stderr == 0.0:
        return 1.0 if mean == 0.0 else 0.0
    return 2.0 * float(stdtr(degrees, -abs(mean) / stderr))


def _t(degrees: float) -> float:
    """Half-width of an interval in standard errors."""
    return float(stdtrit(degrees, 0.5 + LEVEL / 2))


def _stderr(values: Floats) -> float | None:
    n = len(values)
    if n < 2:
        return None
    centre = average(values)
    scale = float(np.max(np.abs(values - centre)))
    return scale * float(np.std((values - centre) / scale, ddof=1)) / math.sqrt(n) if scale > 0.0 else 0.0


def _satterthwaite(error_a: float, n: int, error_b: float, m: int) -> float:
    largest = max(error_a, error_b)
    if largest == 0.0:
        return n + m - 2.0
    a, b = (error_a / largest) ** 2, (error_b / largest) ** 2
    return float((a + b) ** 2 / (a**2 / (n - 1) + b**2 / (m - 1)))


def _tail_error(values: Floats) -> float:
    """By how much skewness moves the error of one tail of the t interval: κ₃ (2z² + 1) φ(z) / (6 √n).

    P. Hall: The bootstrap and Edgeworth expansion (1992), section 2.6.
    """
    away = values - average(values)
    scale = float(np.max(np.abs(away)))
    if scale == 0.0:
        return 0.0
    away = away / scale
    skewness = float(np.mean(away**3)) / math.pow(float(np.mean(away**2)), 1.5)
    density = math.exp(-_Z * _Z / 2) / math.sqrt(2 * math.pi)
    return abs(skewness) * (2.0 * _Z**2 + 1.0) * density / (6.0 * math.sqrt(len(values)))


def _relative(values: Floats, mean: float) -> Floats:
    return values / mean if mean else values


def _ratio(mean_a: float, mean_b: float, spread: Floats | None, n: int) -> tuple[float | None, Interval | None]:
    """mean(a) / mean(b) with an interval by the delta method for its logarithm: ``spread`` is a / ā − b / b̄."""
    if not mean_a > 0.0 < mean_b:
        return None, None
    ratio = mean_a / mean_b
    stderr = None if spread is None else _stderr(spread)
    return ratio, None if stderr is None else _times(ratio, _t(n - 1) * stderr)


def _times(ratio: float, half: float) -> Interval:
    """exp(log ratio ± half)."""
    factor = math.exp(min(half, 700.0))
    return Interval(ratio / factor, ratio * factor)
