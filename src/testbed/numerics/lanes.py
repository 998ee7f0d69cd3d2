"""Small linear algebra on lanes, written out component by component.

A *component* is one entry of a vector or matrix for every lane: an array of shape (M,), or a plain ``float`` where a
packet carries one lane. A vector is a list of components, a matrix a list of rows of them. All operations are
elementwise IEEE additions, multiplications, divisions and square roots, so that a lane's bits depend neither on the
number of lanes beside it nor on the form it is held in; and one code serves one lane (microseconds a step) and
thousands (lanes last in memory).

Constant matrices (the same for all lanes) are tuples of tuples of ``float``; their zeros are skipped.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias, cast

import numpy as np
from numpy.typing import NDArray

from testbed.numerics.kernels import LANES_MIN, available, kernel
from testbed.numerics.symbols import Shape, Symbol, straight_line

STRAIGHT_MAX = 8
"""Order of the largest matrix for which code is written out."""
_LARGEST = float(np.finfo(np.float64).max)

Floats: TypeAlias = NDArray[np.float64]
Bools: TypeAlias = NDArray[np.bool_]
Component: TypeAlias = Any  # float | Floats: a union would need a cast at every arithmetic operation
Mask: TypeAlias = Any  # bool | Bools
Vector: TypeAlias = list[Component]
Matrix: TypeAlias = list[list[Component]]
Constant: TypeAlias = tuple[tuple[float, ...], ...]


def constant(matrix: object) -> Constant:
    """A matrix of shape (r, c) as a constant."""
    array = np.asarray(matrix, dtype=np.float64)
    return tuple(tuple(float(v) for v in row) for row in array)


def full(value: float, lanes: int) -> Component:
    """One component with the same value in every lane."""
    return float(value) if lanes == 1 else np.full(lanes, float(value))


def full_vector(values: object, lanes: int) -> Vector:
    return [full(v, lanes) for v in np.asarray(values, dtype=np.float64)]


def full_matrix(values: object, lanes: int) -> Matrix:
    return [full_vector(row, lanes) for row in np.asarray(values, dtype=np.float64)]


def vector_of(array: Floats) -> Vector:
    """Components of an array of shape (M, n)."""
    if array.shape[0] == 1:
        return cast(Vector, array[0].tolist())
    return list(np.ascontiguousarray(array.T))


def array_of(vector: Vector, lanes: int) -> Floats:
    """The array of shape (M, n) of a vector of components."""
    if lanes == 1:
        return np.array([vector])
    out = np.empty((lanes, len(vector)))
    for i, component in enumerate(vector):
        out[:, i] = component
    return out


def matrices_of(matrix: Matrix, lanes: int) -> Floats:
    """The array of shape (M, r, c) of a matrix of components."""
    if lanes == 1:
        return np.array([matrix])
    rows, columns = len(matrix), len(matrix[0])
    out = np.empty((lanes, rows, columns))
    for i in range(rows):
        for j in range(columns):
            out[:, i, j] = matrix[i][j]
    return out


def matrix_of(array: Floats) -> Matrix:
    """Components of an array of shape (M, r, c)."""
    if array.shape[0] == 1:
        return cast(Matrix, array[0].tolist())
    lanes_last = np.ascontiguousarray(array.transpose(1, 2, 0))
    return [list(row) for row in lanes_last]


def mask_of(array: NDArray[Any]) -> Mask:
    """A mask of shape (M,) as a ``bool`` for one lane, else as a boolean array."""
    return bool(array[0]) if array.shape[0] == 1 else array.astype(np.bool_)


def where(mask: Mask, a: Component, b: Component) -> Component:
    if isinstance(mask, bool):
        return a if mask else b
    return mask.apply("where", a, b) if isinstance(mask, Symbol) else np.where(mask, a, b)


def where_vector(mask: Mask, a: Vector, b: Vector) -> Vector:
    if isinstance(mask, bool):
        return a if mask else b
    return [where(mask, x, y) for x, y in zip(a, b, strict=True)]


def where_symmetric(mask: Mask, a: Matrix, b: Matrix) -> Matrix:
    if isinstance(mask, bool):
        return a if mask else b
    return symmetric(len(a), lambda i, j: where(mask, a[i][j], b[i][j]))


def all_of(mask: Mask) -> bool:
    return mask if isinstance(mask, bool) else bool(mask.all())


def any_of(mask: Mask) -> bool:
    if isinstance(mask, Symbol):
        return True  # what may be observed in some lane is computed for all
    return mask if isinstance(mask, bool) else bool(mask.any())


def symmetric(n: int, entry: Any) -> Matrix:
    """The symmetric n × n matrix whose upper triangle is ``entry(i, j)``, i <= j."""
    out: Matrix = [[None] * n for _ in range(n)]
    for i in range(n):
        for j in range(i, n):
            out[i][j] = out[j][i] = entry(i, j)
    return out


def dot(a: Vector, b: Vector) -> Component:
    """Σ a_i b_i; 0.0 for empty vectors."""
    total: Component = 0.0
    for i, (x, y) in enumerate(zip(a, b, strict=True)):
        total = x * y if i == 0 else total + x * y
    return total


def constant_dot(a: tuple[float, ...], x: Vector) -> Component:
    """Σ a_i x_i with constant a; 0.0 if all are zero."""
    total: Component = None
    for factor, component in zip(a, x, strict=True):
        if factor == 0.0:
            continue
        term = component if factor == 1.0 else factor * component
        total = term if total is None else total + term
    return 0.0 if total is None else total


def constant_times(a: Constant, x: Vector) -> Vector:
    """A x, A constant."""
    return [constant_dot(row, x) for row in a]


def times(k: Matrix, x: Vector) -> Vector:
    """K x."""
    return [dot(row, x) for row in k]


def constant_times_matrix(a: Constant, p: Matrix) -> Matrix:
    """A P, A constant."""
    columns = list(zip(*p, strict=True))
    return [[constant_dot(row, list(column)) for column in columns] for row in a]


def constant_sandwich(a: Constant, p: Matrix, q: Constant) -> Matrix:
    """A P A' + Q for symmetric P; A, Q constant."""
    ap = constant_times_matrix(a, p)
    return symmetric(len(a), lambda i, j: add_constant(constant_dot(a[j], ap[i]), q[i][j]))


