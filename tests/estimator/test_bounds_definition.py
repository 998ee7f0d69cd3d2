"""The bounds: covariances with ν known, of the system and of the one with ¼U more process noise; and their order."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given

from estimator.reference import gaussian
from estimator.reference.cases import Bools, Floats, System, Trial, check, random_system, random_trial, trials
from estimator.reference.compare import covariance_error, smallest_eigenvalue
from estimator.reference.drive import model_of, run, run_bounds
from estimator.reference.histories import weighted_histories
from estimator.reference.stacked import Stack
from testbed.estimator.bounds import Bounds

TOLERANCE = 1e-10


def _largest_push(trial: Trial) -> Floats:
    """U ≥ B u_k u_k' B' for all k and lanes: their sum."""
    pushes = trial.u.reshape(-1, trial.system.q) @ trial.system.B.T
    return pushes.T @ pushes


@check(40)
@given(trials(acks=("none",), steps=(1, 8)))
def test_are_the_conditional_covariances(trial: Trial) -> None:
    U = _largest_push(trial)
    lower, upper = run_bounds(trial, U)
    n = trial.system.n
    assert lower.shape == upper.shape == (trial.steps, trial.lanes, n, n)
    for k in range(1, trial.steps + 1):
        for lane in range(trial.lanes):
            arrived = trial.arrived[:k, lane]
            assert covariance_error(lower[k - 1, lane], gaussian.lower_bound(trial.system, arrived)) < TOLERANCE
            assert covariance_error(upper[k - 1, lane], gaussian.upper_bound(trial.system, arrived, U)) < TOLERANCE


def test_no_upper_bound_without_U() -> None:
    rng = np.random.default_rng(1)
    trial = random_trial(rng, random_system(rng, 2, 1, 1), 3, 2)
    bounds = Bounds(model_of(trial.system), None, lanes=2)
    for k in range(3):
        lower, upper = bounds.step(trial.arrived[k])
        assert upper is None
        for lane in range(2):
            reference = gaussian.lower_bound(trial.system, trial.arrived[: k + 1, lane])
            assert covariance_error(lower[lane], reference) < TOLERANCE


@pytest.mark.parametrize("kind", ["oe", "aoe", "ff"])
@check(20)
@given(trial=trials(chains=("bernoulli",)))
def test_lower_bound_holds_for_every_observation(kind: str, trial: Trial) -> None:
    lower, _ = run_bounds(trial, _largest_push(trial))
    _, P = run(kind, trial)
    for k in range(trial.steps):
        for lane in range(trial.lanes):
            scale = np.abs(P[k, lane]).max() + 1e-12
            assert smallest_eigenvalue(P[k, lane] - lower[k, lane] + 1e-10 * scale * np.eye(trial.system.n)) >= 0


def _grid(system: System, u: Floats, arrived: Bools) -> tuple[Floats, float]:
    """Points (L, number received) where the received scalar y have mass, and the volume of a cell.

    The spacing is 0.8 of the smallest standard deviation: the trapezoid rule is exact to 1e-12 for such a Gaussian.
    """
    if not arrived.any():
        return np.zeros((1, 0)), 1.0
    stack = Stack(system, arrived)
    means = stack.output_means(u, weighted_histories(system, len(u), {})[0])
    spacing = 0.8 * float(np.sqrt(np.linalg.eigvalsh(stack.S).min()))
    reach = 7.5 * np.sqrt(np.diag(stack.S))
    ends = zip(means.min(axis=0) - reach, means.max(axis=0) + reach, strict=True)
    axes = [np.arange(low, high, spacing) for low, high in ends]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
    return points, spacing ** len(axes)


def _mean_over_observations(kind: str, system: System, arrived: Bools, u: Floats) -> Floats:
    """E_Y[P_k] for a scalar y: the trapezoid rule over the received y, one lane a point, with their exact density."""
    points, cell = _grid(system, u, arrived)
    steps, lanes = len(arrived), len(points)
    y = np.zeros((steps, lanes, 1))
    y[arrived, :, 0] = points.T
    empty = np.zeros((steps, lanes), dtype=np.int64)
    flags = np.repeat(arrived[:, None], lanes, axis=1)
    _, P = run(kind, Trial(system, np.repeat(u[:, None], lanes, axis=1), y, flags, empty, empty))
    weights = np.exp(gaussian.log_evidence_of_lanes(system, u, y, arrived)) * cell
    assert weights.sum() == pytest.approx(1, abs=1e-9)
    return np.asarray(np.einsum("l,lij->ij", weights, P[-1]), dtype=np.float64)


def _scalar_output_system(seed: int, chain: str, steps: int) -> tuple[System, Floats]:
    """A system with scalar y and a constant u (steps, 1) that pushes x by one to four standard deviations of v."""
    rng = np.random.default_rng([seed, 17])
    system = random_system(rng, 2, 1, 1, chain)
    system.R[:] = 1.0
    return system, np.full((steps, 1), rng.uniform(1, 4) / np.linalg.norm(system.B))


def _bounds(system: System, arrived: Bools, U: Floats) -> tuple[Floats, Floats]:
    """Lower and upper bound at the last step."""
    bounds = Bounds(model_of(system), U, lanes=1)
    for flag in arrived:
        lower, upper = bounds.step(np.array([flag]))
    assert upper is not None
    return lower[0], upper[0]


@pytest.mark.parametrize("arrived", [(True,), (True, True), (False, True), (True, False), (False, False)])
@pytest.mark.parametrize("seed", range(3))
def test_order_of_the_expectations_of_oe(arrived: tuple[bool, ...], seed: int) -> None:
    """Pᴬ_k ≤ E_Y[P_k] ≤ S_k (M Theorem 3) when losses are independent, with the smallest U for a constant u."""
    system, u = _scalar_output_system(seed, "bernoulli", len(arrived))
    flags = np.array(arrived)
    mean = _mean_over_observations("oe", system, flags, u)
    lower, upper = _bounds(system, flags, u[0, 0] ** 2 * system.B @ system.B.T)
    assert smallest_eigenvalue(mean - lower) > -1e-9
    assert smallest_eigenvalue(upper - mean) > -1e-9


@pytest.mark.parametrize("chain", ["bernoulli", "markov"])
@pytest.mark.parametrize("kind", ["oe", "aoe"])
@pytest.mark.parametrize("seed", range(3))
def test_order_of_the_expectations_at_the_first_step(kind: str, chain: str, seed: int) -> None:
    """One control packet has no correlation with another: Theorem 3 holds for both estimators and every chain."""
    system, u = _scalar_output_system(seed, chain, 1)
    flags = np.array([True])
    mean = _mean_over_observations(kind, system, flags, u)
    lower, upper = _bounds(system, flags, u[0, 0] ** 2 * system.B @ system.B.T)
    assert smallest_eigenvalue(mean - lower) > -1e-9
    assert smallest_eigenvalue(upper - mean) > -1e-9


@pytest.mark.parametrize("arrived", [(True, True), (False, True), (True, False), (False, False)])
@pytest.mark.parametrize("seed", range(3))
def test_order_of_the_expectations_with_correlated_losses(arrived: tuple[bool, ...], seed: int) -> None:
    """With Markov losses the bound on OE needs a larger U.

    cov(ν_i, ν_j) has row sums of at most ¼ (1 + |r|) / (1 − |r|), r = 1 − recovery − failure, so that many times
    ¼U covers all of B Σ (ν_i − E ν_i) u_i (Gershgorin). The best linear estimator under it bounds E_Y[P_k].
    """
    system, u = _scalar_output_system(seed, "markov", len(arrived))
    flags = np.array(arrived)
    mean = _mean_over_observations("oe", system, flags, u)
    r = abs(1 - system.recovery - system.failure)
    lower, upper = _bounds(system, flags, u[0, 0] ** 2 * system.B @ system.B.T * (1 + r) / (1 - r))
    assert smallest_eigenvalue(mean - lower) > -1e-9
    assert smallest_eigenvalue(upper - mean) > -1e-9


def test_upper_bound_of_M_does_not_hold_with_correlated_losses() -> None:
    """M Theorem 3 as printed: a chain that never changes, nothing received. var x_2 = 1 + u², S_2 = 1 + ½u²."""
    one, zero = np.eye(1), np.zeros((1, 1))
    system = System(one, one, one, 0.5 * one, one, np.zeros(1), zero, recovery=0.0, failure=0.0, start=0.5)
    arrived, u = np.zeros(2, dtype=bool), np.full((2, 1), 2.0)
    _, P = run("oe", Trial(system, u[:, None], np.zeros((2, 1, 1)), arrived[:, None], *[np.zeros((2, 1), int)] * 2))
    _, upper = _bounds(system, arrived, np.array([[4.0]]))
    assert P[-1, 0, 0, 0] == pytest.approx(5.0, rel=1e-12)
    assert upper[0, 0] == pytest.approx(3.0, rel=1e-12)
