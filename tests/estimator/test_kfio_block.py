"""A block filtered in one call gives the numbers of the estimator that takes step after step."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimator.reference.cases import Trial, check, random_system, random_trial, trials
from estimator.reference.drive import model_of, run
from testbed.errors import UsageError
from testbed.estimator.errors import MissingAck
from testbed.estimator.kfio_block import Block, filter_block
from testbed.estimator.model import Model
from testbed.numerics.kernels import SWITCH


def filtered(trial: Trial, model: Model | None = None, **options: Any) -> Block:
    """NaN stands where nothing arrived."""
    y = np.where(trial.arrived[:, :, None], trial.y, np.nan).transpose(0, 2, 1)
    return filter_block(
        model or model_of(trial.system), y, trial.arrived, trial.u.transpose(0, 2, 1), trial.nu, **options
    )


def assert_steps(block: Block, trial: Trial) -> None:
    x_hat, P = run("kfio", trial)
    np.testing.assert_allclose(block.x_hat.transpose(0, 2, 1), x_hat, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(block.P.transpose(0, 3, 1, 2), P, rtol=1e-12, atol=1e-12)


def part(trial: Trial, begin: int, end: int) -> Trial:
    cut = slice(begin, end)
    return replace(trial, u=trial.u[cut], y=trial.y[cut], arrived=trial.arrived[cut], nu=trial.nu[cut])


@check(40)
@given(trials(acks=("all",), steps=(1, 12)))
def test_is_kfio(trial: Trial) -> None:
    assert_steps(filtered(trial), trial)


@pytest.mark.parametrize(("steps", "lanes"), [(40, 1300), (250, 200)])
def test_is_kfio_where_it_is_compiled(steps: int, lanes: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(steps)
    system = random_system(rng, 2, 2, 1)
    system = replace(system, A=system.A / np.abs(np.linalg.eigvals(system.A)).max())
    trial = random_trial(rng, system, steps, lanes, acks="all")
    compiled = filtered(trial)
    assert_steps(compiled, trial)
    monkeypatch.setenv(SWITCH, "off")
    plain = filtered(trial)
    np.testing.assert_array_equal(compiled.x_hat, plain.x_hat)
    np.testing.assert_array_equal(compiled.P_upper, plain.P_upper)


@check(20)
@given(trials(acks=("all",), steps=(2, 8)), st.data())
def test_goes_on_from_an_earlier_block(trial: Trial, data: st.DataObject) -> None:
    cut = data.draw(st.integers(1, trial.steps - 1))
    model, whole = model_of(trial.system), filtered(trial)
    first = filtered(part(trial, 0, cut), model)
    second = filtered(part(trial, cut, trial.steps), model, after=first)
    np.testing.assert_array_equal(np.concatenate([first.x_hat, second.x_hat]), whole.x_hat)
    np.testing.assert_array_equal(np.concatenate([first.P_upper, second.P_upper]), whole.P_upper)


def test_writes_where_it_is_told_even_over_the_block_it_goes_on_from() -> None:
    rng = np.random.default_rng(1)
    trial = random_trial(rng, random_system(rng, 2, 1, 1), 6, 3, acks="all")
    whole = filtered(trial)
    room = filtered(part(trial, 0, 3))
    assert filtered(part(trial, 3, 6), after=room, out=room) is room
    np.testing.assert_array_equal(room.x_hat, whole.x_hat[3:])
    np.testing.assert_array_equal(room.P_upper, whole.P_upper[3:])


def test_needs_no_control_without_b_and_no_nu_where_nothing_gets_lost() -> None:
    rng = np.random.default_rng(2)
    system = replace(random_system(rng, 2, 1, 1), recovery=1.0, failure=0.0, start=1.0)
    trial = random_trial(rng, system, 6, 3, acks="all")
    u, y = trial.u.transpose(0, 2, 1), trial.y.transpose(0, 2, 1)
    assert_steps(filter_block(model_of(system), y, trial.arrived, u), trial)
    idle = replace(trial, system=replace(system, B=np.zeros((2, 1))))
    assert_steps(filter_block(replace(model_of(system), B=None), y, trial.arrived), idle)


def test_says_what_does_not_fit() -> None:
    rng = np.random.default_rng(3)
    system = random_system(rng, 2, 1, 1)
    trial, model = random_trial(rng, system, 4, 3, acks="all"), model_of(system)
    u, y, arrived, nu = trial.u.transpose(0, 2, 1), trial.y.transpose(0, 2, 1), trial.arrived, trial.nu
    with pytest.raises(MissingAck, match="nu"):
        filter_block(model, y, arrived, u)
    for arguments, message in (
        ((trial.y, arrived, u, nu), r"y: got the shape \(4, 3, 1\); allowed: \(4, 1, 3\)"),
        ((y, arrived[0], u, nu), "arrived: got the shape"),
        ((y[:0], arrived[:0], u[:0], nu[:0]), "one step"),
        ((y, arrived, None, nu), "u: got none"),
        ((y, arrived, u, nu[:2]), "nu: got the shape"),
    ):
        with pytest.raises(UsageError, match=message):
            filter_block(model, *arguments)
    with pytest.raises(UsageError, match=r"out\.x_hat: got float64 \(4, 2, 2\)"):
        filter_block(model, y, arrived, u, nu, out=Block.empty(model, 4, 2))
    with pytest.raises(UsageError, match="after: got states and lanes"):
        filter_block(model, y, arrived, u, nu, after=Block.empty(model, 4, 2))