def add_constant(x: Component, c: float) -> Component:
    return x if c == 0.0 else x + c


def add(a: Vector, b: Vector) -> Vector:
    return [x + y for x, y in zip(a, b, strict=True)]


def subtract(a: Vector, b: Vector) -> Vector:
    return [x - y for x, y in zip(a, b, strict=True)]


def scale(c: Component, a: Vector) -> Vector:
    return [c * x for x in a]


def add_outer(p: Matrix, c: Component, d: Vector) -> Matrix:
    """P + c d d' for symmetric P."""
    cd = scale(c, d)
    return symmetric(len(d), lambda i, j: p[i][j] + cd[i] * d[j])


def trace(p: Matrix) -> Component:
    total = p[0][0]
    for i in range(1, len(p)):
        total = total + p[i][i]
    return total


def sqrt(x: Component) -> Component:
    if isinstance(x, float):
        return math.sqrt(x) if x >= 0.0 else math.nan
    if isinstance(x, Symbol):
        return x.apply("sqrt")
    return np.sqrt(x)


def reciprocal(x: Component) -> Component:
    if isinstance(x, float):
        return 1.0 / x if x != 0.0 else math.copysign(math.inf, x)
    if isinstance(x, Symbol):
        return x.apply("reciprocal")
    return 1.0 / x


def exp(x: Component) -> Component:
    """exp by numpy in both forms: ``math.exp`` differs from it in the last bit."""
    if isinstance(x, float):
        return float(np.exp(x))
    return x.apply("exp") if isinstance(x, Symbol) else np.exp(x)


