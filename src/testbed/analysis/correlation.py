"""How much a series of correlated observations tells: autocorrelation, and how many independent ones it is worth."""

from __future__ import annotations

import numpy as np

from testbed.analysis.fit_intervals import Interval, wilson
from testbed.numerics.lanes import Bools, Floats


def autocovariance(values: Floats) -> Floats:
    """(n,): Σ_k (v_k − m)(v_{k+j} − m) / n for the lags j = 0 … n − 1. values: (n,), mean m."""
    number = len(values)
    centred = values - values.mean()
    size = 1 << (2 * number - 1).bit_length()
    power = np.abs(np.fft.rfft(centred, size)) ** 2
    covariance: Floats = np.fft.irfft(power, size)[:number] / number
    return covariance


def autocorrelation(values: Floats, lags: int) -> Floats:
    """(lags + 1,): of lags 0 … lags, less than n; zero but for the first where the values are all the same."""
    covariance = autocovariance(values)
    out = np.zeros(lags + 1)
    out[0] = 1.0
    if covariance[0] > 0.0:
        out = covariance[: lags + 1] / covariance[0]
    return out


def correlation_time(values: Floats) -> float:
    """τ: the mean of n values varies as that of n / τ independent ones. 1 where they are all the same; 1/n or more.

    τ = 1 + 2 Σ_j ρ_j, of sums of two neighbours γ_2m + γ_2m+1 as long as these are positive and do not grow, which they
    are for what a reversible chain makes. Beyond, they are noise.
    C. J. Geyer: Practical Markov chain Monte Carlo. Statist. Sci. 7 (1992) 473–483, section 3.3.
    """
    covariance = autocovariance(values)
    if not covariance[0] > 1e-15:
        return 1.0
    pairs = covariance[: len(covariance) // 2 * 2].reshape(-1, 2).sum(axis=1)
    ends = np.flatnonzero(pairs <= 0.0)
    positive = pairs[: ends[0]] if len(ends) else pairs
    total = 2.0 * float(np.minimum.accumulate(positive).sum()) if len(positive) else 0.0
    return max(total / float(covariance[0]) - 1.0, 1.0 / len(values))


def share_interval(happened: Bools) -> tuple[Interval, float]:
    """The 95 % interval of the probability of what happened (n,) in a stationary series, and τ. No model is assumed.

    Wilson's, of as many independent observations as the series is worth.
    """
    number, tau = len(happened), correlation_time(happened.astype(np.float64))
    return wilson(float(np.count_nonzero(happened)) / tau, number / tau), tau
