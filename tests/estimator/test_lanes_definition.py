"""Lanes are independent: any order and any split of them gives the same bits."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimator.reference.cases import Trial, check, trials
from estimator.reference.drive import acks_at, model_of, run, run_bounds
from testbed.estimator.registry import create

KINDS = ["kfio", "kf", "oe", "aoe", "ff", "lmmse", "gpb", "gpb1", "gpb2", "imm"]
SPLITS = [(1, 2, 4), (4, 3), (1,) * 7]


def _trials(kind: str) -> st.SearchStrategy[Trial]:
    chains = ("bernoulli",) if kind in ("ff", "lmmse") else ("bernoulli", "markov")
    acks = ("all",) if kind in ("kfio", "kf") else ("none", "subset", "late")
    return trials(acks=acks, chains=chains, steps=(3, 6), lanes=(7, 7))


@pytest.mark.parametrize("kind", KINDS)
@check(15)
@given(data=st.data())
def test_a_split_of_the_lanes_changes_no_bit(kind: str, data: st.DataObject) -> None:
    trial = data.draw(_trials(kind))
    whole_x, whole_P = run(kind, trial)
    for split in SPLITS:
        ends = np.cumsum(split)
        parts = [run(kind, trial.of_lanes(slice(end - size, end))) for size, end in zip(split, ends, strict=True)]
        np.testing.assert_array_equal(np.concatenate([x for x, _ in parts], axis=1), whole_x)
        np.testing.assert_array_equal(np.concatenate([P for _, P in parts], axis=1), whole_P)


@pytest.mark.parametrize("kind", KINDS)
@check(15)
@given(data=st.data())
def test_an_order_of_the_lanes_changes_no_bit(kind: str, data: st.DataObject) -> None:
    trial = data.draw(_trials(kind))
    order = np.array(data.draw(st.permutations(range(7))))
    x_hat, P = run(kind, trial)
    moved_x, moved_P = run(kind, trial.of_lanes(order))
    np.testing.assert_array_equal(moved_x, x_hat[:, order])
    np.testing.assert_array_equal(moved_P, P[:, order])


@check(15)
@given(trials(acks=("none",), lanes=(7, 7)), st.permutations(range(7)))
def test_bounds_do_not_mix_lanes(trial: Trial, order: list[int]) -> None:
    U = 2.0 * trial.system.B @ trial.system.B.T
    whole = run_bounds(trial, U)
    single = [run_bounds(trial.of_lanes(slice(lane, lane + 1)), U) for lane in range(7)]
    moved = run_bounds(trial.of_lanes(np.array(order)), U)
    for i in range(2):
        np.testing.assert_array_equal(np.concatenate([bounds[i] for bounds in single], axis=1), whole[i])
        np.testing.assert_array_equal(moved[i], whole[i][:, order])


@pytest.mark.parametrize("kind", KINDS)
@check(10)
@given(data=st.data())
def test_what_is_masked_does_not_matter(kind: str, data: st.DataObject) -> None:
    trial = data.draw(_trials(kind))
    plain, garbage = run(kind, trial), run(kind, trial, garbage=True)
    np.testing.assert_array_equal(plain[0], garbage[0])
    np.testing.assert_array_equal(plain[1], garbage[1])


@pytest.mark.parametrize("kind", KINDS)
@check(5)
@given(data=st.data())
def test_a_step_changes_neither_its_inputs_nor_earlier_outputs(kind: str, data: st.DataObject) -> None:
    trial = data.draw(_trials(kind))
    inputs = [array.copy() for array in (trial.u, trial.y, trial.arrived, trial.nu)]
    est = create(kind, model_of(trial.system), lanes=trial.lanes, options={})
    outs, copies = [], []
    for k in range(1, trial.steps + 1):
        out = est.step(trial.u[k - 1], trial.y[k - 1], trial.arrived[k - 1], acks_at(trial, k))
        outs.append(out)
        copies.append((np.array(out.x_hat), np.array(out.P)))
    for out, (x_hat, P) in zip(outs, copies, strict=True):
        np.testing.assert_array_equal(out.x_hat, x_hat)
        np.testing.assert_array_equal(out.P, P)
    for array, before in zip((trial.u, trial.y, trial.arrived, trial.nu), inputs, strict=True):
        np.testing.assert_array_equal(array, before)
