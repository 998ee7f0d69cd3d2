"""The critical arrival rate: numbers of the papers, the definition by simulation, and what must hold for all."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from testbed.analysis.critical import critical_arrival, recovery_threshold, riccati_bound, riccati_feasible
from testbed.numerics.lanes import Floats

SEEDS = st.integers(0, 2**32 - 1)


@pytest.mark.parametrize(("rho", "threshold"), [(1.2910, 0.4), (1.8257, 0.7)])
def test_thresholds_of_m(rho: float, threshold: float) -> None:
    A = np.diag([rho, 1.005])
    assert recovery_threshold(A) == pytest.approx(threshold, abs=2e-5)
    assert critical_arrival(A, np.array([[1.0, -1.0], [0.0, 1.0]])).exact == pytest.approx(threshold, abs=2e-5)


@pytest.mark.parametrize(("sigma", "threshold"), [(1.0541, 0.1), (1.1952, 0.3), (1.4142, 0.5)])
def test_thresholds_of_d(sigma: float, threshold: float) -> None:
    found = critical_arrival(np.array([[sigma, 0.5], [0.0, 0.1]]), np.array([[-1.0, 1.0]]))
    assert found.exact == pytest.approx(threshold, abs=5e-5)
    assert found.upper == found.exact == found.lower


def test_thresholds_of_p() -> None:
    assert critical_arrival(np.array([[1.4]]), np.array([[1.0]])).exact == pytest.approx(0.489796, abs=5e-7)
    assert recovery_threshold(np.array([[1.3, 0.3], [0.0, 1.2]])) == pytest.approx(0.408284, abs=5e-7)


def modified_riccati(A: Floats, C: Floats, arrival: float, steps: int) -> float:
    """Trace after so many steps of P ← A P A' + I − λ A P C'(C P C' + I)^{-1} C P A', from P = I."""
    P = np.eye(len(A))
    for _ in range(steps):
        gain = P @ C.T @ np.linalg.inv(C @ P @ C.T + np.eye(len(C)))
        P = A @ (P - arrival * gain @ C @ P) @ A.T + np.eye(len(A))
    return float(np.trace(P))


@pytest.mark.parametrize(
    ("A", "C"),
    [
        (np.array([[1.4]]), np.array([[1.0]])),
        (np.array([[1.3, 0.3], [0.0, 1.2]]), np.array([[1.0, 1.0]])),
        (np.diag([1.6, 1.3, 1.3, 0.4]), np.array([[1.0, 0.0, 1.0, 1.0], [0.0, 1.0, 1.0, 0.0]])),
    ],
)
def test_the_modified_riccati_equation_settles_above_its_bound_and_grows_below(A: Floats, C: Floats) -> None:
    bound = riccati_bound(A, C)
    assert bound is not None
    early, late = (modified_riccati(A, C, bound + 0.03, steps) for steps in (1000, 1100))
    assert late == pytest.approx(early, rel=1e-6)
    early, late = (modified_riccati(A, C, bound - 0.03, steps) for steps in (1000, 1100))
    assert late > 2 * early


@pytest.mark.parametrize("a", [1.1, 1.4, 2.0])
def test_the_expected_variance_of_a_scalar_system(a: float) -> None:
    """E[P] with R → 0 is exactly (1 − λ) a² E[P] + 1: it settles above λ_c only."""
    rate = critical_arrival(np.array([[a]]), np.array([[1.0]])).exact
    assert rate is not None
    for arrival, settles in ((rate + 0.02, True), (rate - 0.02, False)):
        P, halfway = 1.0, 1.0
        for step in range(4000):
            P = (1 - arrival) * a * a * P + 1.0
            halfway = P if step == 1999 else halfway
        assert (1.001 * halfway > P) == settles


def bisected(A: Floats, C: Floats) -> float:
    low, high = 0.0, 1.0
    while high - low > 1e-6:
        middle = (low + high) / 2
        low, high = (low, middle) if riccati_feasible(A, C, middle) else (middle, high)
    return high


@settings(deadline=None, max_examples=15)
@given(SEEDS, st.integers(1, 3))
def test_bisection_meets_the_closed_form_for_one_output(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    moduli = 1.1 + 0.25 * np.arange(n) + rng.uniform(0.0, 0.1, n)
    T = np.linalg.qr(rng.normal(size=(n, n)))[0]
    A, C = T @ np.diag(moduli) @ T.T, np.ones((1, n)) @ T.T
    closed = 1 - 1 / np.prod(moduli) ** 2
    assert riccati_bound(A, C) == pytest.approx(closed, abs=1e-9)
    assert bisected(A, C) == pytest.approx(closed, abs=1e-4)


@pytest.mark.parametrize("arrival", [0.2, 0.7])
def test_feasible_where_c_is_invertible(arrival: float) -> None:
    """h(X) = (1 − λ) A X A' there."""
    A = np.array([[1.2, 0.1], [0.0, 1.5]])
    assert riccati_feasible(A, np.eye(2), arrival) == ((1 - arrival) * 1.5**2 < 1)


@settings(deadline=None, max_examples=12, derandomize=True)
@given(SEEDS, st.integers(1, 4), st.integers(1, 3))
def test_bounds_are_ordered_and_know_no_coordinates(seed: int, n: int, p: int) -> None:
    rng = np.random.default_rng(seed)
    A, C = rng.normal(size=(n, n)), rng.normal(size=(p, n))
    found = critical_arrival(A, C)
    assert found.upper is not None
    assert 0.0 <= found.lower <= found.upper <= 1.0
    assert found.exact is None or found.lower <= found.exact <= found.upper
    T = np.linalg.qr(rng.normal(size=(n, n)))[0] @ np.diag(rng.uniform(0.5, 2.0, n))
    moved = critical_arrival(T @ A @ np.linalg.inv(T), C @ np.linalg.inv(T))
    assert moved.lower == pytest.approx(found.lower, abs=1e-6)
    assert moved.upper == pytest.approx(found.upper, abs=0.02)  # the search is safe, not exact, for a mode near 1


def test_a_stable_mode_does_not_matter() -> None:
    A, C = np.diag([1.6, 1.3, 1.3]), np.array([[1.0, 0.0, 1.0], [0.0, 1.0, 1.0]])
    more_A = np.block([[A, np.ones((3, 1))], [np.zeros((1, 3)), 0.6 * np.ones((1, 1))]])
    more = riccati_bound(more_A, np.hstack([C, np.ones((2, 1))]))
    assert more == pytest.approx(riccati_bound(A, C), abs=1e-5)


def test_stable_marginal_and_unobserved_systems() -> None:
    assert critical_arrival(np.diag([0.9, 0.1]), np.zeros((1, 2))).exact == 0.0
    assert critical_arrival(np.diag([1.0, 0.1]), np.ones((1, 2))).exact == 0.0
    blind = critical_arrival(np.diag([1.2, 1.1]), np.array([[1.0, 0.0]]))
    assert (blind.upper, blind.exact) == (None, None)
    assert critical_arrival(np.diag([1.2, 1.0]), np.ones((1, 2))).exact == pytest.approx(1 - 1 / 1.44)


def test_a_rotation_is_not_decided() -> None:
    c, s = 1.3 * math.cos(0.7), 1.3 * math.sin(0.7)
    found = critical_arrival(np.array([[c, -s], [s, c]]), np.array([[1.0, 0.0]]))
    assert found.exact is None
    assert found.lower == pytest.approx(1 - 1.3**-2)
    assert found.upper == pytest.approx(1 - 1.3**-4)
