"""Straight-line code for one lane against the function it was made from: the same bits, for floats and for arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from testbed.numerics import lanes as la

check = settings(deadline=None, max_examples=40)
A = la.constant([[1.0, 0.5, 0.0], [0.0, -0.7, 1.0], [0.3, 0.0, 2.0]])
Q = la.constant([[1.0, 0.0, 0.2], [0.0, 0.0, 0.0], [0.2, 0.0, 3.0]])


def everything(x: la.Vector, P: la.Matrix, c: la.Component) -> tuple[Any, ...]:
    """Every operation that a program may hold, with shared parts and constants among the results."""
    moved = la.constant_sandwich(A, P, Q)
    factor = la.Cholesky(moved)
    solved = factor.solve(la.constant_times(A, x))
    weight = la.exp(la.clip(c * factor.quadratic(x), -3.0, 700.0))
    other = la.reciprocal(1.0 + la.sqrt(la.trace(P)) - 0.25)
    merged = la.add_outer(moved, weight * other, la.subtract(x, solved))
    return la.scale(-1.0 * c, solved), merged, 2.0 - weight / (other + 1.0), 0.5


ARGUMENTS = (("vector", 3), ("symmetric", 3), ("scalar", 1))
RESULTS = (("vector", 3), ("symmetric", 3), ("scalar", 1), ("scalar", 1))
compiled = la.one_lane(everything, ARGUMENTS, RESULTS)  # type: ignore[arg-type]


def sample(seed: int) -> tuple[Any, Any, Any]:
    """x (M, 3), P (M, 3, 3), c (M,)."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(5, 3, 3)) * 10.0 ** rng.uniform(-3, 3, size=(5, 1, 1))
    return rng.normal(size=(5, 3)), root @ root.transpose(0, 2, 1) + 1e-3 * np.eye(3), rng.normal(size=5)


def flat(value: Any) -> list[float]:
    return [entry for part in value for entry in flat(part)] if isinstance(value, list | tuple) else [value]


@check
@given(st.integers(0, 2**32 - 1))
def test_the_bits_are_those_of_the_function(seed: int) -> None:
    x, P, c = sample(seed)
    P = (P + P.transpose(0, 2, 1)) / 2
    with np.errstate(over="ignore", invalid="ignore"):
        assert_same_bits(x, P, c)


def assert_same_bits(x: Any, P: Any, c: Any) -> None:
    whole = [np.broadcast_to(e, 5) for e in flat(list(everything(la.vector_of(x), la.matrix_of(P), c)))]
    for lane in range(5):
        arguments = x[lane].tolist(), P[lane].tolist(), float(c[lane])
        found = flat(list(compiled(*arguments)))
        np.testing.assert_array_equal(found, flat(list(everything(*arguments))))
        np.testing.assert_array_equal(found, [entry[lane] for entry in whole])
        assert all(isinstance(entry, float) for entry in found)


def test_numbers_that_are_not_numbers_pass_through() -> None:
    x, P = [1.0, 2.0, 3.0], [[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]
    found = flat(list(compiled(x, P, 1.0)))
    expected = flat(list(everything(x, P, 1.0)))
    np.testing.assert_array_equal(found, expected)
    assert np.isnan(found).any()


def test_results_are_new_at_each_call() -> None:
    x, P, _ = sample(1)
    first = compiled(x[0].tolist(), P[0].tolist(), 1.0)
    first[0][0] = 1e9
    first[1][0][1] = 1e9
    again = compiled(x[0].tolist(), P[0].tolist(), 1.0)
    assert again[0][0] != 1e9
    assert again[1][0][1] != 1e9
    assert again[1][1][0] == again[1][0][1]


def test_the_function_is_run_once() -> None:
    calls = []

    def counted(x: la.Vector) -> tuple[Any, ...]:
        calls.append(x)
        return (la.add(x, x),)

    program = la.one_lane(counted, (("vector", 2),), (("vector", 2),))
    assert [program([float(i), 1.0])[0] for i in range(3)] == [[0.0, 2.0], [2.0, 2.0], [4.0, 2.0]]
    assert len(calls) == 1


@pytest.mark.parametrize("n", [1, 2, 3, 8, 9, 12])
def test_any_size_works(n: int) -> None:
    rng = np.random.default_rng(n)
    root = rng.normal(size=(n, n))
    P, x = (root @ root.T + np.eye(n)).tolist(), rng.normal(size=n).tolist()
    P = [[P[min(i, j)][max(i, j)] for j in range(n)] for i in range(n)]

    def quadratic(x: la.Vector, P: la.Matrix) -> tuple[Any, ...]:
        return (la.Cholesky(P).quadratic(x), la.symmetric(n, lambda i, j: P[i][j] + 1.0))

    made = la.one_lane(quadratic, (("vector", n), ("symmetric", n)), (("scalar", 1), ("symmetric", n)))
    value, shifted = made(x, P)
    assert value == quadratic(x, P)[0]
    assert value == pytest.approx(np.array(x) @ np.linalg.solve(np.array(P), np.array(x)), rel=1e-9)
    np.testing.assert_array_equal(shifted, np.array(P) + 1.0)


def test_what_cannot_be_written_is_refused() -> None:
    with pytest.raises(TypeError):
        la.one_lane(lambda x: (x[0] + np.ones(2),), (("vector", 1),), (("scalar", 1),))([1.0])
