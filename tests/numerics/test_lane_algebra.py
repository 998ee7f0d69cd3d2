"""The algebra on lanes against numpy.linalg, and one lane as a float against the same lane of an array."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from testbed.numerics import lanes as la

Array = NDArray[np.float64]
LANES = 7
SIZES = [(1, 1), (2, 1), (2, 3), (3, 2), (4, 4), (6, 5)]


def spd(rng: np.random.Generator, n: int, lanes: int = LANES) -> Array:
    root = rng.normal(size=(lanes, n, n))
    return np.asarray(root @ root.transpose(0, 2, 1) + 0.1 * np.eye(n))


def close(actual: Array, expected: Array, tolerance: float = 1e-12) -> None:
    assert actual.shape == expected.shape
    np.testing.assert_allclose(actual, expected, rtol=tolerance, atol=tolerance * max(1.0, np.abs(expected).max()))


def matrices(matrix: la.Matrix, lanes: int = LANES) -> Array:
    return la.matrices_of(matrix, lanes)


@pytest.fixture(params=SIZES, ids=str)
def case(request: pytest.FixtureRequest) -> dict[str, Any]:
    """Random matrices and vectors: A (r, n) with zeros and ones in it, P (M, n, n), K (M, r, n), x, d (M, n)."""
    n, r = request.param
    rng = np.random.default_rng(10 * n + r)
    A = rng.normal(size=(r, n))
    A[rng.random((r, n)) < 0.25] = 0.0
    A[rng.random((r, n)) < 0.25] = 1.0
    Q = rng.normal(size=(r, r))
    return {
        "n": n,
        "r": r,
        "A": A,
        "Q": np.where(rng.random((r, r)) < 0.3, 0.0, Q + Q.T),
        "P": spd(rng, n),
        "K": rng.normal(size=(LANES, r, n)),
        "x": rng.normal(size=(LANES, n)),
        "d": rng.normal(size=(LANES, n)),
        "c": rng.normal(size=LANES),
        "mask": np.array([True, False, True, True, False, False, True]),
    }


def test_products_are_those_of_numpy(case: dict[str, Any]) -> None:
    A, P, K, x = case["A"], case["P"], case["K"], case["x"]
    a, p, k, v = la.constant(A), la.matrix_of(P), la.matrix_of(K), la.vector_of(x)
    close(la.array_of(la.constant_times(a, v), LANES), x @ A.T)
    close(la.array_of(la.times(k, v), LANES), np.einsum("mij,mj->mi", K, x))
    close(matrices(la.constant_times_matrix(a, p)), A @ P)
    close(np.asarray(la.dot(v, la.vector_of(case["d"]))), np.einsum("mi,mi->m", x, case["d"]))
    close(np.asarray(la.trace(p)), np.trace(P, axis1=1, axis2=2))


def test_sandwiches_are_those_of_numpy(case: dict[str, Any]) -> None:
    A, P, Q = case["A"], case["P"], np.triu(case["Q"]) + np.triu(case["Q"], 1).T
    p = la.matrix_of(P)
    close(matrices(la.constant_sandwich(la.constant(A), p, la.constant(Q))), A @ P @ A.T + Q)
    outer = P + case["c"][:, None, None] * np.einsum("mi,mj->mij", case["d"], case["d"])
    close(matrices(la.add_outer(p, case["c"], la.vector_of(case["d"]))), outer)


def test_sums_and_choices_are_those_of_numpy(case: dict[str, Any]) -> None:
    x, d, c, mask = case["x"], case["d"], case["c"], case["mask"]
    v, w = la.vector_of(x), la.vector_of(d)
    np.testing.assert_array_equal(la.array_of(la.add(v, w), LANES), x + d)
    np.testing.assert_array_equal(la.array_of(la.subtract(v, w), LANES), x - d)
    np.testing.assert_array_equal(la.array_of(la.scale(c, v), LANES), c[:, None] * x)
    np.testing.assert_array_equal(la.array_of(la.where_vector(mask, v, w), LANES), np.where(mask[:, None], x, d))
    other = case["P"] + np.eye(case["n"])
    chosen = la.where_symmetric(mask, la.matrix_of(case["P"]), la.matrix_of(other))
    np.testing.assert_array_equal(matrices(chosen), np.where(mask[:, None, None], case["P"], other))


def test_cholesky_solves_as_numpy_does(case: dict[str, Any]) -> None:
    P, b = case["P"], case["x"]
    factor = la.Cholesky(la.matrix_of(P))
    solved = np.linalg.solve(P, b[..., None])[..., 0]
    close(la.array_of(factor.solve(la.vector_of(b)), LANES), solved, 1e-9)
    half = np.linalg.solve(np.linalg.cholesky(P), b[..., None])[..., 0]
    close(la.array_of(factor.half_solve(la.vector_of(b)), LANES), half, 1e-9)
    close(np.asarray(factor.quadratic(la.vector_of(b))), np.einsum("mi,mi->m", b, solved), 1e-9)


def test_a_mapped_factor_is_the_factor_of_the_mapped_lanes(case: dict[str, Any]) -> None:
    P, b = case["P"], case["x"]
    rows = np.array([4, 0, 0, 2])
    mapped = la.Cholesky(la.matrix_of(P)).mapped(lambda entry: np.broadcast_to(entry, LANES)[rows])
    direct = la.Cholesky(la.matrix_of(P[rows]))
    vector = la.vector_of(b[rows])
    np.testing.assert_array_equal(la.array_of(mapped.solve(vector), 4), la.array_of(direct.solve(vector), 4))


OPERATIONS: dict[str, Callable[[dict[str, Any], la.Vector, la.Vector, la.Matrix, Any], Any]] = {
    "constant_times": lambda c, x, d, p, s: la.constant_times(la.constant(c["A"]), x),
    "constant_sandwich": lambda c, x, d, p, s: la.constant_sandwich(la.constant(c["A"]), p, la.constant(c["Q"])),
    "add_outer": lambda c, x, d, p, s: la.add_outer(p, s, d),
    "times": lambda c, x, d, p, s: la.times(p, x),
    "dot": lambda c, x, d, p, s: la.dot(x, d),
    "trace": lambda c, x, d, p, s: la.trace(p),
    "solve": lambda c, x, d, p, s: la.Cholesky(p).solve(x),
    "quadratic": lambda c, x, d, p, s: la.Cholesky(p).quadratic(x),
    "not definite": lambda c, x, d, p, s: la.Cholesky(la.add_outer(p, -1.0, la.scale(9.0, d))).quadratic(x),
    "exp": lambda c, x, d, p, s: [la.exp(30.0 * entry) for entry in x],
    "sqrt": lambda c, x, d, p, s: [la.sqrt(entry) for entry in x],
    "reciprocal": lambda c, x, d, p, s: [la.reciprocal(entry) for entry in x],
    "clip": lambda c, x, d, p, s: [la.clip(entry, -0.5, 0.5) for entry in x],
    "where": lambda c, x, d, p, s: la.where(s > 0.0, x[0], d[0]),
    "where_symmetric": lambda c, x, d, p, s: la.where_symmetric(s > 0.0, p, la.add_outer(p, 1.0, d)),
}


def flat(value: Any) -> list[Any]:
    return [entry for part in value for entry in flat(part)] if isinstance(value, list) else [value]


@pytest.mark.parametrize("name", OPERATIONS)
def test_one_lane_as_a_float_has_the_bits_of_its_array(name: str, case: dict[str, Any]) -> None:
    operation = OPERATIONS[name]

    def of_rows(rows: slice) -> list[Any]:
        vectors = [la.vector_of(case[key][rows]) for key in ("x", "d")]
        scalar = case["c"][rows]
        number = float(scalar[0]) if len(scalar) == 1 else scalar
        with np.errstate(invalid="ignore", divide="ignore"):
            return flat(operation(case, *vectors, la.matrix_of(case["P"][rows]), number))

    whole = [np.broadcast_to(entry, LANES) for entry in of_rows(slice(None))]
    for lane in range(LANES):
        single = of_rows(slice(lane, lane + 1))
        assert all(isinstance(entry, float) for entry in single)
        np.testing.assert_array_equal(single, [entry[lane] for entry in whole])


@pytest.mark.parametrize("length", [1, 2, 3, 5, 8, 13, 16, 31, 100, 1000])
def test_exp_has_the_same_bits_at_any_length(length: int) -> None:
    x = np.random.default_rng(3).uniform(-700, 700, size=length)
    expected = [la.exp(float(v)) for v in x]
    np.testing.assert_array_equal(la.exp(x), expected)
    np.testing.assert_array_equal(la.exp(np.repeat(x, 3)[::3]), expected)
    np.testing.assert_allclose(expected, [math.exp(v) for v in x], rtol=1e-14)


@pytest.mark.parametrize("special", [math.inf, -math.inf, math.nan, 0.0, -0.0, -1.0, 5e-324, 1e308])
def test_floats_and_arrays_agree_at_the_edges(special: float) -> None:
    pair = np.array([special, special])
    functions = (la.exp, la.sqrt, la.reciprocal, lambda x: la.clip(x, -700.0, 700.0))
    with np.errstate(all="ignore"):
        for function in functions:
            np.testing.assert_array_equal(function(special), function(pair)[0])


def test_a_matrix_that_is_not_definite_spoils_its_own_lane_only() -> None:
    P = np.array([[[2.0, 1.0], [1.0, 2.0]], [[1.0, 2.0], [2.0, 1.0]], [[2.0, 0.0], [0.0, 3.0]]])
    b = np.ones((3, 2))
    with np.errstate(invalid="ignore"):
        value = np.asarray(la.Cholesky(la.matrix_of(P)).quadratic(la.vector_of(b)))
    np.testing.assert_allclose(value, [2.0 / 3.0, np.nan, 0.5 + 1.0 / 3.0])
    assert math.isnan(la.Cholesky(la.matrix_of(P[1:2])).quadratic(la.vector_of(b[1:2])))


@pytest.mark.parametrize("lanes", [1, 2, 4])
def test_conversions_keep_shape_and_values(lanes: int) -> None:
    rng = np.random.default_rng(5)
    x, P = rng.normal(size=(lanes, 3)), rng.normal(size=(lanes, 2, 3))
    np.testing.assert_array_equal(la.array_of(la.vector_of(x), lanes), x)
    np.testing.assert_array_equal(la.matrices_of(la.matrix_of(P), lanes), P)
    np.testing.assert_array_equal(la.array_of(la.full_vector([1.0, 2.0], lanes), lanes), [[1.0, 2.0]] * lanes)
    np.testing.assert_array_equal(
        la.matrices_of(la.full_matrix([[1.0], [2.0]], lanes), lanes), [[[1.0], [2.0]]] * lanes
    )
    bits = rng.integers(0, 2, size=lanes).astype(np.uint8)
    mask = la.mask_of(bits)
    assert la.any_of(mask) == bool(bits.any())
    assert la.all_of(mask) == bool(bits.all())
    np.testing.assert_array_equal(np.atleast_1d(mask), bits.astype(bool))