def log(x: Component) -> Component:
    """log by numpy in both forms, as ``exp``."""
    if isinstance(x, float):
        return float(np.log(x))
    return x.apply("log") if isinstance(x, Symbol) else np.log(x)


def larger(a: Component, b: Component) -> Component:
    """The larger of two finite components."""
    return clip(a, b, _LARGEST)


def clip(x: Component, low: Component, high: Component) -> Component:
    if isinstance(x, float):
        return min(max(x, low), high)
    if isinstance(x, Symbol):
        return x.apply("clip", low, high)
    return np.minimum(np.maximum(x, low), high)


def one_lane(
    function: Callable[..., Sequence[Any]], arguments: Sequence[Shape], results: Sequence[Shape]
) -> Callable[..., tuple[Any, ...]]:
    """``function`` as straight-line code for one lane, to the same bits; itself where it is too long for that."""
    if max(n for _, n in arguments) > STRAIGHT_MAX:
        return cast(Callable[..., tuple[Any, ...]], function)
    calls: dict[str, Callable[..., Any]] = {
        "sqrt": sqrt,
        "reciprocal": reciprocal,
        "exp": exp,
        "log": log,
        "clip": clip,
    }
    return straight_line(function, arguments, results, calls)


def many_lanes(
    function: Callable[..., Sequence[Any]], arguments: Sequence[Shape], results: Sequence[Shape], lanes: int
) -> Callable[..., tuple[Any, ...]]:
    """``function`` for many lanes: compiled where that is possible and pays, to the same bits; else itself."""
    if lanes < LANES_MIN or max(n for _, n in arguments) > STRAIGHT_MAX or not available():
        return cast(Callable[..., tuple[Any, ...]], function)
    return kernel(function, arguments, results, {"exp": exp, "log": log})


class Cholesky:
    """S = L L' of a symmetric positive definite matrix of components; NaN in the lanes where it is not."""

    def __init__(self, s: Matrix) -> None:
        n = len(s)
        lower: Matrix = [[0.0] * n for _ in range(n)]
        self._inverse_diagonal: Vector = [0.0] * n
        for j in range(n):
            pivot = s[j][j]
            for m in range(j):
                pivot = pivot - lower[j][m] * lower[j][m]
            root = sqrt(pivot)
            lower[j][j] = root
            inverse = self._inverse_diagonal[j] = reciprocal(root)
            for i in range(j + 1, n):
                entry = s[i][j]
                for m in range(j):
                    entry = entry - lower[i][m] * lower[j][m]
                lower[i][j] = entry * inverse
        self._lower = lower

    def mapped(self, function: Callable[[Component], Component]) -> Cholesky:
        """The same factor with ``function`` applied to every component."""
        out = object.__new__(Cholesky)
        out._lower = [[function(entry) for entry in row] for row in self._lower]
        out._inverse_diagonal = [function(entry) for entry in self._inverse_diagonal]
        return out

    def half_solve(self, b: Vector) -> Vector:
        """L^{-1} b."""
        out: Vector = []
        for i, row in enumerate(self._lower):
            total = b[i]
            for m in range(i):
                total = total - row[m] * out[m]
            out.append(total * self._inverse_diagonal[i])
        return out

    def solve(self, b: Vector) -> Vector:
        """S^{-1} b."""
        half = self.half_solve(b)
        n = len(half)
        out: Vector = [None] * n
        for i in reversed(range(n)):
            total = half[i]
            for m in range(i + 1, n):
                total = total - self._lower[m][i] * out[m]
            out[i] = total * self._inverse_diagonal[i]
        return out

    def quadratic(self, b: Vector) -> Component:
        """b' S^{-1} b."""
        half = self.half_solve(b)
        return dot(half, half)

    def log_density(self, b: Vector) -> Component:
        """log N(b; 0, S) but for −½ log 2π a dimension."""
        peak = self._inverse_diagonal[0]
        for factor in self._inverse_diagonal[1:]:
            peak = peak * factor
        return log(peak) - 0.5 * self.quadratic(b)
