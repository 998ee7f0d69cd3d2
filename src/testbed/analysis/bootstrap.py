"""Bootstrap interval of a mean, bias-corrected and accelerated (BCa), at the level 95 %.

B. Efron: Better bootstrap confidence intervals. JASA 82 (1987) 171–185. The same values give the same interval.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.special import ndtr, ndtri

from testbed.analysis.fit_intervals import Interval
from testbed.numerics.lanes import Floats

RESAMPLES = 9999
RESAMPLES_MIN = 1999
_DRAWS_MAX = 10_000_000
VALUES_MAX = 20_000
"""More are not resampled: it would take long."""
_CHUNK = 1_000_000
_TIE = 1e-12
"""Of resampled means, in units of the largest deviation: rounding."""


def bca(values: Floats) -> Interval | None:
    """Of the mean of independent values (n,); None of fewer than two or more than ``VALUES_MAX``."""
    n = len(values)
    if not 2 <= n <= VALUES_MAX:
        return None
    mean = float(np.mean(values))
    away = values - mean
    scale = float(np.max(np.abs(away)))
    if scale == 0.0:
        return Interval(mean, mean)
    away = away / scale
    means = _resampled(away, min(RESAMPLES, max(RESAMPLES_MIN, _DRAWS_MAX // n)))
    below = float(np.mean(means < -_TIE) + np.mean(means <= _TIE)) / 2.0
    bias = float(ndtri(below))
    acceleration = float(np.sum(away**3)) / (6.0 * float(np.sum(away**2)) ** 1.5)
    shares = [_share(bias, acceleration, z) for z in (float(ndtri(0.025)), float(ndtri(0.975)))]
    low, high = (float(end) for end in np.quantile(means, shares))
    return Interval(mean + scale * low, mean + scale * high)


def _resampled(values: Floats, count: int) -> Floats:
    """The means of ``count`` samples with replacement."""
    rng = np.random.default_rng(0)
    rows = max(1, _CHUNK // len(values))
    parts = [
        values[rng.integers(len(values), size=(min(rows, count - begin), len(values)))].mean(axis=1)
        for begin in range(0, count, rows)
    ]
    means: Floats = np.concatenate(parts)
    return means


def _share(bias: float, acceleration: float, z: float) -> float:
    """The quantile of the resampled means that ends the interval."""
    if not math.isfinite(bias):
        return 0.0 if z < 0 else 1.0
    return float(ndtr(bias + (bias + z) / (1.0 - acceleration * (bias + z))))
