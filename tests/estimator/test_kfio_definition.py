"""KFIO is the mean and covariance of x_k given the received y and the true ν."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given

from estimator.reference import gaussian
from estimator.reference.cases import Floats, Trial, check, random_system, random_trial, trials
from estimator.reference.compare import covariance_error, mean_error
from estimator.reference.drive import model_of, run
from testbed.estimator.registry import create

TOLERANCE = 1e-10


def _agrees(trial: Trial, x_hat: Floats, P: Floats) -> None:
    assert x_hat.shape == (trial.steps, trial.lanes, trial.system.n)
    assert P.shape == (*x_hat.shape, trial.system.n)
    for k in range(1, trial.steps + 1):
        for lane in range(trial.lanes):
            mean, cov = gaussian.kfio(
                trial.system, trial.u[:k, lane], trial.y[:k, lane], trial.arrived[:k, lane], trial.nu[:k, lane]
            )
            assert covariance_error(P[k - 1, lane], cov) < TOLERANCE
            assert mean_error(x_hat[k - 1, lane], mean, cov) < TOLERANCE


@check(40)
@given(trials(acks=("all",), steps=(1, 8)))
def test_is_the_conditional_moments(trial: Trial) -> None:
    _agrees(trial, *run("kfio", trial))


@pytest.mark.parametrize(("recovery", "failure", "start"), [(1.0, 0.0, 1.0), (0.4, 0.0, 1.0)])
def test_needs_no_ack_of_a_chain_that_never_loses(recovery: float, failure: float, start: float) -> None:
    rng = np.random.default_rng(1)
    system = replace(random_system(rng, 2, 1, 1), recovery=recovery, failure=failure, start=start)
    trial = random_trial(rng, system, 5, lanes=3)
    assert trial.nu.all()
    _agrees(trial, *run("kfio", trial))


def test_needs_no_ack_where_the_control_moves_nothing() -> None:
    """Lane 0 has u = 0 and no ACK at odd steps, lane 1 has B u = 0 with u ≠ 0 and no ACK, lane 2 has every ACK."""
    rng = np.random.default_rng(2)
    system = replace(random_system(rng, 2, 1, 2), B=np.array([[1.0, -1.0], [2.0, -2.0]]))
    trial = random_trial(rng, system, 6, lanes=3, acks="all")
    trial.u[::2, 0] = 0.0
    trial.ack_step[::2, 0] = 0
    trial.u[:, 1] = 3.0
    trial.ack_step[:, 1] = 0
    _agrees(trial, *run("kfio", trial))


def test_needs_no_ack_without_control() -> None:
    rng = np.random.default_rng(3)
    system = replace(random_system(rng, 2, 1, 1), B=np.zeros((2, 0)))
    trial = random_trial(rng, system, 5, lanes=2)
    model = replace(model_of(system), B=None)
    est = create("kfio", model, lanes=2, options={})
    outs = [est.step(trial.u[k], trial.y[k], trial.arrived[k], ()) for k in range(trial.steps)]
    _agrees(trial, np.array([out.x_hat for out in outs]), np.array([out.P for out in outs]))
