"""Which moments are finite: closed forms, the example of P, and truncated sums over burst lengths."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from testbed.analysis.moments import finite_moment_order, spectral_radius
from testbed.channel.loss import Chain
from testbed.orchestrator.outcome import moment_checks
from testbed.scenario import parse_scenario


def scalar(a: float, recovery: float) -> float:
    return finite_moment_order(np.array([[a]]), Chain.markov(recovery, 0.3))


@settings(deadline=None, max_examples=100)
@given(st.lists(st.floats(-2.0, 2.0), min_size=1, max_size=4), st.integers(0, 2**32 - 1))
def test_the_spectral_radius_is_that_of_a_known_spectrum(eigenvalues: list[float], seed: int) -> None:
    n = len(eigenvalues)
    T, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(n, n)))
    A = T @ np.diag(eigenvalues) @ T.T
    assert spectral_radius(A) == pytest.approx(max(map(abs, eigenvalues)), rel=1e-9, abs=1e-12)


def test_the_spectral_radius_of_a_rotation() -> None:
    c, s = math.cos(0.7), math.sin(0.7)
    assert spectral_radius(1.3 * np.array([[c, -s], [s, c]])) == pytest.approx(1.3, rel=1e-12)


@settings(deadline=None, max_examples=100)
@given(st.floats(1.01, 5.0), st.floats(0.01, 0.99))
def test_at_the_order_the_burst_just_outweighs_its_probability(rho: float, recovery: float) -> None:
    """ρ^{2r} (1 − recovery) = 1 at r = r*."""
    order = finite_moment_order(np.diag([rho, 0.5]), Chain.markov(recovery, 0.2))
    assert rho ** (2 * order) * (1 - recovery) == pytest.approx(1.0, rel=1e-9)


def test_the_critical_rate_of_the_scalar_example() -> None:
    """P: a = 1.4 has q_c = 0.489796."""
    assert scalar(1.4, 1 - 1 / 1.4**2) == pytest.approx(1.0, rel=1e-12)
    assert pytest.approx(0.489796, abs=5e-7) == 1 - 1 / 1.4**2
    assert scalar(1.4, 0.6) > 1.0 > scalar(1.4, 0.32)


def moment_of_bursts(a: float, recovery: float, r: float, longest: int) -> float:
    """E[P^r; burst ≤ longest] of the scalar covariance after a burst: P ← a² P + 1 a loss, from P = 1."""
    total, P = 0.0, 1.0
    for length in range(1, longest + 1):
        P = a * a * P + 1.0
        total += math.exp(math.log(recovery) + (length - 1) * math.log(1 - recovery) + r * math.log(P))
    return total


@pytest.mark.parametrize("a", [1.1, 1.4, 2.0])
@pytest.mark.parametrize("recovery", [0.2, 0.5, 0.8])
def test_sums_over_bursts_converge_below_the_order_and_grow_above_it(a: float, recovery: float) -> None:
    order = scalar(a, recovery)
    below = [moment_of_bursts(a, recovery, 0.8 * order, longest) for longest in (200, 400)]
    above = [moment_of_bursts(a, recovery, 1.2 * order, longest) for longest in (200, 400)]
    assert below[1] / below[0] < 1.01
    assert above[1] / above[0] > 50.0


@pytest.mark.parametrize(
    ("A", "chain"),
    [
        ([[0.9]], Chain.markov(0.1, 0.9)),
        ([[1.0]], Chain.markov(0.1, 0.9)),
        ([[0.0, 1.0], [-1.0, 0.0]], Chain.bernoulli(0.2)),
        ([[2.0]], Chain.markov(1.0, 0.4)),
        ([[2.0]], Chain.lossless()),
        ([[2.0]], Chain.bernoulli(1.0)),
        ([[2.0]], Chain.markov(0.1, 0.0)),
    ],
)
def test_all_moments_are_finite(A: list[list[float]], chain: Chain) -> None:
    assert finite_moment_order(np.array(A), chain) == math.inf


def test_no_moment_is_finite_without_recovery() -> None:
    assert finite_moment_order(np.array([[1.1]]), Chain.bernoulli(0.0)) == 0.0


@settings(deadline=None, max_examples=60)
@given(st.floats(1.05, 2.0), st.floats(0.05, 0.95))
def test_a_bernoulli_link_recovers_at_its_arrival_rate(a: float, arrival: float) -> None:
    assert finite_moment_order(np.array([[a]]), Chain.bernoulli(arrival)) == scalar(a, arrival)


@pytest.mark.parametrize(
    ("recovery", "expected"),
    [
        (0.9, {"finite mean": True, "finite variance": True}),  # 1.4⁴ · 0.1 = 0.38
        (0.8, {"finite mean": True, "finite variance": True}),  # 1.4⁴ · 0.2 = 0.77
        (0.6, {"finite mean": True, "finite variance": False}),  # 1.4² · 0.4 = 0.78, 1.4⁴ · 0.4 = 1.54
        (0.4, {"finite mean": False}),  # 1.4² · 0.6 = 1.18
    ],
)
def test_a_summary_says_which_figures_are_to_be_trusted(recovery: float, expected: dict[str, bool]) -> None:
    loss = {"kind": "markov", "recovery": recovery, "failure": 0.2}
    system = {"A": [[1.4]], "C": [[1.0]], "Q": [[1.0]], "R": [[1.0]]}
    checks = moment_checks(parse_scenario({"system": system, "links": {"observation": {"loss": loss}}}))
    assert {check.name: check.ok for check in checks} == expected
    assert all("1.4" in check.text for check in checks)
