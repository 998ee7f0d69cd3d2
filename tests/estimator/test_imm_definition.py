"""IMM: one estimator with AOE for i.i.d. losses. For Markov losses see test_other_libraries.py."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given

from estimator.agreement import assert_same
from estimator.reference.cases import Trial, check, random_system, random_trial, trials
from estimator.reference.drive import acks_at, model_of, run
from testbed.estimator.imm import Imm
from testbed.estimator.registry import create

DEGENERATE = [(1.0, 0.0, 1.0), (0.0, 1.0, 0.0), (0.0, 0.0, 0.4), (1.0, 1.0, 0.3), (0.0, 0.3, 1.0), (0.5, 0.0, 0.5)]


@check(40)
@given(trials(chains=("bernoulli",), steps=(1, 8)))
def test_is_aoe_for_independent_losses(trial: Trial) -> None:
    assert_same(run("imm", trial), run("aoe", trial), 1e-12)
    assert_same(run("imm", trial), run("gpb1", trial), 1e-12)


@check(20)
@given(trials(acks=("none", "subset"), steps=(1, 1)))
def test_first_step_is_oe(trial: Trial) -> None:
    assert_same(run("imm", trial), run("oe", trial), 1e-11)


@check(30)
@given(trials(acks=("all",), steps=(1, 12)))
def test_all_acks_in_time_is_kfio(trial: Trial) -> None:
    assert_same(run("imm", trial), run("kfio", trial), 1e-9)


@pytest.mark.parametrize("lanes", [1, 3])
def test_without_observations_the_modes_follow_the_chain(lanes: int) -> None:
    rng = np.random.default_rng(3)
    trial = random_trial(rng, random_system(rng, 2, 1, 1), 5, lanes, arrivals="none")
    system = trial.system
    est = create("imm", model_of(system), lanes=lanes)
    assert isinstance(est, Imm)
    law = np.array([1 - system.start, system.start])
    chain = np.array([[1 - system.recovery, system.recovery], [system.failure, 1 - system.failure]])
    for k in range(trial.steps):
        est.step(trial.u[k], trial.y[k], trial.arrived[k])
        np.testing.assert_allclose(est.mode_probabilities, np.tile(law, (lanes, 1)), rtol=1e-13)
        law = law @ chain


@pytest.mark.parametrize("acks", ["none", "subset"])
@pytest.mark.parametrize(("recovery", "failure", "start"), DEGENERATE)
def test_losses_that_cannot_happen(recovery: float, failure: float, start: float, acks: str) -> None:
    rng = np.random.default_rng(4)
    system = replace(random_system(rng, 2, 1, 1), recovery=recovery, failure=failure, start=start)
    trial = random_trial(rng, system, 8, 3, acks)
    x_hat, P = run("imm", trial)
    assert np.isfinite(x_hat).all()
    assert np.isfinite(P).all()
    if {recovery, failure} <= {0.0, 1.0}:  # the first ν decides all others, and no modes mix
        assert_same((x_hat, P), run("oe", trial), 1e-9)


def test_a_late_ack_is_counted() -> None:
    rng = np.random.default_rng(9)
    trial = random_trial(rng, random_system(rng, 2, 1, 1), 4, 1)
    trial.ack_step[:, 0] = [1, 4, 3, 0]
    est = create("imm", model_of(trial.system), lanes=1)
    for k in range(1, trial.steps + 1):
        est.step(trial.u[k - 1], trial.y[k - 1], trial.arrived[k - 1], acks_at(trial, k))
    assert est.counters == {"late_acks": 1}
