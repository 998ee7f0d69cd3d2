"""PID controllers against the difference equations written out, step responses, and what anti-windup is for."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from control.making import answers, made

ONE: dict[str, Any] = {
    "system": {"A": [[0.8]], "B": [[0.5]], "C": [[1.0]], "Q": [[1.0]], "R": [[1.0]]},
}
"""One state, which is the output."""


def responses(source: dict[str, Any], outputs: list[float]) -> list[float]:
    """u for these outputs z_0, z_1, …"""
    u = answers(made({"kind": "pid", **source}, **ONE), np.array(outputs)[:, None, None])
    return [float(v) for v in u[:, 0, 0]]


def test_a_step_of_the_error_gives_a_jump_and_a_ramp() -> None:
    """P + I for e = 1: u_k = kp + ki k."""
    found = responses({"kp": 2.0, "ki": 0.5, "setpoint": 1.0}, [0.0] * 8)
    np.testing.assert_allclose(found, [2.0 + 0.5 * k for k in range(8)], rtol=1e-15)


def test_a_new_set_point_gives_the_derivative_no_kick() -> None:
    assert responses({"kd": 5.0, "setpoint": 9.0}, [0.0] * 4) == [0.0] * 4


@pytest.mark.parametrize("T", [0.0, 1.0, 4.0])
def test_the_filtered_derivative_of_a_ramp(T: float) -> None:
    """z = k: D_k = −kd (1 − (T/(T+1))^k), and −kd at once without a filter."""
    found = responses({"kd": 3.0, "filter": T}, [float(k) for k in range(9)])
    np.testing.assert_allclose(found, [-3.0 * (1.0 - (T / (T + 1.0)) ** k) for k in range(9)], atol=1e-14)


def test_proportional_control_of_an_integrator() -> None:
    """z⁺ = z + u, u = kp (r − z): z_k = r (1 − (1 − kp)^k)."""
    controller, z = made({"kind": "pid", "kp": 0.4, "setpoint": 2.0}, **ONE), 0.0
    for k in range(12):
        np.testing.assert_allclose(z, 2.0 * (1.0 - 0.6**k), atol=1e-14)
        z += float(controller.step(k, np.array([[z]]), np.eye(1)[None])[0, 0])


def test_integral_control_removes_the_error_as_its_poles_say() -> None:
    """z⁺ = a z + b (u + d): (z, I) moves by a matrix; its powers give the response, its fixed point has z = r."""
    a, b, kp, ki, r, disturbance = 0.8, 0.5, 0.6, 0.2, 1.5, 3.0
    moves = np.array([[a - b * kp, b], [-ki, 1.0]])
    drive = np.array([b * (kp * r + disturbance), ki * r])
    fixed = np.linalg.solve(np.eye(2) - moves, drive)
    assert fixed[0] == pytest.approx(r)
    controller, z = made({"kind": "pid", "kp": kp, "ki": ki, "setpoint": r}, **ONE), 0.0
    for k in range(40):
        expected = fixed + np.linalg.matrix_power(moves, k) @ -fixed
        np.testing.assert_allclose(z, expected[0], atol=1e-12)
        z = a * z + b * (float(controller.step(k, np.array([[z]]), np.eye(1)[None])[0, 0]) + disturbance)


numbers = st.floats(-3.0, 3.0)


@settings(deadline=None, max_examples=40)
@given(data=st.data(), lanes=st.integers(1, 3))
def test_the_difference_equations(data: st.DataObject, lanes: int) -> None:
    """Two channels, every key, limits and both kinds of anti-windup, written out with arrays."""

    def pair(low: float = -3.0, high: float = 3.0) -> list[float]:
        return data.draw(st.lists(st.floats(low, high), min_size=2, max_size=2))

    keys = {name: pair() for name in ("setpoint", "kp", "ki", "kd", "feedforward")}
    keys |= {"filter": pair(0.0), "low": pair(-4.0, -1.0), "high": pair(1.0, 4.0)}
    H = [pair(), pair()]
    tracking = data.draw(st.none() | st.floats(1.0, 9.0))
    source = {"kind": "pid", "output": H, **keys, **({} if tracking is None else {"tracking": tracking})}
    states = np.random.default_rng(data.draw(st.integers(0, 99))).normal(size=(7, lanes, 2))
    found = answers(made(source, lanes), states)
    own = {name: np.array(value) for name, value in keys.items()}
    integral = derivative = np.zeros((lanes, 2))
    before = states[0] @ np.array(H).T
    for k, x in enumerate(states):
        z = x @ np.array(H).T
        e = own["setpoint"] - z
        derivative = (own["filter"] * derivative - own["kd"] * (z - before)) / (own["filter"] + 1.0)
        v = own["feedforward"] + own["kp"] * e + integral + derivative
        np.testing.assert_allclose(found[k], v, atol=1e-11)
        u = np.clip(v, own["low"], own["high"])
        more = own["ki"] * e
        if tracking is not None:
            integral = integral + more + (u - v) / tracking
        else:
            integral = integral + np.where((v - u) * more > 1e-13, 0.0, more)
        before = z


def leaves_after(source: dict[str, Any]) -> int:
    """Steps for which the input stays at its limit after the error has turned, 30 steps of saturation before."""
    limits = {"high": 1.0, "low": -1.0, "setpoint": 0.0, "kp": 0.2, "ki": 0.1}
    found = responses({**limits, **source}, [-2.0] * 30 + [1.0] * 200)
    return int(np.argmax(np.array(found[30:]) < 1.0))


def test_anti_windup_lets_the_input_leave_its_limit_at_once() -> None:
    """Without limits known to the controller the integral has grown by 30 · 0.2 = 6 and takes 48 steps to come back."""
    assert leaves_after({}) == 0
    assert leaves_after({"tracking": 1.0}) == 0
    assert leaves_after({"high": 1e9}) == 49


def test_back_calculation_settles_where_it_balances() -> None:
    """A constant error e at the limit: v − u tends to tracking · ki e."""
    found = responses({"ki": 0.3, "kp": 1.0, "high": 1.0, "tracking": 4.0, "setpoint": 5.0}, [0.0] * 200)
    assert found[-1] - 1.0 == pytest.approx(4.0 * 0.3 * 5.0)


@pytest.mark.parametrize("lanes", [1, 3])
def test_the_state_is_all_that_goes_on(lanes: int) -> None:
    source = {"kind": "pid", "kp": 1.0, "ki": [0.2, 0.1], "kd": 0.5, "filter": 2.0, "low": -1.0, "high": 1.0}
    states = np.random.default_rng(1).normal(size=(9, lanes, 2))
    whole = answers(made(source, lanes), states)
    first, second = made(source, lanes), made(source, lanes)
    answers(first, states[:4])
    state = first.state()
    assert int(state["k"]) == 4
    second.set_state(state)
    answers(first, states[4:])
    np.testing.assert_array_equal(answers(second, states[4:], first=4), whole[4:])
