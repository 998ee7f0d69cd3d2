"""AOE: two hypotheses a step, conditioned, then one Gaussian with the moments of the two (M Theorem 2)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given

from estimator.reference.aoe import aoe
from estimator.reference.cases import Floats, System, Trial, check, random_system, random_trial, trials
from estimator.reference.compare import covariance_error, mean_error
from estimator.reference.drive import acks_at, model_of, run
from testbed.estimator.registry import create

TOLERANCE = 1e-10
DEGENERATE = [(1.0, 0.0, 1.0), (0.0, 1.0, 0.0), (0.0, 0.0, 0.4), (1.0, 1.0, 0.3), (0.0, 0.3, 1.0), (0.5, 0.0, 0.5)]


def _agrees(trial: Trial, x_hat: Floats, P: Floats) -> None:
    assert x_hat.shape == (trial.steps, trial.lanes, trial.system.n)
    assert P.shape == (*x_hat.shape, trial.system.n)
    for lane in range(trial.lanes):
        known = trial.known_in_time(trial.steps, lane)
        estimates = aoe(trial.system, trial.u[:, lane], trial.y[:, lane], trial.arrived[:, lane], known)
        for k, (mean, cov) in enumerate(estimates):
            assert covariance_error(P[k, lane], cov) < TOLERANCE
            assert mean_error(x_hat[k, lane], mean, cov) < TOLERANCE


@check(60)
@given(trials(steps=(1, 8)))
def test_is_two_hypotheses_and_moment_matching(trial: Trial) -> None:
    """Late ACKs change nothing; an ACK in time leaves one hypothesis."""
    _agrees(trial, *run("aoe", trial))


@pytest.mark.parametrize("acks", ["none", "subset"])
@pytest.mark.parametrize(("recovery", "failure", "start"), DEGENERATE)
def test_losses_that_cannot_happen(recovery: float, failure: float, start: float, acks: str) -> None:
    rng = np.random.default_rng(4)
    system = replace(random_system(rng, 2, 1, 1), recovery=recovery, failure=failure, start=start)
    trial = random_trial(rng, system, 5, 3, acks)
    _agrees(trial, *run("aoe", trial))


def test_observations_that_no_hypothesis_expects() -> None:
    rng = np.random.default_rng(5)
    trial = random_trial(rng, random_system(rng, 2, 1, 1), 4, 3, arrivals="all")
    trial.y[1] += 60 * np.sqrt(trial.system.R[0, 0] + np.trace(trial.system.Q) + np.trace(trial.system.P0))
    trial.y[3] -= 300.0
    _agrees(trial, *run("aoe", trial))


def test_a_weight_next_to_one_leaves_the_other_exact() -> None:
    """Without process noise all of P comes from the small weight, here about 1e-8."""
    one, zero = np.eye(1), np.zeros((1, 1))
    system = System(
        -0.5 * one,
        -2.0 * one,
        -1.8 * one,
        zero,
        0.31 * one,
        np.array([1.7]),
        zero,
        recovery=0.5,
        failure=0.8,
        start=0.4,
    )
    empty = np.zeros((1, 1), dtype=np.int64)
    trial = Trial(system, 0.944 * one[None], 4.98 * one[None], np.ones((1, 1), dtype=bool), empty, empty)
    _agrees(trial, *run("aoe", trial))


@check(40)
@given(trials(acks=("none", "all"), steps=(1, 1)))
def test_first_step_is_oe(trial: Trial) -> None:
    (x_aoe, P_aoe), (x_oe, P_oe) = run("aoe", trial), run("oe", trial)
    for lane in range(trial.lanes):
        assert mean_error(x_aoe[0, lane], x_oe[0, lane], P_oe[0, lane]) < 1e-12
        assert covariance_error(P_aoe[0, lane], P_oe[0, lane]) < 1e-12


@check(30)
@given(trials(acks=("all",), steps=(1, 12)))
def test_all_acks_in_time_is_kfio(trial: Trial) -> None:
    (x_aoe, P_aoe), (x_kf, P_kf) = run("aoe", trial), run("kfio", trial)
    for k in range(trial.steps):
        for lane in range(trial.lanes):
            assert mean_error(x_aoe[k, lane], x_kf[k, lane], P_kf[k, lane]) < TOLERANCE
            assert covariance_error(P_aoe[k, lane], P_kf[k, lane]) < TOLERANCE


@check(20)
@given(trials(acks=("none",), chains=("bernoulli",), steps=(2, 6), lanes=(1, 2)))
def test_forgets_the_last_loss_when_losses_are_independent(trial: Trial) -> None:
    """With i.i.d. losses each step is the exact posterior of a system that starts at the last x̂ and P."""
    x_hat, P = run("aoe", trial)
    for lane in range(trial.lanes):
        for k in range(1, trial.steps):
            start = replace(trial.system, x0_mean=x_hat[k - 1, lane], P0=P[k - 1, lane])
            one = replace(
                trial.of_lanes(slice(lane, lane + 1)),
                system=start,
                u=trial.u[k : k + 1, lane : lane + 1],
                y=trial.y[k : k + 1, lane : lane + 1],
                arrived=trial.arrived[k : k + 1, lane : lane + 1],
            )
            one = replace(one, nu=one.nu[:1], ack_step=one.ack_step[:1])
            x_one, P_one = run("oe", one)
            assert mean_error(x_hat[k, lane], x_one[0, 0], P_one[0, 0]) < TOLERANCE
            assert covariance_error(P[k, lane], P_one[0, 0]) < TOLERANCE


def test_a_late_ack_is_counted() -> None:
    rng = np.random.default_rng(9)
    trial = random_trial(rng, random_system(rng, 2, 1, 1), 4, 1)
    trial.ack_step[:, 0] = [1, 4, 3, 0]
    est = create("aoe", model_of(trial.system), lanes=1, options={})
    counts = []
    for k in range(1, trial.steps + 1):
        est.step(trial.u[k - 1], trial.y[k - 1], trial.arrived[k - 1], acks_at(trial, k))
        counts.append(est.counters.get("late_acks", 0))
    assert counts == [0, 0, 0, 1]
