"""Inputs against their formulas, and the bound U ≥ B u u' B' by eigenvalues."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from testbed.plant.inputs import control_bound, open_loop
from testbed.scenario import Scenario, parse_scenario

STEPS = 30
check = settings(deadline=None, max_examples=40)


def scenario(source: dict[str, Any] | None, q: int = 2, n: int = 3, steps: int = STEPS, **rest: Any) -> Scenario:
    rng = np.random.default_rng(n + q)
    system: dict[str, Any] = {"A": np.eye(n).tolist(), "C": np.ones((1, n)).tolist(), "R": [[1.0]]}
    system["Q"] = np.eye(n).tolist()
    if q:
        system["B"] = rng.normal(size=(n, q)).tolist()
    tables: dict[str, Any] = {"steps": steps, "system": system, **rest}
    return parse_scenario(tables if source is None else {**tables, "input": source})


FORMULAS: dict[str, tuple[dict[str, Any], Any]] = {
    "constant": ({"kind": "constant", "value": [1.5, -2.0]}, lambda k: [1.5, -2.0]),
    "exponential": (
        {"kind": "exponential", "offset": 1.0, "amplitude": [2.0, -1.0], "tau": [10.0, 3.0]},
        lambda k: [1.0 + 2.0 * math.exp(-k / 10.0), 1.0 - math.exp(-k / 3.0)],
    ),
    "exponential of the papers": (
        {"kind": "exponential", "offset": 1.0, "amplitude": 1.0, "tau": 10.0},
        lambda k: [1.0 + math.exp(-k / 10.0)] * 2,
    ),
    "exponential without offset": ({"kind": "exponential", "tau": 2.0}, lambda k: [math.exp(-k / 2.0)] * 2),
    "sine": (
        {"kind": "sine", "offset": [0.5, 0.0], "amplitude": 3.0, "period": [8.0, 5.0], "phase": [0.0, 1.0]},
        lambda k: [0.5 + 3.0 * math.sin(2 * math.pi * k / 8.0), 3.0 * math.sin(2 * math.pi * k / 5.0 + 1.0)],
    ),
    "sine of a period": ({"kind": "sine", "period": 4.0}, lambda k: [(0.0, 1.0, 0.0, -1.0)[k % 4]] * 2),
    "table": (
        {"kind": "table", "values": [[float(k), -float(k * k)] for k in range(STEPS)]},
        lambda k: [float(k), -float(k * k)],
    ),
    "none": (None, lambda k: [0.0, 0.0]),  # type: ignore[dict-item]
}


@pytest.mark.parametrize("name", FORMULAS)
@pytest.mark.parametrize("lanes", [1, 4])
def test_inputs_follow_their_formulas_in_every_lane(name: str, lanes: int) -> None:
    table, formula = FORMULAS[name]
    source = open_loop(scenario(table), 5, lanes)
    for k in range(STEPS):
        u = source(k)
        assert u.shape == (lanes, 2)
        np.testing.assert_allclose(u, np.tile(formula(k), (lanes, 1)), rtol=1e-13, atol=1e-13)


def test_a_system_without_input_has_none() -> None:
    assert open_loop(scenario(None, q=0), 0, 3)(7).shape == (3, 0)


def test_a_uniform_input_is_uniform_in_each_channel() -> None:
    given_scenario = scenario({"kind": "uniform", "low": [-1.0, 5.0], "high": [3.0, 5.5]})
    sample = np.array([open_loop(given_scenario, 0, 2000)(k) for k in range(10)])
    for channel, (low, high) in enumerate([(-1.0, 3.0), (5.0, 5.5)]):
        values = sample[:, :, channel].ravel()
        assert values.min() >= low
        assert values.max() <= high
        assert stats.kstest(values, stats.uniform(low, high - low).cdf).pvalue > 1e-3
    assert abs(np.corrcoef(sample[:, :, 0].ravel(), sample[:, :, 1].ravel())[0, 1]) < 4.0 / math.sqrt(20_000)
    part = open_loop(given_scenario, 700, 3)
    np.testing.assert_array_equal(part(9), sample[9, 700:703])


def test_feedback_has_no_open_loop_and_no_bound() -> None:
    tables = {"kind": "feedback", "gain": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]}
    closed = scenario(tables, estimators=[{"name": "aoe"}])
    assert control_bound(closed) is None
    with pytest.raises(TypeError):
        open_loop(closed, 0, 1)


amounts = st.floats(-100.0, 100.0)
periods = st.floats(0.5, 50.0)


@st.composite
def inputs(draw: st.DrawFn, q: int) -> dict[str, Any]:
    def channels(value: st.SearchStrategy[float]) -> Any:
        return draw(st.one_of(value, st.lists(value, min_size=q, max_size=q)))

    kind = draw(st.sampled_from(["constant", "exponential", "sine", "uniform", "table"]))
    if kind == "constant":
        return {"kind": kind, "value": draw(st.lists(amounts, min_size=q, max_size=q))}
    if kind == "exponential":
        own = {"offset": channels(amounts), "amplitude": channels(amounts), "tau": channels(periods)}
        return {"kind": kind, **own}
    if kind == "sine":
        own = {"offset": channels(amounts), "amplitude": channels(amounts), "phase": channels(amounts)}
        return {"kind": kind, "period": channels(periods), **own}
    if kind == "uniform":
        low, width = draw(amounts), draw(st.floats(0.0, 50.0))
        return {"kind": kind, "low": low, "high": low + width}
    rows = st.lists(amounts, min_size=q, max_size=q)
    return {"kind": kind, "values": draw(st.lists(rows, min_size=12, max_size=15))}


@check
@given(data=st.data(), q=st.integers(1, 3), n=st.integers(1, 3))
def test_the_bound_dominates_every_control(data: st.DataObject, q: int, n: int) -> None:
    made = scenario(data.draw(inputs(q)), q=q, n=n, steps=12)
    U, B = control_bound(made), np.array(made.system.B)
    assert U is not None
    assert U.shape == (n, n)
    source = open_loop(made, 0, 5)
    for k in range(12):
        for u in source(k):
            push = B @ u
            margin = np.linalg.eigvalsh(U - np.outer(push, push))
            assert margin.min() >= -1e-12 * max(1e-300, np.linalg.norm(U), push @ push)


@check
@given(data=st.data(), n=st.integers(1, 3))
def test_for_one_channel_the_bound_is_reached(data: st.DataObject, n: int) -> None:
    made = scenario(data.draw(inputs(1).filter(lambda i: i["kind"] != "uniform")), q=1, n=n, steps=12)
    U, B, source = control_bound(made), np.array(made.system.B), open_loop(made, 0, 1)
    largest = max(np.trace(np.outer(B @ u, B @ u)) for u in (source(k)[0] for k in range(12)))
    assert U is not None
    np.testing.assert_allclose(np.trace(U), largest, rtol=1e-12, atol=1e-300)


def test_the_bound_of_a_uniform_input_is_that_of_its_corners() -> None:
    made = scenario({"kind": "uniform", "low": -3.0, "high": 1.0}, q=1, n=2)
    B = np.array(made.system.B)
    np.testing.assert_allclose(control_bound(made), 9.0 * B @ B.T, rtol=1e-14)


def test_the_bound_without_input_is_zero() -> None:
    np.testing.assert_array_equal(control_bound(scenario(None, q=0)), np.zeros((3, 3)))
    np.testing.assert_array_equal(control_bound(scenario(None)), np.zeros((3, 3)))
