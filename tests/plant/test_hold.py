"""An actuator that holds its last input: the plant is that of zero on loss, given the applied input outright."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from plant.test_dynamics import SYSTEMS
from testbed.errors import UsageError
from testbed.plant.dynamics import Plant
from testbed.plant.inputs import control_bound, open_loop
from testbed.scenario import Scenario, parse_scenario

Floats = NDArray[np.float64]
STEPS = 12
UNCERTAINTY = {"dA": [[[0.3, 0.0], [0.2, 0.4]]], "delta": 1.0}


def scenario(name: str, on_loss: str = "hold", **rest: Any) -> Scenario:
    return parse_scenario({"system": SYSTEMS[name], "actuator": {"on_loss": on_loss}, "steps": STEPS, **rest})


def path(given: Scenario, u: Floats, applied: NDArray[np.bool_]) -> Floats:
    """x and y of each step, (T, M, n + p); u (T, M, q), applied (T, M)."""
    lanes = u.shape[1]
    plant, out = Plant(given, 3, lanes), []
    for sent, mask in zip(u, applied, strict=True):
        given_u = sent if mask.any() else None  # nothing is delivered with a packet that is lost in every lane
        out.append(np.hstack(plant.move(given_u, bool(mask[0]) if lanes == 1 else mask)))
    return np.array(out)


def newest(u: Floats, applied: NDArray[np.bool_]) -> Floats:
    """The input of the newest packet that arrived, zero before the first."""
    out = np.zeros_like(u)
    for k in range(len(u)):
        for lane in range(u.shape[1]):
            came = np.flatnonzero(applied[: k + 1, lane])
            if len(came):
                out[k, lane] = u[came[-1], lane]
    return out


@pytest.mark.parametrize("lanes", [1, 5, 1100])
@pytest.mark.parametrize(
    ("name", "extra"),
    [("scalar", {}), ("two states", {}), ("noise through G", {}), ("two states", {"uncertainty": UNCERTAINTY})],
)
def test_it_moves_by_the_newest_input_that_arrived(name: str, extra: dict[str, Any], lanes: int) -> None:
    held, zero = scenario(name, **extra), scenario(name, "zero", **extra)
    rng = np.random.default_rng(lanes)
    u, applied = rng.normal(size=(STEPS, lanes, held.system.q)), rng.random((STEPS, lanes)) < 0.4
    applied[[0, 4]] = False
    everything = np.ones_like(applied)
    np.testing.assert_array_equal(path(held, u, applied), path(zero, newest(u, applied), everything))
    np.testing.assert_array_equal(path(held, u, everything), path(zero, u, everything))
    assert not np.array_equal(path(held, u, applied), path(zero, u, applied))


def test_before_the_first_arrival_it_applies_zero() -> None:
    u, none = np.ones((STEPS, 2, 1)), np.zeros((STEPS, 2), dtype=np.bool_)
    np.testing.assert_array_equal(
        path(scenario("two states"), u, none), path(scenario("two states", "zero"), 0.0 * u, none)
    )


def test_without_an_input_there_is_nothing_to_hold() -> None:
    system = {key: value for key, value in SYSTEMS["two states"].items() if key != "B"}
    with pytest.raises(UsageError, match=r"actuator\.on_loss: got 'hold', but system\.B is not given; allowed: zero"):
        parse_scenario({"system": system, "actuator": {"on_loss": "hold"}})


@pytest.mark.parametrize(
    "source",
    [
        {"kind": "constant", "value": [3.0, -1.0]},
        {"kind": "sine", "offset": [2.0, 0.0], "amplitude": 1.5, "period": 5.0},
        {"kind": "uniform", "low": [-1.0, 1.0], "high": [2.0, 4.0]},
        {"kind": "exponential", "offset": -1.0, "amplitude": 4.0, "tau": 3.0},
    ],
)
def test_the_bound_covers_the_variance_of_every_law_of_what_is_applied(source: dict[str, Any]) -> None:
    given = scenario("noise through G", input=source)
    U, B, rng = control_bound(given), np.array(given.system.B), np.random.default_rng(1)
    assert U is not None
    draw = open_loop(given, 0, 4)
    inputs = np.array([draw(k) for k in range(STEPS)])
    for lane in range(4):
        values = np.vstack([np.zeros(2), inputs[:, lane]])
        laws = [*rng.dirichlet(np.full(len(values), 0.2), size=50), *np.eye(len(values))]
        laws += [0.5 * (one + other) for one in np.eye(len(values)) for other in np.eye(len(values))]
        for weights in laws:
            away = (values - weights @ values) @ B.T
            variance = (away * weights[:, None]).T @ away
            assert np.linalg.eigvalsh(0.25 * U - variance).min() >= -1e-12 * np.abs(U).max()


def test_for_one_channel_the_bound_of_the_variance_is_reached() -> None:
    given = scenario("two states", input={"kind": "table", "values": [[2.0], [-1.0], *[[1.0]] * (STEPS - 2)]})
    B = np.array(given.system.B)
    np.testing.assert_allclose(control_bound(given), 9.0 * B @ B.T)
