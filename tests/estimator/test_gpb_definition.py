"""GPB: AOE at order 0, OE at order k, and between them the merging of what differs in old control bits alone."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given

from estimator.agreement import assert_same
from estimator.reference.cases import CHAINS, Floats, System, Trial, check, random_system, random_trial, trials
from estimator.reference.drive import acks_at, model_of, run
from estimator.reference.gpb import gpb
from testbed.estimator.registry import create

DEGENERATE = [(1.0, 0.0, 1.0), (0.0, 1.0, 0.0), (0.0, 0.0, 0.4), (1.0, 1.0, 0.3), (0.0, 0.3, 1.0), (0.5, 0.0, 0.5)]


@check(40)
@given(trials(steps=(1, 6)))
def test_order_k_is_oe(trial: Trial) -> None:
    """With every ACK, however late: none is older than the bits that are told apart."""
    assert_same(run("gpb", trial, {"order": trial.steps}), run("oe", trial), 1e-10)


@check(20)
@given(trials(acks=("none", "subset"), steps=(1, 5)))
def test_order_d_is_oe_up_to_step_d_and_one(trial: Trial) -> None:
    assert_same(run("gpb", trial, {"order": trial.steps - 1}), run("oe", trial), 1e-10)


@check(40)
@given(trials(steps=(1, 8)))
def test_order_0_is_aoe(trial: Trial) -> None:
    assert_same(run("gpb", trial, {"order": 0}), run("aoe", trial), 1e-10)


@check(15)
@given(trials(steps=(1, 6)))
def test_the_names_of_the_literature(trial: Trial) -> None:
    for kind, order in (("gpb1", 0), ("gpb2", 1)):
        assert_same(run(kind, trial), run("gpb", trial, {"order": order}), 1e-300)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("acks", ["none", "late"])
@pytest.mark.parametrize("chain", CHAINS)
def test_is_moment_matching_of_what_differs_in_older_bits(order: int, acks: str, chain: str) -> None:
    for seed in range(4):
        rng = np.random.default_rng([seed, order, CHAINS.index(chain)])
        trial = random_trial(rng, random_system(rng, 2, 1, 1, chain), 8, 2, acks)
        assert_same(run("gpb", trial, {"order": order}), _reference(trial, order), 1e-9)


def _reference(trial: Trial, order: int) -> tuple[Floats, Floats]:
    x_hat, P = [], []
    for lane in range(trial.lanes):
        known = [trial.known(k, lane) for k in range(1, trial.steps + 1)]
        out = gpb(trial.system, order, trial.u[:, lane], trial.y[:, lane], trial.arrived[:, lane], known)
        x_hat.append([mean for mean, _ in out])
        P.append([cov for _, cov in out])
    return np.array(x_hat).swapaxes(0, 1), np.array(P).swapaxes(0, 1)


@pytest.mark.parametrize("acks", ["none", "late"])
@pytest.mark.parametrize(("recovery", "failure", "start"), DEGENERATE)
def test_histories_that_cannot_happen(recovery: float, failure: float, start: float, acks: str) -> None:
    rng = np.random.default_rng(4)
    system = replace(random_system(rng, 2, 1, 1), recovery=recovery, failure=failure, start=start)
    trial = random_trial(rng, system, 5, 3, acks)
    assert_same(run("gpb", trial, {"order": 5}), run("oe", trial), 1e-10)
    for order in (0, 1):
        x_hat, P = run("gpb", trial, {"order": order})
        assert np.isfinite(x_hat).all()
        assert np.isfinite(P).all()


@pytest.mark.parametrize("change", [0.0, 1e-3])
@pytest.mark.parametrize("push", [5.0, 40.0])
def test_histories_that_looked_impossible_come_back(change: float, push: float) -> None:
    """Three observations say that nothing is applied, the next say that everything was, against odds of e^-push²."""
    one = np.eye(1)
    system = System(0.9 * one, one, one, 0.5 * one, one, np.zeros(1), one, recovery=change, failure=change, start=0.5)
    y = push * np.array([0.0, 0.0, 0.0, 4.0, 8.0, 8.0])[:, None, None]
    empty = np.zeros((6, 1), dtype=np.int64)
    trial = Trial(system, np.full((6, 1, 1), push), y, np.ones((6, 1), dtype=bool), empty, empty)
    assert_same(run("gpb", trial, {"order": 6}), run("oe", trial), 1e-9)


@pytest.mark.parametrize("chain", CHAINS)
def test_the_error_decreases_with_the_order(chain: str) -> None:
    """Mean distance to OE of x̂ over lanes, at step 9."""
    rng = np.random.default_rng([CHAINS.index(chain), 31])
    system = replace(random_system(rng, 2, 1, 1, chain), A=np.array([[0.9, 0.1], [-0.1, 0.8]]))
    system = replace(system, B=np.array([[-1.0], [1.0]]), C=np.array([[0.0, 1.0]]), Q=0.3 * np.eye(2), R=np.eye(1))
    trial = random_trial(rng, system, 9, 200)
    exact = run("oe", trial)[0][-1]
    errors = [np.linalg.norm(run("gpb", trial, {"order": d})[0][-1] - exact, axis=1).mean() for d in range(6)]
    assert all(b < 0.9 * a for a, b in pairwise(errors)), errors


@check(30)
@given(trials(acks=("all",), steps=(1, 10)))
def test_all_acks_in_time_is_kfio(trial: Trial) -> None:
    for order in (0, 1, 3):
        assert_same(run("gpb", trial, {"order": order}), run("kfio", trial), 1e-9)


@pytest.mark.parametrize(("order", "counts"), [(0, [0, 0, 1, 3]), (1, [0, 0, 0, 1]), (2, [0, 0, 0, 1]), (3, [0] * 4)])
def test_acks_of_merged_packets_are_counted(order: int, counts: list[int]) -> None:
    rng = np.random.default_rng(9)
    trial = random_trial(rng, random_system(rng, 2, 1, 1), 4, 1)
    trial.ack_step[:, 0] = [4, 3, 4, 0]
    est = create("gpb", model_of(trial.system), lanes=1, options={"order": order})
    seen = []
    for k in range(1, trial.steps + 1):
        est.step(trial.u[k - 1], trial.y[k - 1], trial.arrived[k - 1], acks_at(trial, k))
        seen.append(est.counters.get("late_acks", 0))
    assert seen == counts


@pytest.mark.parametrize("order", [0, 1, 3])
def test_a_split_of_the_lanes_changes_no_bit(order: int) -> None:
    rng = np.random.default_rng(order)
    trial = random_trial(rng, random_system(rng, 3, 2, 1), 7, 5, "late")
    whole = run("gpb", trial, {"order": order})
    for lane in range(5):
        part = run("gpb", trial.of_lanes(slice(lane, lane + 1)), {"order": order})
        np.testing.assert_array_equal(part[0][:, 0], whole[0][:, lane])
        np.testing.assert_array_equal(part[1][:, 0], whole[1][:, lane])
