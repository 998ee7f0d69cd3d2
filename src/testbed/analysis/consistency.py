"""Is an estimator as good as it says? NEES, NIS and the whiteness of innovations, each with its band.

Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 5.4. The bands of
NEES and NIS hold for Gaussian errors that are independent from sample to sample: lanes are, neighbouring steps of one
lane are not for NEES, and are for NIS where the filter is optimal.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincinv, ndtri

from testbed.numerics.lanes import Floats


@dataclass(frozen=True)
class Verdict:
    """A statistic and the band that it stays in with the given probability if the estimator is consistent."""

    value: float
    low: float
    high: float
    level: float
    samples: int

    @property
    def inside(self) -> bool:
        return self.low <= self.value <= self.high


def normalised_squares(vectors: Floats, covariances: Floats) -> Floats:
    """v' C⁻¹ v: vectors (…, n) with covariances (…, n, n) or one (n, n) for all; shape (…).

    Raises numpy.linalg.LinAlgError where a covariance is not positive definite.
    """
    halves = whitened(vectors, covariances)
    return np.asarray(np.sum(halves * halves, axis=-1))


def chi_square_band(dimension: int, samples: int, level: float = 0.95) -> tuple[float, float]:
    """The central band of the mean of ``samples`` independent χ² variables with ``dimension`` degrees of freedom."""
    tail = 0.5 * (1.0 - level)
    low, high = (2.0 * float(gammaincinv(0.5 * dimension * samples, p)) / samples for p in (tail, 1.0 - tail))
    return low, high


def nees(errors: Floats, covariances: Floats, level: float = 0.95) -> Verdict:
    """Normalised estimation error squared: errors x − x̂ (…, n) with P (…, n, n); n in expectation."""
    return _mean_verdict(normalised_squares(errors, covariances), errors.shape[-1], level)


def nis(innovations: Floats, covariances: Floats, level: float = 0.95) -> Verdict:
    """Normalised innovation squared: y − C x̂⁻ (…, p) with S = C P⁻ C' + R (…, p, p); needs no truth.

    Leave out the steps at which nothing arrived.
    """
    return _mean_verdict(normalised_squares(innovations, covariances), innovations.shape[-1], level)


def whiteness(innovations: Floats, lag: int = 1, level: float = 0.95) -> Verdict:
    """Autocorrelation of innovations in time, (T, p) or (M, T, p) for M lanes: zero for an optimal filter.

    ρ(l) = Σ ν_k'ν_{k+l} / sqrt(Σ ν_k'ν_k Σ ν_{k+l}'ν_{k+l}), summed over lanes and steps (section 5.4.3); for whitened
    innovations, S^{-1/2}ν, its standard deviation is 1/sqrt(p · pairs), which the band assumes.

    Raises ValueError for a lag that leaves no pairs.
    """
    series = innovations if innovations.ndim == 3 else innovations[None]
    lanes, steps, p = series.shape
    if not 0 < lag < steps:
        raise ValueError(f"lag: got {lag}; allowed: 1 … {steps - 1}")
    early, late = series[:, : steps - lag], series[:, lag:]
    value = float(np.sum(early * late) / np.sqrt(np.sum(early * early) * np.sum(late * late)))
    pairs = lanes * (steps - lag)
    half = float(ndtri(0.5 + 0.5 * level)) / np.sqrt(p * pairs)
    return Verdict(value, -half, half, level, pairs)


def whitened(innovations: Floats, covariances: Floats) -> Floats:
    """S^{-1/2} ν by Cholesky's factor: unit covariance for a consistent filter; shapes as in ``nis``."""
    factors = np.broadcast_to(np.linalg.cholesky(covariances), (*innovations.shape, innovations.shape[-1]))
    return np.asarray(np.linalg.solve(factors, innovations[..., None])[..., 0])


def _mean_verdict(values: Floats, dimension: int, level: float) -> Verdict:
    low, high = chi_square_band(dimension, values.size, level)
    return Verdict(float(values.mean()), low, high, level, values.size)
