"""What every estimator keeps: symmetric and PSD covariances, and estimates that follow a change of coordinates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimator.reference.cases import Trial, check, trials
from estimator.reference.compare import covariance_error, mean_error, smallest_eigenvalue
from estimator.reference.drive import run, run_bounds

KINDS = ["kfio", "kf", "oe", "aoe", "ff", "lmmse", "gpb", "gpb1", "gpb2", "imm"]


def _trials(kind: str, steps: tuple[int, int]) -> st.SearchStrategy[Trial]:
    chains = ("bernoulli",) if kind in ("ff", "lmmse") else ("bernoulli", "markov")
    acks = ("all",) if kind in ("kfio", "kf") else ("none", "all", "subset", "late")
    return trials(acks=acks, chains=chains, steps=steps)


@pytest.mark.parametrize("kind", KINDS)
@check(25)
@given(data=st.data())
def test_covariances_are_symmetric_and_positive(kind: str, data: st.DataObject) -> None:
    _, covariances = run(kind, data.draw(_trials(kind, (1, 10))))
    for P in covariances.reshape(-1, *covariances.shape[2:]):
        assert np.isfinite(P).all()
        assert np.abs(P - P.T).max() <= 1e-14 * np.abs(P).max()
        assert smallest_eigenvalue(P) > -1e-12


@check(25)
@given(trials(steps=(1, 10)))
def test_bounds_are_symmetric_and_positive(trial: Trial) -> None:
    for bound in run_bounds(trial, trial.system.B @ trial.system.B.T):
        for P in bound.reshape(-1, *bound.shape[2:]):
            assert np.abs(P - P.T).max() <= 1e-14 * np.abs(P).max()
            assert smallest_eigenvalue(P) > -1e-12


@pytest.mark.parametrize("kind", KINDS)
@check(20)
@given(data=st.data())
def test_estimates_follow_a_change_of_coordinates(kind: str, data: st.DataObject) -> None:
    trial = data.draw(_trials(kind, (1, 6)))
    n = trial.system.n
    T = np.random.default_rng(n).normal(size=(n, n)) + 2 * np.eye(n)
    x_hat, P = run(kind, trial)
    moved_x, moved_P = run(kind, replace(trial, system=trial.system.moved(T)))
    for k in range(trial.steps):
        for lane in range(trial.lanes):
            expected = T @ P[k, lane] @ T.T
            assert covariance_error(moved_P[k, lane], expected) < 1e-8
            assert mean_error(moved_x[k, lane], T @ x_hat[k, lane], expected) < 1e-8


@check(15)
@given(trials(acks=("none",)))
def test_bounds_follow_a_change_of_coordinates(trial: Trial) -> None:
    n = trial.system.n
    T = np.random.default_rng(n).normal(size=(n, n)) + 2 * np.eye(n)
    U = trial.system.B @ trial.system.B.T
    moved = run_bounds(replace(trial, system=trial.system.moved(T)), T @ U @ T.T)
    for bound, other in zip(run_bounds(trial, U), moved, strict=True):
        for k in range(trial.steps):
            for lane in range(trial.lanes):
                assert covariance_error(other[k, lane], T @ bound[k, lane] @ T.T) < 1e-8


@check(20)
@given(trials(acks=("all",), chains=("bernoulli",)))
def test_without_control_all_are_one(trial: Trial) -> None:
    still = replace(trial, u=np.zeros_like(trial.u), ack_step=np.zeros_like(trial.ack_step))
    x_kf, P_kf = run("kfio", still)
    for kind in KINDS[1:]:
        x_hat, P = run(kind, still)
        for k in range(trial.steps):
            for lane in range(trial.lanes):
                assert mean_error(x_hat[k, lane], x_kf[k, lane], P_kf[k, lane]) < 1e-10
                assert covariance_error(P[k, lane], P_kf[k, lane]) < 1e-10
