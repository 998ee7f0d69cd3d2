"""The moves of a plant whose actuator holds: x⁺ = A x + B a, a_k = ν_k u_k + (1 − ν_k) a_{k−1}, a_{−1} = 0.

With z = (x, a) of n + q numbers that is a linear system that jumps with ν. At a step a hypothesis first says which
input is applied, the one before (ν = 0) or u (ν = 1), and then the plant moves by z⁺ = [[A, B], [0, I]] z + (w, 0).
Where a hypothesis says when the last packet arrived, its a is known, and what its covariance has of a is exactly zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.errors import UsageError
from testbed.estimator.mixtures import Part
from testbed.estimator.model import Model
from testbed.estimator.riccati import Gain, phi, predict
from testbed.numerics.lanes import (
    Component,
    Constant,
    Floats,
    Mask,
    Matrix,
    Vector,
    add,
    any_of,
    constant,
    constant_times,
    full_matrix,
    full_vector,
    scale,
    subtract,
    symmetric,
    where,
    where_vector,
)


@dataclass(frozen=True)
class Held:
    """move [[A, B], [0, I]], c [C 0], noise diag(Q, 0)."""

    move: Constant
    c: Constant
    noise: Constant


@lru_cache(maxsize=16)
def held(model: Model) -> Held:
    """The matrices of z = (x, a). The model has a B."""
    n, q, b = model.n, model.q, model.B
    noise = np.zeros((n + q, n + q))
    noise[:n, :n] = model.Q
    return Held(
        constant(np.block([[model.A, b], [np.zeros((q, n)), np.eye(q)]])),
        constant(np.hstack([model.C, np.zeros((model.p, q))])),
        constant(noise),
    )


def size_of(model: Model) -> int:
    """How many numbers a hypothesis tells of: n, and with an actuator that holds n + q."""
    return model.n + model.q if model.holds else model.n


def prior_of(model: Model, lanes: int) -> tuple[Vector, Matrix]:
    """Mean and covariance of (x_0, a_{−1}); of x_0 where nothing is held."""
    if not model.holds:
        return model.prior(lanes)
    return with_input(*model.prior(lanes), full_vector(np.zeros(model.q), lanes))


def with_input(x: Vector, P: Matrix, a: Vector) -> tuple[Vector, Matrix]:
    """Mean and covariance of (x, a) from those of x, where a is known."""
    n = len(x)
    return [*x, *a], symmetric(n + len(a), lambda i, j: P[i][j] if j < n else 0.0)


def of_state(model: Model, z: Vector, P: Matrix) -> tuple[Vector, Matrix]:
    """Mean and covariance of x from those of (x, a)."""
    n = model.n
    return z[:n], [row[:n] for row in P[:n]]


def kept(model: Model, gamma: Mask, z: Vector, P: Matrix, y: Vector) -> Part:
    """A step with ν = 0: mean and covariance of (x, a), and the log-likelihood of y where ``gamma``."""
    matrices = held(model)
    mean, covariance = constant_times(matrices.move, z), predict(matrices.move, P, matrices.noise)
    return _observed(model, matrices.c, gamma, mean, covariance, y)


def renewed(model: Model, gamma: Mask, z: Vector, P: Matrix, u: Vector, y: Vector) -> Part:
    """The same with ν = 1: a is u."""
    x, p = of_state(model, z, P)
    mean, covariance = add(constant_times(model.a, x), model.control_effect(u)), predict(model.a, p, model.noise)
    x, p, score = _observed(model, model.c, gamma, mean, covariance, y)
    return *with_input(x, p, u), score


def _observed(model: Model, c: Constant, gamma: Mask, mean: Vector, covariance: Matrix, y: Vector) -> Part:
    gain = Gain(covariance, c, model.sensor_noise)
    score: Component = 0.0
    if any_of(gamma):
        score = where(gamma, gain.innovation.log_density(subtract(y, constant_times(c, mean))), 0.0)
        mean = where_vector(gamma, gain.correct(mean, y), mean)
    return mean, phi(covariance, gain, gamma), score


def renewal(rate: Component, u: Vector, mean: Vector, spread: Matrix) -> tuple[Vector, Matrix]:
    """Mean and covariance of a_k from those of a_{k−1}, where ν_k is independent of it and 1 with probability rate."""
    away = subtract(u, mean)
    stays, weight = 1.0 - rate, rate * (1.0 - rate)
    return (
        add(mean, scale(rate, away)),
        symmetric(len(u), lambda i, j: stays * spread[i][j] + weight * away[i] * away[j]),
    )


def no_input(q: int, lanes: int) -> tuple[Vector, Matrix]:
    """Mean and covariance of a_{−1} = 0."""
    return full_vector(np.zeros(q), lanes), full_matrix(np.zeros((q, q)), lanes)


def refuse_moments(model: Model, step: int) -> None:
    """Raises UsageError where x̂ and P after ``step`` steps do not say all: the input applied last is missing."""
    if model.holds and step:
        raise UsageError(
            f'start: x_hat and P of step {step} do not say which input was applied last, and on_loss = "hold" applies '
            "it again; allowed: step 0, or a full snapshot"
        )


def applied_inputs(u: Floats, nu: NDArray[Any], before: Floats | None = None) -> Floats:
    """a_0, a_1, … (T, q, M) of an actuator that holds, from u (T, q, M) as sent and ν (T, M).

    before (q, M): what was applied before the first; None: zero.
    """
    applied = np.empty_like(u)
    last = np.zeros(u.shape[1:]) if before is None else before
    for k, arrived in enumerate(nu):
        applied[k] = last = np.where(arrived == 1, u[k], last)
    return applied
