"""Bands against scipy's χ², their coverage by simulation, and what must fall outside."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from testbed.analysis.consistency import chi_square_band, nees, nis, normalised_squares, whitened, whiteness

COVARIANCE = np.array([[2.0, 0.6], [0.6, 1.0]])


def draws(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).multivariate_normal(np.zeros(2), COVARIANCE, size=shape)


@pytest.mark.parametrize(("dimension", "samples", "level"), [(1, 1, 0.95), (2, 256, 0.95), (3, 40, 0.99)])
def test_the_band_is_that_of_chi_square(dimension: int, samples: int, level: float) -> None:
    low, high = chi_square_band(dimension, samples, level)
    law = stats.chi2(dimension * samples)
    assert law.cdf(low * samples) == pytest.approx((1 - level) / 2, rel=1e-9)
    assert law.sf(high * samples) == pytest.approx((1 - level) / 2, rel=1e-9)


def test_normalised_squares_are_quadratic_forms() -> None:
    vectors = draws(1, 3, 5)
    many = np.broadcast_to(COVARIANCE, (3, 5, 2, 2)) * np.arange(1.0, 6.0)[:, None, None]
    expected = [
        [v @ np.linalg.inv(c) @ v for v, c in zip(*row, strict=True)] for row in zip(vectors, many, strict=True)
    ]
    np.testing.assert_allclose(normalised_squares(vectors, many), expected, rtol=1e-12)


def test_a_consistent_estimator_is_inside_as_often_as_promised() -> None:
    inside = [nees(draws(seed, 100), COVARIANCE).inside for seed in range(400)]
    assert stats.binomtest(sum(inside), 400, 0.95).pvalue > 1e-3


def test_one_that_claims_too_little_or_too_much_is_outside() -> None:
    errors = draws(3, 500)
    assert nees(errors, 0.7 * COVARIANCE).value > nees(errors, 0.7 * COVARIANCE).high
    assert nis(errors, 1.4 * COVARIANCE).value < nis(errors, 1.4 * COVARIANCE).low


def test_white_innovations_are_inside_as_often_as_promised() -> None:
    verdicts = [whiteness(whitened(draws(seed, 3, 60), COVARIANCE), lag=2) for seed in range(400)]
    assert verdicts[0].samples == 3 * 58
    assert stats.binomtest(sum(v.inside for v in verdicts), 400, 0.95).pvalue > 1e-3


def test_coloured_innovations_are_outside_by_their_correlation() -> None:
    noise, series = draws(5, 4000), np.zeros((4000, 2))
    for k in range(1, 4000):
        series[k] = 0.5 * series[k - 1] + noise[k]
    verdict = whiteness(series)
    assert not verdict.inside
    assert verdict.value == pytest.approx(0.5, abs=0.05)


def test_whitened_vectors_have_unit_covariance() -> None:
    np.testing.assert_allclose(np.cov(whitened(draws(7, 200_000), COVARIANCE).T), np.eye(2), atol=0.02)


@pytest.mark.parametrize("lag", [0, 5, -1])
def test_a_lag_without_pairs_is_refused(lag: int) -> None:
    with pytest.raises(ValueError, match="allowed: 1 … 4"):
        whiteness(draws(1, 5), lag)
