"""The plant with model error against its definition."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from plant.test_dynamics import SYSTEMS
from testbed.plant.dynamics import Plant
from testbed.scenario import Scenario, parse_scenario

Floats = NDArray[np.float64]
LANES = 40_000
SYSTEM = {
    "A": [[0.9, 0.1], [-0.1, 0.8]],
    "C": [[0.0, 1.0], [1.0, 1.0]],
    "G": [[1.0], [0.5]],
    "Q": [[2.0]],
    "R": [[1.0, -0.5], [-0.5, 1.5]],
    "x0_mean": [1.0, -2.0],
    "P0": [[0.0, 0.0], [0.0, 0.0]],
}
D_A = [[[0.3, 0.0], [0.2, 0.4]], [[0.0, 0.5], [0.0, 0.0]]]
D_G = [[[0.5], [0.0]], [[0.0], [1.0]]]
D_C = [[[0.4, 0.0], [0.0, 0.0]], [[0.0, 0.0], [0.3, -0.3]]]
DELTA = 1.5


def scenario(system: dict[str, Any] = SYSTEM, **uncertainty: Any) -> Scenario:
    return parse_scenario({"system": system, **({"uncertainty": uncertainty} if uncertainty else {})})


def path(given: Scenario, lane: int, lanes: int, steps: int = 3) -> list[Floats]:
    plant = Plant(given, lane, lanes)
    u = np.ones((lanes, given.system.q))
    mask: Any = True if lanes == 1 else np.ones(lanes, dtype=np.bool_)
    return [np.hstack([*plant.move(u, mask), plant.noise]) for _ in range(steps)]


def assert_moments(sample: Floats, mean: Floats, covariance: Floats) -> None:
    """Within five standard errors as the sample has them; the laws here are not Gaussian."""
    count, away = len(sample), sample - mean
    assert (np.abs(away.mean(axis=0)) <= 5.0 * sample.std(axis=0) / np.sqrt(count)).all()
    products = away[:, :, None] * away[:, None, :]
    assert (np.abs(products.mean(axis=0) - covariance) <= 5.0 * products.std(axis=0) / np.sqrt(count)).all()


def test_the_first_two_states_have_the_moments_of_the_definition() -> None:
    """From a sure x_0: Cov x_1 = Σ_k v (dA_k x̄)(·)' + G W G' + Σ_k v dG_k W dG_k', v = δ²/3, and one step more."""
    given = scenario(dA=D_A, dG=D_G, dC=D_C, delta=DELTA)
    first, second, _ = path(given, 0, LANES)
    A, G, W, C, R = (np.array(SYSTEM[key]) for key in ("A", "G", "Q", "C", "R"))
    mean, moment = np.array(SYSTEM["x0_mean"]), np.outer(SYSTEM["x0_mean"], SYSTEM["x0_mean"])
    v = DELTA**2 / 3.0
    for found in (first, second):
        noise = G @ W @ G.T + sum(v * np.array(d) @ W @ np.array(d).T for d in D_G)
        moment = A @ moment @ A.T + sum(v * np.array(d) @ moment @ np.array(d).T for d in D_A) + noise
        mean = A @ mean
        seen = C @ moment @ C.T + sum(v * np.array(d) @ moment @ np.array(d).T for d in D_C) + R
        assert_moments(found[:, :2], mean, moment - np.outer(mean, mean))
        assert_moments(found[:, 2:4], C @ mean, seen - np.outer(C @ mean, C @ mean))
        assert_moments(found[:, 4:], np.zeros(2), R)


def test_the_parameter_is_uniform_and_that_of_one_step_moves_a_and_c() -> None:
    """Without noise x_1 = 1 + ε_0, x_2 = (1 + ε_1) x_1, y_1 = (1 + ε_1) x_1: the ε of C at k is that of A at k."""
    system = {"A": [[1.0]], "C": [[1.0]], "Q": [[0.0]], "R": [[1e-18]], "x0_mean": [1.0], "P0": [[0.0]]}
    first, second, _ = path(scenario(system, dA=[[[1.0]]], dC=[[[1.0]]], delta=0.5), 0, LANES)
    epsilon = first[:, 0] - 1.0
    assert np.abs(epsilon).max() <= 0.5
    counts, _ = np.histogram(epsilon, bins=10, range=(-0.5, 0.5))
    assert (np.abs(counts - LANES / 10) < 5.0 * np.sqrt(LANES * 0.09)).all()
    np.testing.assert_allclose(first[:, 1], second[:, 0], atol=1e-7)
    assert abs(np.corrcoef(epsilon, second[:, 0] / first[:, 0])[0, 1]) < 5.0 / np.sqrt(LANES)


@pytest.mark.parametrize("name", SYSTEMS)
def test_no_error_is_the_plant_of_the_model_to_the_bit(name: str) -> None:
    n = len(SYSTEMS[name]["A"])
    none = scenario(SYSTEMS[name], dA=[np.eye(n).tolist()], delta=0.0)
    for one, other in zip(path(none, 0, 5), path(scenario(SYSTEMS[name]), 0, 5), strict=True):
        np.testing.assert_array_equal(one, other)


def test_derivatives_of_zero_change_no_bit() -> None:
    zero = scenario(dA=np.zeros((1, 2, 2)).tolist(), dG=np.zeros((1, 2, 1)).tolist(), delta=3.0)
    for one, other in zip(path(zero, 0, 5), path(scenario(), 0, 5), strict=True):
        np.testing.assert_array_equal(one, other)


def test_no_split_of_the_lanes_changes_a_bit() -> None:
    given = scenario(dA=D_A, dG=D_G, dC=D_C, delta=DELTA)
    whole = path(given, 0, 7, steps=20)
    for lane, lanes in ((0, 1), (1, 2), (3, 4), (6, 1)):
        for part, all_of_them in zip(path(given, lane, lanes, steps=20), whole, strict=True):
            np.testing.assert_array_equal(part, all_of_them[lane : lane + lanes])


def test_the_noise_is_what_the_observation_has_beyond_c_x() -> None:
    for found in path(scenario(dA=D_A, delta=DELTA), 0, 50):
        np.testing.assert_allclose(found[:, 2:4] - found[:, :2] @ np.array(SYSTEM["C"]).T, found[:, 4:], atol=1e-12)
