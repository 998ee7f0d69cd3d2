"""OE is the mean and covariance of the mixture over all control-loss histories that agree with the known ACKs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given

from estimator.reference import gaussian
from estimator.reference.cases import (
    ACKS,
    ARRIVALS,
    HIDDEN,
    Floats,
    System,
    Trial,
    check,
    random_system,
    random_trial,
    trials,
)
from estimator.reference.compare import covariance_error, mean_error
from estimator.reference.drive import acks_at, model_of, run
from testbed.estimator.registry import create

CHAINS = ("bernoulli", "markov", HIDDEN)
TOLERANCE = 1e-9
DEGENERATE = [(1.0, 0.0, 1.0), (0.0, 1.0, 0.0), (0.0, 0.0, 0.4), (1.0, 1.0, 0.3), (0.0, 0.3, 1.0), (0.5, 0.0, 0.5)]


def _agrees(trial: Trial, x_hat: Floats, P: Floats) -> None:
    assert x_hat.shape == (trial.steps, trial.lanes, trial.system.n)
    assert P.shape == (*x_hat.shape, trial.system.n)
    for k in range(1, trial.steps + 1):
        for lane in range(trial.lanes):
            mean, cov = gaussian.oe(
                trial.system, trial.u[:k, lane], trial.y[:k, lane], trial.arrived[:k, lane], trial.known(k, lane)
            )
            assert covariance_error(P[k - 1, lane], cov) < TOLERANCE
            assert mean_error(x_hat[k - 1, lane], mean, cov) < TOLERANCE


@check(60)
@given(trials())
def test_is_the_mixture_over_histories(trial: Trial) -> None:
    _agrees(trial, *run("oe", trial))


@pytest.mark.parametrize("acks", ACKS)
@pytest.mark.parametrize("chain", CHAINS)
@pytest.mark.parametrize("arrivals", ARRIVALS)
def test_is_the_mixture_at_eight_steps(chain: str, acks: str, arrivals: str) -> None:
    rng = np.random.default_rng([CHAINS.index(chain), ACKS.index(acks), ARRIVALS.index(arrivals)])
    system = random_system(rng, 2, 1, 1, chain)
    trial = random_trial(rng, system, 8, 3, acks, arrivals)
    _agrees(trial, *run("oe", trial))


@pytest.mark.parametrize("acks", ["none", "late"])
@pytest.mark.parametrize(("recovery", "failure", "start"), DEGENERATE)
def test_histories_that_cannot_happen(recovery: float, failure: float, start: float, acks: str) -> None:
    rng = np.random.default_rng([4, ACKS.index(acks)])
    system = replace(random_system(rng, 2, 1, 1), recovery=recovery, failure=failure, start=start)
    trial = random_trial(rng, system, 5, 3, acks)
    _agrees(trial, *run("oe", trial))


@pytest.mark.parametrize("acks", ["none", "late"])
def test_observations_that_no_history_expects(acks: str) -> None:
    """60 and more standard deviations away: every likelihood is below the smallest float, their ratios are not."""
    rng = np.random.default_rng(5)
    trial = random_trial(rng, random_system(rng, 2, 1, 1), 4, 3, acks, arrivals="all")
    trial.y[1] += 60 * np.sqrt(trial.system.R[0, 0] + np.trace(trial.system.Q) + np.trace(trial.system.P0))
    trial.y[3] -= 300.0
    _agrees(trial, *run("oe", trial))


@pytest.mark.parametrize("change", [0.0, 1e-3])
@pytest.mark.parametrize("push", [5.0, 40.0])
def test_histories_that_looked_impossible_come_back(change: float, push: float) -> None:
    """Three observations say that nothing is applied, the next say that everything was, against odds of e^-push²."""
    one = np.eye(1)
    system = System(0.9 * one, one, one, 0.5 * one, one, np.zeros(1), one, recovery=change, failure=change, start=0.5)
    y = push * np.array([0.0, 0.0, 0.0, 4.0, 8.0, 8.0])[:, None, None]
    empty = np.zeros((6, 1), dtype=np.int64)
    trial = Trial(system, np.full((6, 1, 1), push), y, np.ones((6, 1), dtype=bool), empty, empty)
    _agrees(trial, *run("oe", trial))


@pytest.mark.parametrize("push", [1e-3, 1e3])
def test_controls_much_smaller_and_larger_than_the_noise(push: float) -> None:
    rng = np.random.default_rng(6)
    trial = random_trial(rng, random_system(rng, 2, 1, 1), 5, 3)
    trial = replace(trial, u=trial.u * push)
    _agrees(trial, *run("oe", trial))


@check(30)
@given(trials(acks=("all",), steps=(1, 12)))
def test_all_acks_in_time_is_kfio(trial: Trial) -> None:
    (x_oe, P_oe), (x_kf, P_kf) = run("oe", trial), run("kfio", trial)
    for k in range(trial.steps):
        for lane in range(trial.lanes):
            assert mean_error(x_oe[k, lane], x_kf[k, lane], P_kf[k, lane]) < 1e-12
            assert covariance_error(P_oe[k, lane], P_kf[k, lane]) < 1e-12


def test_all_acks_at_the_last_step_is_kfio() -> None:
    rng = np.random.default_rng(7)
    trial = random_trial(rng, random_system(rng, 2, 1, 1), 8, 3, acks="all")
    late = replace(trial, ack_step=np.full_like(trial.ack_step, trial.steps))
    (x_oe, P_oe), (x_kf, P_kf) = run("oe", late), run("kfio", trial)
    for lane in range(trial.lanes):
        assert mean_error(x_oe[-1, lane], x_kf[-1, lane], P_kf[-1, lane]) < TOLERANCE
        assert covariance_error(P_oe[-1, lane], P_kf[-1, lane]) < TOLERANCE


@check(20)
@given(trials(acks=("subset", "late")))
def test_an_ack_twice_says_no_more_than_once(trial: Trial) -> None:
    _agrees(trial, *run("oe", trial, again=True))


def test_no_ack_is_too_late() -> None:
    rng = np.random.default_rng(8)
    trial = random_trial(rng, random_system(rng, 2, 1, 1), 7, 2, acks="late")
    est = create("oe", model_of(trial.system), lanes=2, options={})
    for k in range(1, trial.steps + 1):
        est.step(trial.u[k - 1], trial.y[k - 1], trial.arrived[k - 1], acks_at(trial, k))
    assert est.counters.get("late_acks", 0) == 0
