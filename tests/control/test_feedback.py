"""State feedback, limits, and what a controller hands over."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from control.making import answers, closed, made
from testbed.control.limits import Limits
from testbed.control.lqg import Weights, horizon_gains, stationary_gain
from testbed.errors import UsageError
from testbed.estimator.registry import model_of

GAIN = [[0.6, 0.3], [-0.1, 0.5]]
WEIGHTS = {"Qx": [[2.0, 0.1], [0.1, 1.0]], "Ru": [[1.0, 0.0], [0.0, 0.5]]}
STATES = np.random.default_rng(2).normal(size=(10, 4, 2))


def test_feedback_holds_a_reference() -> None:
    source = {"kind": "feedback", "gain": GAIN, "reference": [1.0, -2.0], "feedforward": [0.5, 0.0]}
    expected = np.array([0.5, 0.0]) - (STATES - np.array([1.0, -2.0])) @ np.array(GAIN).T
    np.testing.assert_allclose(answers(made(source, 4), STATES), expected, atol=1e-14)


def test_each_step_of_a_finite_horizon_has_its_gain() -> None:
    source = {"kind": "lqg", **WEIGHTS, "horizon": "run", "terminal": [[9.0, 0.0], [0.0, 9.0]]}
    links = {"control": {"loss": {"kind": "bernoulli", "arrival": 0.6}}}
    weights = Weights(np.array(WEIGHTS["Qx"]), np.array(WEIGHTS["Ru"]), 9.0 * np.eye(2))
    gains = horizon_gains(model_of(closed(source, links=links)), weights, 10)[::-1]
    found = answers(made(source, 4, links=links), STATES)
    for k in range(10):
        np.testing.assert_allclose(found[k], -STATES[k] @ gains[k].T, atol=1e-13)
    assert np.abs(gains[9] - gains[0]).max() > 0.01


def test_a_stationary_one_has_one_gain() -> None:
    source = {"kind": "lqg", **WEIGHTS}
    weights = Weights(np.array(WEIGHTS["Qx"]), np.array(WEIGHTS["Ru"]), np.eye(2))
    gain = stationary_gain(model_of(closed(source)), weights)
    np.testing.assert_allclose(answers(made(source, 4), STATES), -STATES @ gain.T, atol=1e-13)


SOURCES: dict[str, dict[str, Any]] = {
    "feedback": {"kind": "feedback", "gain": GAIN, "reference": [1.0, -2.0]},
    "lqg": {"kind": "lqg", **WEIGHTS, "horizon": "run"},
    "pid": {"kind": "pid", "kp": 1.0, "ki": 0.2, "kd": 0.1, "filter": 1.0, "high": 0.4},
}


@pytest.mark.parametrize("name", SOURCES)
def test_a_lane_has_the_same_bits_alone(name: str) -> None:
    whole = answers(made(SOURCES[name], 4), STATES)
    for lane in range(4):
        alone = answers(made(SOURCES[name]), STATES[:, lane : lane + 1])
        np.testing.assert_array_equal(alone, whole[:, lane : lane + 1])


@pytest.mark.parametrize("name", SOURCES)
def test_a_state_that_does_not_fit_is_refused_and_changes_nothing(name: str) -> None:
    controller = made(SOURCES[name], 4)
    answers(controller, STATES[:3])
    before = controller.state()
    for wrong in ({}, {**before, "more": np.zeros(4)}, {**before, "k": np.array(-1)}):
        with pytest.raises(UsageError) as refusal:
            controller.set_state(wrong)
        assert len(str(refusal.value).splitlines()) == 1
    after = controller.state()
    assert before.keys() == after.keys()
    for key, value in before.items():
        np.testing.assert_array_equal(after[key], value)


@pytest.mark.parametrize(
    ("low", "high", "expected", "saturated"),
    [
        (None, None, [[-3.0, 5.0], [0.5, 0.5], [0.0, 2.0]], 0),
        (-1.0, None, [[-1.0, 5.0], [0.5, 0.5], [0.0, 2.0]], 1),
        ((-4.0, -4.0), (1.0, 1.5), [[-3.0, 1.5], [0.5, 0.5], [0.0, 1.5]], 2),
        (None, 0.0, [[-3.0, 0.0], [0.0, 0.0], [0.0, 0.0]], 3),
    ],
)
def test_limits_cut_and_count_lanes(low: Any, high: Any, expected: list[list[float]], saturated: int) -> None:
    u = np.array([[-3.0, 5.0], [0.5, 0.5], [0.0, 2.0]])
    found, count = Limits(low, high, 2).held(u)
    np.testing.assert_array_equal(found, expected)
    assert count == saturated
