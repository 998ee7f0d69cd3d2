"""A scan is its step function, step after step, compiled and not, to the bit."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from testbed.numerics.lanes import Component, Mask, Matrix, Vector, sqrt, symmetric, where
from testbed.numerics.scans import LANE_STEPS_MIN, TILE, scan
from testbed.numerics.symbols import Shape

STATE: tuple[Shape, ...] = (("vector", 3), ("symmetric", 2), ("scalar", 1))
GIVEN: tuple[Shape, ...] = (("scalar", 1), ("vector", 2))


def step(
    mask: Mask, x: Vector, P: Matrix, total: Component, unused: Component, y: Vector
) -> tuple[Vector, Matrix, Component]:
    """With a state that is handed on, one that is constant, and an input that is not used."""
    root = sqrt(1.0 + y[0] * y[0])
    return (
        [x[1], 2.5, where(mask, x[0] / root, x[2])],
        symmetric(2, lambda i, j: 0.5 * P[i][j] + y[i] * y[j]),
        where(mask, total + y[1], total),
    )


def by_hand(mask: Any, start: list[Any], y: Any) -> list[Any]:
    """The same recursion on whole arrays of one lane."""
    (x, p, (total,)), states = start, []
    for arrived, (a, b) in zip(mask, y, strict=True):
        x = [x[1], 2.5, x[0] / np.sqrt(1.0 + a * a) if arrived else x[2]]
        p = [0.5 * old + new for old, new in zip(p, (a * a, a * b, b * b), strict=True)]
        total = total + b if arrived else total
        states.append([*x, *p, total])
    return states


@pytest.mark.parametrize("lane_steps", [0, LANE_STEPS_MIN])
def test_is_its_function_step_after_step(lane_steps: int) -> None:
    run = scan(step, STATE, GIVEN, lane_steps)
    for steps, lanes in ((1, 1), (7, 1), (3, TILE + 1)):
        rng = np.random.default_rng([steps, lanes])
        mask = rng.random((steps, lanes)) < 0.5
        start = [rng.normal(size=(size, lanes)) for size in (3, 3, 1)]
        given = [rng.normal(size=(steps, size, lanes)) for size in (1, 2)]
        out = [np.full((steps, size, lanes), np.nan) for size in (3, 3, 1)]
        before = [array.copy() for array in (*start, *given)]
        run(mask, start, given, out)
        for array, copy in zip((*start, *given), before, strict=True):
            np.testing.assert_array_equal(array, copy)
        for lane in {0, lanes // 2, lanes - 1}:
            expected = by_hand(mask[:, lane], [rows[:, lane] for rows in start], given[1][:, :, lane])
            np.testing.assert_array_equal(np.concatenate([rows[:, :, lane] for rows in out], axis=1), expected)
