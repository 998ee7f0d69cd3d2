"""LMMSE: the regression of the state on all that was received, with the covariance of its error."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from scipy.optimize import minimize

from estimator.agreement import assert_same
from estimator.reference.cases import ACKS, Floats, Trial, check, random_system, random_trial, trials
from estimator.reference.drive import acks_at, model_of, run
from estimator.reference.histories import weighted_histories
from estimator.reference.lmmse import lmmse
from testbed.errors import UsageError
from testbed.estimator.registry import create

TOLERANCE = 1e-9


def _reference(trial: Trial) -> tuple[Floats, Floats]:
    shape = trial.steps, trial.lanes, trial.system.n
    x_hat, P = np.empty(shape), np.empty((*shape, trial.system.n))
    for k in range(1, trial.steps + 1):
        for lane in range(trial.lanes):
            known = trial.known_in_time(k, lane)
            x_hat[k - 1, lane], P[k - 1, lane] = lmmse(
                trial.system, trial.u[:k, lane], trial.y[:k, lane], trial.arrived[:k, lane], known
            )
    return x_hat, P


@check(40)
@given(trials(chains=("bernoulli",)))
def test_is_the_regression_on_all_that_was_received(trial: Trial) -> None:
    """Late ACKs change nothing; an ACK in time puts ν for its mean."""
    assert_same(run("lmmse", trial), _reference(trial), TOLERANCE)


@pytest.mark.parametrize("rate", [0.0, 0.2, 0.5, 0.8, 1.0])
@pytest.mark.parametrize("acks", ACKS)
def test_at_eight_steps(rate: float, acks: str) -> None:
    rng = np.random.default_rng([ACKS.index(acks), 3])
    system = replace(random_system(rng, 2, 1, 1), recovery=rate, failure=1 - rate, start=rate)
    trial = random_trial(rng, system, 8, 2, acks)
    assert_same(run("lmmse", trial), _reference(trial), TOLERANCE)


def _one_step_trace(trial: Trial, gain: Floats) -> float:
    """Trace of the error covariance of x̂_1 = x̄ + gain · (y_1 − its mean), over ν_0 and the noises."""
    system = trial.system
    total = 0.0
    noise = system.A @ system.P0 @ system.A.T + system.Q
    rest = np.eye(system.n) - gain @ system.C
    histories, priors = weighted_histories(system, 1, {})
    for (nu,), prior in zip(histories, priors, strict=True):
        surprise = rest @ ((nu - system.start) * system.B @ trial.u[0, 0])
        total += prior * float(surprise @ surprise)
    return total + float(np.trace(rest @ noise @ rest.T + gain @ system.R @ gain.T))


@pytest.mark.parametrize("seed", range(4))
def test_no_gain_does_better(seed: int) -> None:
    rng = np.random.default_rng([seed, 21])
    system = random_system(rng, 2, 1, 1, "bernoulli")
    trial = random_trial(rng, system, 1, 1, arrivals="all")
    best = minimize(lambda g: _one_step_trace(trial, g.reshape(2, 1)), np.zeros(2), tol=1e-12)
    _, P = run("lmmse", trial)
    assert np.trace(P[0, 0]) == pytest.approx(best.fun, rel=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_is_not_worse_than_ff(seed: int) -> None:
    rng = np.random.default_rng([seed, 22])
    trial = random_trial(rng, random_system(rng, 2, 1, 1, "bernoulli"), 12, 2)
    best, fast = (np.trace(run(kind, trial)[1], axis1=2, axis2=3) for kind in ("lmmse", "ff"))
    assert (best <= fast * (1 + 1e-12)).all()
    assert (best < fast * (1 - 1e-6)).any()


@check(30)
@given(trials(acks=("all",), chains=("bernoulli",), steps=(1, 12)))
def test_all_acks_in_time_is_kfio(trial: Trial) -> None:
    assert_same(run("lmmse", trial), run("kfio", trial), 1e-9)


def test_a_late_ack_is_counted() -> None:
    rng = np.random.default_rng(9)
    trial = random_trial(rng, random_system(rng, 2, 1, 1, "bernoulli"), 4, 1)
    trial.ack_step[:, 0] = [1, 4, 3, 0]
    est = create("lmmse", model_of(trial.system), lanes=1, options={})
    for k in range(1, trial.steps + 1):
        est.step(trial.u[k - 1], trial.y[k - 1], trial.arrived[k - 1], acks_at(trial, k))
    assert est.counters == {"late_acks": 1}


def test_markov_losses_are_refused() -> None:
    system = random_system(np.random.default_rng(1), 2, 1, 1, "markov")
    with pytest.raises(UsageError, match=r"i\.i\.d\."):
        create("lmmse", model_of(system), lanes=1)
