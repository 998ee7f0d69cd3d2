"""The state of an estimator as named arrays, and back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from testbed.channel.law import Law
from testbed.errors import UsageError
from testbed.estimator.model import Model
from testbed.numerics.lanes import (
    Component,
    Floats,
    Matrix,
    Vector,
    array_of,
    matrices_of,
    matrix_of,
    symmetric,
    vector_of,
)
from testbed.numerics.packed import Named

State: TypeAlias = dict[str, NDArray[Any]]
"""Arrays of float64, uint8 or int64 by name; ``k``, of shape (), is the number of steps done."""

MAX_STEP = 2**53
_ROUNDING = 1e-9


def state_of(step: int, lanes: int, parts: Mapping[str, Component | Vector | Matrix]) -> State:
    """Components as (M,), vectors as (M, n), matrices as (M, n, n), all of them copies; and ``k``."""
    return {"k": np.array(step, dtype=np.int64), **{name: _packed(part, lanes) for name, part in parts.items()}}


class Given(Named):
    """A state that is read."""

    def __init__(self, state: Mapping[str, NDArray[Any]], lanes: int, n: int) -> None:
        super().__init__(state)
        self._lanes, self._n = lanes, n
        self.step = self.integer("k", MAX_STEP)

    def component(self, name: str) -> Component:
        array = self.array(name, np.float64, self._lanes)
        return float(array[0]) if self._lanes == 1 else array

    def vector(self, name: str, size: int | None = None) -> Vector:
        """Of n components, or of ``size``."""
        return vector_of(self.array(name, np.float64, self._lanes, self._n if size is None else size))

    def matrix(self, name: str, size: int | None = None) -> Matrix:
        """A symmetric one, n × n or of ``size``; what is above the diagonal counts."""
        n = self._n if size is None else size
        matrix = matrix_of(self.array(name, np.float64, self._lanes, n, n))
        return symmetric(n, lambda i, j: matrix[i][j])


def start_of(step: int, x_hat: Floats, P: Floats, lanes: int, n: int) -> tuple[Vector, Matrix]:
    """x̂ (M, n) and P (M, n, n) as components. Raises UsageError where they or the step cannot be a start."""
    if not 0 <= step <= MAX_STEP:
        raise UsageError(f"start: step {step}; allowed: 0 … {MAX_STEP}")
    given = Given({"k": np.array(step, dtype=np.int64), "x_hat": x_hat, "P": P}, lanes, n)
    mean, covariance = given.vector("x_hat"), given.matrix("P")
    scale = np.abs(P).max(axis=(1, 2), keepdims=True)
    unit = P / np.where(scale > 0.0, scale, 1.0)
    if (np.abs(unit - unit.transpose(0, 2, 1)) > _ROUNDING).any():
        raise UsageError("start: P is not symmetric")
    if (np.linalg.eigvalsh(unit) < -_ROUNDING).any():
        raise UsageError("start: P has a negative eigenvalue")
    return mean, covariance


class OneGaussian:
    """The restart of an estimator that knows x̂ and P and nothing else: ``_k`` steps, ``_x`` and ``_p``."""

    _model: Model
    _lanes: int
    _k: int
    _x: Vector
    _p: Matrix

    def state(self) -> State:
        return state_of(self._k, self._lanes, {"x": self._x, "P": self._p})

    def set_state(self, state: State) -> None:
        given = Given(state, self._lanes, self._model.n)
        x, p = given.vector("x"), given.matrix("P")
        given.end()
        self._k, self._x, self._p = given.step, x, p

    def start_from(self, step: int, x_hat: Floats, P: Floats) -> None:
        self._x, self._p = start_of(step, x_hat, P, self._lanes, self._model.n)
        self._k = step


def last_law(law: Law, step: int) -> Floats:
    """The law (H,) of the state of packet ``step`` − 1 ≥ 0 of which nothing is known: initial · transition^(step − 1).

    So that of the next packet is initial · transition^step.
    """
    weights = law.initial @ np.linalg.matrix_power(law.transition, step - 1)
    return np.asarray(weights / weights.sum())


def _packed(part: Any, lanes: int) -> Floats:
    if not isinstance(part, list):
        return np.array(np.broadcast_to(np.asarray(part, dtype=np.float64), lanes))
    return matrices_of(part, lanes) if isinstance(part[0], list) else array_of(part, lanes)
