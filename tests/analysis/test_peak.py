"""P Theorem 6, Theorem 8 and Corollary 9, sojourn laws, and the distance of R."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from testbed.analysis.bursts import Sojourn, delivered_run, lost_run
from testbed.analysis.moments import finite_moment_order
from testbed.analysis.peak import burst_series, condition_two, failure_limit, growth_factors, scalar_peak_is_stable
from testbed.analysis.riemann import riemannian_distance
from testbed.channel.loss import Chain

A_P = np.array([[1.3, 0.3], [0.0, 1.2]])
SEEDS = st.integers(0, 2**32 - 1)


def test_the_example_of_p() -> None:
    d = growth_factors(A_P, 2)
    assert d == (pytest.approx(2.008121, abs=5e-7),)
    series = burst_series(A_P, 0.65)
    assert series is not None
    assert series.value == pytest.approx(6.433362, abs=5e-7)
    limit = failure_limit(d, 2, series.value, 0.65)
    assert round(limit, 4) == 0.0407
    assert condition_two(d, 2, series.value, 0.65, 0.03) < 1
    assert condition_two(d, 2, series.value, 0.65, limit) == pytest.approx(1.0)
    assert 1 - Chain.markov(0.65, 0.03).arrival == pytest.approx(0.044118, abs=5e-7)


def riccati(A: np.ndarray, C: np.ndarray, P: np.ndarray) -> np.ndarray:
    gain = A @ P @ C.T @ np.linalg.inv(C @ P @ C.T + np.eye(len(C)))
    return A @ P @ A.T + np.eye(len(A)) - gain @ C @ P @ A.T


@settings(deadline=None, max_examples=50)
@given(SEEDS, st.integers(2, 4))
def test_growth_factors_bound_the_riccati_map(seed: int, n: int) -> None:
    """‖F^i(P)‖ ≤ d_i ‖P‖ + const, const = Σ_{m<i} ‖A^m‖² for Q = I."""
    rng = np.random.default_rng(seed)
    A, C = rng.normal(size=(n, n)), rng.normal(size=(1, n))
    half = rng.normal(size=(n, n)) * 10 ** rng.uniform(-1, 3)
    start = P = half @ half.T
    constant = 0.0
    for i, d in enumerate(growth_factors(A, n), 1):
        P = riccati(A, C, P)
        constant += float(np.linalg.norm(np.linalg.matrix_power(A, i - 1), 2)) ** 2
        assert np.linalg.norm(P, 2) <= (d * np.linalg.norm(start, 2) + constant) * (1 + 1e-9)


def test_one_observation_bounds_the_map() -> None:
    assert growth_factors(A_P, 1) == (0.0,)
    assert failure_limit((0.0,), 1, 5.0, 0.5) == 1.0


@settings(deadline=None, max_examples=50)
@given(SEEDS, st.integers(1, 3), st.floats(0.05, 0.9))
def test_the_series_is_its_sum_and_the_tail_its_bound(seed: int, n: int, margin: float) -> None:
    A = np.random.default_rng(seed).normal(size=(n, n))
    rho = float(np.max(np.abs(np.linalg.eigvals(A))))
    s = min(0.99, margin / rho**2)
    found = burst_series(A, 1 - s)
    assert found is not None
    terms, power = [], A
    for j in range(1500):
        terms.append(float(np.linalg.norm(power, 2)) ** 2 * s**j)
        power = power @ A if np.abs(power).max() < 1e120 else power
        if terms[-1] < 1e-18 * sum(terms) or np.abs(power).max() >= 1e120:
            break
    assert found.value == pytest.approx(sum(terms), rel=1e-9)
    assert 0.0 <= found.tail <= 1e-12 * found.value


def test_series_that_end_at_once_or_never() -> None:
    once = burst_series(A_P, 1.0)
    assert once is not None
    assert once.value == pytest.approx(np.linalg.norm(A_P, 2) ** 2)
    assert burst_series(A_P, 0.3) is None


@settings(deadline=None, max_examples=60)
@given(st.lists(st.floats(0.1, 20.0), min_size=1, max_size=4), st.floats(0.1, 30.0), st.floats(0.05, 0.95))
def test_the_largest_failure_rate_is_the_first_crossing(d: list[float], series: float, recovery: float) -> None:
    index = len(d) + 1
    limit = failure_limit(tuple(d), index, series, recovery)
    for p in np.linspace(0.0, 0.999 * limit, 200):
        assert condition_two(tuple(d), index, series, recovery, float(p)) < 1 + 1e-6
    if limit < 1.0:
        assert condition_two(tuple(d), index, series, recovery, limit) == pytest.approx(1.0, rel=1e-5)


@pytest.mark.parametrize(("recovery", "stable"), [(0.6, True), (0.32, False)])
def test_the_scalar_examples_of_p(recovery: float, stable: bool) -> None:
    assert scalar_peak_is_stable(1.4, recovery) == stable
    order = finite_moment_order(np.array([[1.4]]), Chain.markov(recovery, 0.2))
    assert scalar_peak_is_stable(1.4, recovery, order * 0.999)
    assert not scalar_peak_is_stable(1.4, recovery, order * 1.001)


@pytest.mark.parametrize("end", [0.05, 0.3, 1.0])
def test_a_sojourn_is_geometric(end: float) -> None:
    law, lengths = Sojourn(end), np.arange(1.0, 3000.0)
    p = law.probability(lengths)
    assert p.sum() == pytest.approx(1.0)
    assert (lengths * p).sum() == pytest.approx(law.mean)
    at = law.quantile(0.99)
    assert at is not None
    assert p[:at].sum() >= 0.99 - 1e-12
    assert p[: at - 1].sum() < 0.99


def test_a_sojourn_without_end() -> None:
    assert Sojourn(0.0).mean == math.inf
    assert Sojourn(0.0).quantile(0.5) is None


def test_mean_runs_share_time_as_the_stationary_law() -> None:
    chain = Chain.markov(0.6, 0.2)
    bad, good = lost_run(chain).mean, delivered_run(chain).mean
    assert bad / (bad + good) == pytest.approx(1 - chain.arrival)


@settings(deadline=None, max_examples=50)
@given(SEEDS, st.integers(1, 4))
def test_the_riemannian_distance(seed: int, n: int) -> None:
    """A metric that no change of coordinates and no inversion moves; log-ratios on a diagonal."""
    rng = np.random.default_rng(seed)
    P, Q, S = ((lambda h: h @ h.T + 0.1 * np.eye(n))(rng.normal(size=(n, n))) for _ in range(3))
    T = rng.normal(size=(n, n)) + 3 * np.eye(n)
    there = riemannian_distance(P, Q)
    assert riemannian_distance(Q, P) == pytest.approx(there, rel=1e-6)
    assert riemannian_distance(T @ P @ T.T, T @ Q @ T.T) == pytest.approx(there, rel=1e-5)
    assert riemannian_distance(np.linalg.inv(P), np.linalg.inv(Q)) == pytest.approx(there, rel=1e-5)
    assert there <= riemannian_distance(P, S) + riemannian_distance(S, Q) + 1e-9
    assert riemannian_distance(P, P) == pytest.approx(0.0, abs=1e-6)
    ratios = rng.uniform(0.1, 10.0, n)
    assert riemannian_distance(np.diag(ratios), np.eye(n)) == pytest.approx(math.sqrt((np.log(ratios) ** 2).sum()))


def test_the_distance_needs_definite_matrices() -> None:
    with pytest.raises(ValueError, match="definite"):
        riemannian_distance(np.diag([1.0, 0.0]), np.eye(2))
