"""FF: its equation for x̃ with the gain of the ACK filter, and P̃ the covariance of its error over losses and noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given

from estimator.reference.cases import ACKS, Floats, Trial, check, random_system, random_trial, trials
from estimator.reference.compare import covariance_error, mean_error
from estimator.reference.drive import acks_at, model_of, run
from estimator.reference.ff import ff
from testbed.estimator.registry import create

TOLERANCE = 1e-10


def _agrees(trial: Trial, x_hat: Floats, P: Floats) -> None:
    assert x_hat.shape == (trial.steps, trial.lanes, trial.system.n)
    assert P.shape == (*x_hat.shape, trial.system.n)
    for k in range(1, trial.steps + 1):
        for lane in range(trial.lanes):
            known = trial.known_in_time(k, lane)
            mean, cov = ff(trial.system, trial.u[:k, lane], trial.y[:k, lane], trial.arrived[:k, lane], known)
            assert covariance_error(P[k - 1, lane], cov) < TOLERANCE
            assert mean_error(x_hat[k - 1, lane], mean, cov) < TOLERANCE


@check(50)
@given(trials(chains=("bernoulli",)))
def test_covariance_is_that_of_the_error(trial: Trial) -> None:
    """Late ACKs change nothing; an ACK in time puts ν for its mean."""
    _agrees(trial, *run("ff", trial))


@pytest.mark.parametrize("rate", [0.0, 0.2, 0.5, 0.8, 1.0])
@pytest.mark.parametrize("acks", ACKS)
def test_at_eight_steps(rate: float, acks: str) -> None:
    rng = np.random.default_rng([ACKS.index(acks), 3])
    system = replace(random_system(rng, 2, 1, 1), recovery=rate, failure=1 - rate, start=rate)
    trial = random_trial(rng, system, 8, 2, acks)
    _agrees(trial, *run("ff", trial))


@check(30)
@given(trials(acks=("all",), chains=("bernoulli",), steps=(1, 12)))
def test_all_acks_in_time_is_kfio(trial: Trial) -> None:
    (x_ff, P_ff), (x_kf, P_kf) = run("ff", trial), run("kfio", trial)
    for k in range(trial.steps):
        for lane in range(trial.lanes):
            assert mean_error(x_ff[k, lane], x_kf[k, lane], P_kf[k, lane]) < TOLERANCE
            assert covariance_error(P_ff[k, lane], P_kf[k, lane]) < TOLERANCE


def test_a_late_ack_is_counted() -> None:
    rng = np.random.default_rng(9)
    trial = random_trial(rng, random_system(rng, 2, 1, 1, "bernoulli"), 4, 1)
    trial.ack_step[:, 0] = [1, 4, 3, 0]
    est = create("ff", model_of(trial.system), lanes=1, options={})
    counts = []
    for k in range(1, trial.steps + 1):
        est.step(trial.u[k - 1], trial.y[k - 1], trial.arrived[k - 1], acks_at(trial, k))
        counts.append(est.counters.get("late_acks", 0))
    assert counts == [0, 0, 0, 1]
