"""KFIO and IMM give the estimates of other libraries, where those are right.

filterpy's IMM reuses an old innovation where nothing arrives, so it is compared without losses. A filter of statsmodels
keeps what it found for another pattern of missing data, so each lane gets a new one.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from filterpy.kalman import IMMEstimator, KalmanFilter
from hypothesis import assume, given
from hypothesis import strategies as st

from estimator.agreement import assert_same
from estimator.reference.cases import Floats, System, Trial, check, random_system, random_trial, trials
from estimator.reference.drive import model_of, run
from testbed.estimator.imm import Imm
from testbed.estimator.registry import create

TOLERANCE = 1e-10
UNDERFLOW = 1e-200
"""filterpy takes the smallest float for a likelihood that underflows, which is wrong where both do."""
RADII = (0.3, 0.9, 1.0, 1.2)


@st.composite
def long_trials(draw: st.DrawFn) -> Trial:
    """Stable and unstable systems, with losses on both links."""
    seed = draw(st.integers(0, 2**32 - 1), label="seed")
    radius = draw(st.sampled_from(RADII), label="spectral radius")
    n, p = draw(st.integers(1, 4), label="n"), draw(st.integers(1, 3), label="p")
    rng = np.random.default_rng(seed)
    system = random_system(rng, n, p, 1)
    system = replace(system, A=system.A * radius / np.abs(np.linalg.eigvals(system.A)).max())
    return random_trial(rng, system, steps=25, lanes=3, acks="all")


@check(60)
@given(st.one_of(trials(acks=("all",)), long_trials()))
def test_kfio_is_the_kalman_filter_of_filterpy(trial: Trial) -> None:
    assert_same(run("kfio", trial), _filterpy(trial), TOLERANCE)


@check(40)
@given(st.one_of(trials(acks=("all",)), long_trials()))
def test_kfio_is_the_kalman_filter_of_statsmodels(trial: Trial) -> None:
    """Optional, since it brings pandas: skipped where statsmodels is not installed."""
    filters = pytest.importorskip("statsmodels.tsa.statespace.kalman_filter", reason="optional: statsmodels is heavy")
    assert_same(run("kfio", trial), _statsmodels(filters, trial), TOLERANCE)


@check(40)
@given(
    seed=st.integers(0, 2**32 - 1),
    sizes=st.tuples(st.integers(1, 3), st.integers(1, 2), st.integers(1, 2)),
    chain=st.sampled_from(("bernoulli", "markov")),
    radius=st.sampled_from(RADII),
)
def test_imm_is_the_imm_of_filterpy(seed: int, sizes: tuple[int, int, int], chain: str, radius: float) -> None:
    rng = np.random.default_rng(seed)
    system = random_system(rng, *sizes, chain)
    stationary = system.recovery / (system.recovery + system.failure)
    A = system.A * radius / np.abs(np.linalg.eigvals(system.A)).max()
    system = replace(system, A=A, start=stationary, P0=system.P0 + np.eye(system.n))
    trial = random_trial(rng, system, 12, 1, arrivals="all")
    trial = replace(trial, u=trial.u * 0.1)
    imm = _filterpy_imm(system, stationary)
    ours = create("imm", model_of(system), lanes=1)
    assert isinstance(ours, Imm)
    for k in range(trial.steps):
        imm.predict(trial.u[k, 0])
        imm.update(trial.y[k, 0])
        assume(max(one.likelihood for one in imm.filters) > UNDERFLOW)
        out = ours.step(trial.u[k], trial.y[k], trial.arrived[k])
        theirs = imm.x[None, None], imm.P[None, None]
        assert_same((out.x_hat[None], out.P[None]), theirs, TOLERANCE)
        np.testing.assert_allclose(ours.mode_probabilities[0], imm.mu, rtol=0, atol=TOLERANCE)


def _filterpy(trial: Trial) -> tuple[Floats, Floats]:
    system, steps, lanes = trial.system, trial.steps, trial.lanes
    x_hat, P = np.empty((steps, lanes, system.n)), np.empty((steps, lanes, system.n, system.n))
    for lane in range(lanes):
        one = _filterpy_filter(system, 1)
        for k in range(steps):
            one.predict(trial.u[k, lane] * trial.nu[k, lane])
            one.update(trial.y[k, lane] if trial.arrived[k, lane] else None)
            x_hat[k, lane], P[k, lane] = one.x, one.P
    return x_hat, P


def _filterpy_filter(system: System, nu: int) -> Any:
    one = KalmanFilter(dim_x=system.n, dim_z=system.p, dim_u=system.q)
    one.F, one.B, one.H, one.Q, one.R = system.A, nu * system.B, system.C, system.Q, system.R
    one.x, one.P = system.x0_mean.copy(), system.P0.copy()
    return one


def _filterpy_imm(system: System, stationary: float) -> Any:
    chain = np.array([[1 - system.recovery, system.recovery], [system.failure, 1 - system.failure]])
    filters = [_filterpy_filter(system, nu) for nu in (0, 1)]
    return IMMEstimator(filters, np.array([1 - stationary, stationary]), chain)


def _statsmodels(filters: Any, trial: Trial) -> tuple[Floats, Floats]:
    """Its state is predicted to the first observation already, and its intercept leads on to the next."""
    system, steps, lanes = trial.system, trial.steps, trial.lanes
    x_hat, P = np.empty((steps, lanes, system.n)), np.empty((steps, lanes, system.n, system.n))
    for lane in range(lanes):
        pushes = (trial.nu[:, lane, None] * trial.u[:, lane]) @ system.B.T
        one = filters.KalmanFilter(k_endog=system.p, k_states=system.n, tolerance=0.0)
        one.bind(np.where(trial.arrived[:, lane, None], trial.y[:, lane], np.nan))
        one["design"], one["transition"], one["selection"] = system.C, system.A, np.eye(system.n)
        one["obs_cov"], one["state_cov"] = system.R, system.Q
        one["state_intercept"] = np.vstack([pushes[1:], np.zeros((1, system.n))]).T
        first = system.A @ system.x0_mean + pushes[0]
        one.initialize_known(first, system.A @ system.P0 @ system.A.T + system.Q)
        found = one.filter()
        x_hat[:, lane], P[:, lane] = found.filtered_state.T, found.filtered_state_cov.transpose(2, 0, 1)
    return x_hat, P
