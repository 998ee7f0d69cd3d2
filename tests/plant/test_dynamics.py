"""The plant against its definition, by the moments of many lanes, and its response to what is applied."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from testbed.plant.dynamics import Plant, bits, root
from testbed.scenario import Scenario, parse_scenario

Floats = NDArray[np.float64]
LANES = 20_000

SYSTEMS: dict[str, dict[str, Any]] = {
    "scalar": {"A": [[1.2]], "B": [[2.0]], "C": [[0.5]], "Q": [[3.0]], "R": [[2.0]], "x0_mean": [4.0], "P0": [[0.5]]},
    "two states": {
        "A": [[0.9, 0.1], [-0.1, 0.8]],
        "B": [[-1.0], [1.0]],
        "C": [[0.0, 1.0], [1.0, 1.0]],
        "Q": [[1.0, 0.3], [0.3, 2.0]],
        "R": [[1.0, -0.5], [-0.5, 1.5]],
        "x0_mean": [1.0, -2.0],
        "P0": [[2.0, 1.0], [1.0, 1.0]],
    },
    "noise through G": {
        "A": [[1.0, 1.0, 0.0], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]],
        "B": [[0.0, 1.0], [1.0, 0.0], [2.0, 1.0]],
        "C": [[1.0, 0.0, 0.0]],
        "G": [[0.5], [1.0], [-1.0]],
        "Q": [[4.0]],
        "R": [[0.1]],
    },
    "singular": {
        "A": [[0.5, 0.2], [0.0, 0.9]],
        "B": [[1.0], [0.0]],
        "C": [[1.0, 2.0]],
        "Q": [[1.0, 1.0], [1.0, 1.0]],
        "R": [[1.0]],
        "P0": [[0.0, 0.0], [0.0, 1.0]],
    },
}


def scenario(name: str, **rest: Any) -> Scenario:
    return parse_scenario({"system": SYSTEMS[name], **rest})


class Definition:
    """The matrices of a scenario, as in theory.md section 1."""

    def __init__(self, given: Scenario) -> None:
        s = given.system
        self.A, self.B, self.C, self.R = (np.array(m) for m in (s.A, s.B, s.C, s.R))
        G = np.eye(s.n) if s.G is None else np.array(s.G)
        self.Q = G @ np.array(s.Q) @ G.T
        self.mean, self.P0 = np.array(s.x0_mean), np.array(s.P0)


def assert_law(sample: Floats, mean: Floats, covariance: Floats) -> None:
    """Mean and covariance of a Gaussian sample (M, d), each entry within five standard errors."""
    count = len(sample)
    error = np.sqrt(np.diag(covariance) / count)
    assert (np.abs(sample.mean(axis=0) - mean) <= 5.0 * error + 1e-9).all()
    variances = np.diag(covariance)
    error = np.sqrt((np.outer(variances, variances) + covariance**2) / count)
    away = sample - mean
    assert (np.abs(away.T @ away / count - covariance) <= 5.0 * error + 1e-9).all()


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("seed", [1, 2])
def test_states_and_observations_have_the_moments_of_the_definition(name: str, seed: int) -> None:
    """x_1, x_2, y_1, y_2 together: every variance and every correlation, with B u only where it is applied."""
    given = scenario(name, seed=seed)
    d = Definition(given)
    n, q, p = given.system.n, given.system.q, given.system.p
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(2, 1, q)) * 5.0
    applied = rng.random((2, LANES)) < 0.7
    plant = Plant(given, 0, LANES)
    (x1, y1), (x2, y2) = (plant.move(np.tile(u[k], (LANES, 1)), applied[k]) for k in range(2))

    first = d.A @ d.P0 @ d.A.T + d.Q
    states = np.block([[first, first @ d.A.T], [d.A @ first, d.A @ first @ d.A.T + d.Q]])
    look = np.kron(np.eye(2), d.C)
    noise = np.kron(np.eye(2), d.R)
    covariance = np.block([[states, states @ look.T], [look @ states, look @ states @ look.T + noise]])
    for a in (False, True):
        for b in (False, True):
            rows = (applied[0] == a) & (applied[1] == b)
            m1 = d.A @ d.mean + a * (d.B @ u[0, 0])
            m2 = d.A @ m1 + b * (d.B @ u[1, 0])
            mean = np.concatenate([m1, m2, d.C @ m1, d.C @ m2])
            sample = np.concatenate([x1, x2, y1, y2], axis=1)[rows]
            assert sample.shape[1] == 2 * n + 2 * p
            assert_law(sample, mean, covariance)


@pytest.mark.parametrize("name", ["scalar", "two states", "noise through G"])
def test_the_sensor_noise_is_gaussian_and_white(name: str) -> None:
    given = scenario(name)
    d = Definition(given)
    plant = Plant(given, 0, 4000)
    u = np.zeros((4000, given.system.q))
    noise = []
    for _ in range(4):
        x, y = plant.move(u, np.zeros(4000, dtype=np.bool_))
        noise.append(y - x @ d.C.T)
    squared = np.einsum("kmi,ij,kmj->km", noise, np.linalg.inv(d.R), noise)
    assert stats.kstest(squared.ravel(), stats.chi2(given.system.p).cdf).pvalue > 1e-3
    for one, other in pairwise(noise):
        assert abs(np.corrcoef(one[:, 0], other[:, 0])[0, 1]) < 4.0 / np.sqrt(4000)


def test_a_lost_control_packet_is_zero_and_changes_nothing_else() -> None:
    given = scenario("two states")
    d = Definition(given)
    u = np.random.default_rng(1).normal(size=(6, 1))
    some = np.array([True, False, True, True, False, False])
    nothing = Plant(given, 0, 6).move(np.zeros((6, 1)), np.ones(6, dtype=np.bool_))
    lost = Plant(given, 0, 6).move(u, np.zeros(6, dtype=np.bool_))
    partly = Plant(given, 0, 6).move(u, some)
    for i in range(2):
        np.testing.assert_array_equal(lost[i], nothing[i])
        np.testing.assert_array_equal(partly[i][~some], nothing[i][~some])
    np.testing.assert_allclose(partly[0][some] - nothing[0][some], u[some] @ d.B.T, atol=1e-13)
    np.testing.assert_allclose(partly[1][some] - nothing[1][some], u[some] @ (d.C @ d.B).T, atol=1e-13)


def test_control_that_did_not_come_at_all_is_zero() -> None:
    given = scenario("two states")
    absent = Plant(given, 0, 3).move(None, np.zeros(3, dtype=np.bool_))
    lost = Plant(given, 0, 3).move(np.ones((3, 1)), np.zeros(3, dtype=np.bool_))
    for one, other in zip(absent, lost, strict=True):
        np.testing.assert_array_equal(one, other)


def test_without_noise_the_path_is_the_recursion_of_the_definition() -> None:
    system = {**SYSTEMS["two states"], "Q": [[0.0, 0.0], [0.0, 0.0]], "P0": [[0.0, 0.0], [0.0, 0.0]]}
    given = parse_scenario({"system": system})
    d = Definition(given)
    for lanes in (1, 3):
        plant, x = Plant(given, 0, lanes), d.mean
        for k in range(5):
            applied = bool(k % 2)
            x = d.A @ x + applied * (d.B @ [k + 1.0])
            mask = applied if lanes == 1 else np.full(lanes, applied)
            found, _ = plant.move(np.full((lanes, 1), k + 1.0), mask)
            assert found.shape == (lanes, 2)
            np.testing.assert_allclose(found, np.tile(x, (lanes, 1)), rtol=1e-13)


@pytest.mark.parametrize("name", SYSTEMS)
def test_no_split_of_the_lanes_changes_a_bit(name: str) -> None:
    given = scenario(name)
    q = given.system.q
    rng = np.random.default_rng(2)
    u, applied = rng.normal(size=(4, 7, q)), rng.random((4, 7)) < 0.5

    def path(lane: int, lanes: int) -> list[Floats]:
        plant, out = Plant(given, lane, lanes), []
        for k in range(4):
            mask = applied[k, lane : lane + lanes]
            out.append(np.hstack(plant.move(u[k, lane : lane + lanes], bool(mask[0]) if lanes == 1 else mask)))
        return out

    whole = path(0, 7)
    for lane, lanes in ((0, 1), (1, 2), (3, 4), (6, 1)):
        for k, part in enumerate(path(lane, lanes)):
            np.testing.assert_array_equal(part, whole[k][lane : lane + lanes])


def test_the_seed_is_that_of_the_noises() -> None:
    one, again, other = (Plant(scenario("scalar", seed=s), 0, 1).move(np.zeros((1, 1)), False) for s in (1, 1, 2))
    assert one == again
    assert one[0] != other[0]
    assert one[1] != other[1]


@pytest.mark.parametrize(
    "covariance",
    [[[4.0]], [[0.0]], [[2.0, 1.0], [1.0, 1.0]], [[1.0, 1.0], [1.0, 1.0]], [[0.0, 0.0], [0.0, 3.0]], np.zeros((3, 3))],
)
def test_a_root_gives_its_covariance(covariance: Any) -> None:
    square = np.array(covariance)
    factor = root(square)
    np.testing.assert_allclose(factor @ factor.T, square, atol=1e-14)


def test_masks_as_bytes() -> None:
    assert (bits(True).tolist(), bits(False).tolist(), bits(True).dtype) == ([1], [0], np.uint8)
    assert bits(np.array([True, False])).tolist() == [1, 0]
    assert bits(np.array([True, False])).dtype == np.uint8
