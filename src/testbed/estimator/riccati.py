"""The Riccati pieces of theory.md section 2, on components."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from testbed.estimator.model import Model
from testbed.numerics.lanes import (
    Cholesky,
    Component,
    Constant,
    Mask,
    Matrix,
    Vector,
    add,
    add_constant,
    add_outer,
    any_of,
    constant_dot,
    constant_sandwich,
    constant_times,
    constant_times_matrix,
    dot,
    scale,
    subtract,
    symmetric,
    times,
    where_symmetric,
)


@dataclass(frozen=True)
class Gain:
    """K = P C'(C P C' + R)^{-1} of a prediction covariance P, with what comes along."""

    P: Matrix
    C: Constant
    R: Constant

    @cached_property
    def _cp(self) -> Matrix:
        return constant_times_matrix(self.C, self.P)

    @cached_property
    def innovation(self) -> Cholesky:
        """C P C' + R, factored."""
        cp = self._cp
        return Cholesky(symmetric(len(self.C), lambda i, j: add_constant(constant_dot(self.C[j], cp[i]), self.R[i][j])))

    @cached_property
    def K(self) -> Matrix:
        """The gain, n × p."""
        factor = self.innovation
        return [factor.solve(list(column)) for column in zip(*self._cp, strict=True)]

    @cached_property
    def _complement(self) -> Matrix:
        """I − K C, n × n."""
        columns = list(zip(*self.C, strict=True))
        return [
            [(1.0 if i == j else 0.0) - constant_dot(column, row) for j, column in enumerate(columns)]
            for i, row in enumerate(self.K)
        ]

    def joseph(self, P: Matrix) -> Matrix:
        """h(P, K) = (I − K C) P (I − K C)' + K R K' for any P, with this gain."""
        left, k, r = self._complement, self.K, self.R
        lp = [[dot(row, list(column)) for column in zip(*P, strict=True)] for row in left]
        kr = [constant_times(r, row) for row in k]
        return symmetric(len(P), lambda i, j: dot(lp[i], left[j]) + dot(kr[i], k[j]))

    @cached_property
    def updated(self) -> Matrix:
        """φ(P, 1), by Joseph's form."""
        return self.joseph(self.P)

    def correct(self, x: Vector, y: Vector) -> Vector:
        """x + K (y − C x)."""
        return [a + b for a, b in zip(x, times(self.K, subtract(y, constant_times(self.C, x))), strict=True)]

    def propagate(self, d: Vector) -> Vector:
        """(I − K C) d: what the update leaves of a difference of means."""
        return times(self._complement, d)


def phi(P: Matrix, gain: Gain, arrived: Mask) -> Matrix:
    """φ(P, γ): updated where γ = 1, P itself elsewhere; ``gain`` is that of P."""
    if not any_of(arrived):
        return P
    return where_symmetric(arrived, gain.updated, P)


def predict(A: Constant, P: Matrix, Q: Constant) -> Matrix:
    """A P A' + Q."""
    return constant_sandwich(A, P, Q)


def log_odds(gain: Gain, shift: Vector, innovation: Vector) -> Component:
    """log N(e − C·shift; 0, S) − log N(e; 0, S) for the innovation e of the unshifted mean."""
    g = constant_times(gain.C, shift)
    half = gain.innovation.half_solve(g)
    return dot(half, gain.innovation.half_solve(innovation)) - 0.5 * dot(half, half)


def predict_with_mean_control(model: Model, x: Vector, P: Matrix, rate: Component, u: Vector) -> tuple[Vector, Matrix]:
    """Mean and covariance of the next state where ν is 1 with probability ``rate`` and only its moments are used.

    A x + rate B u, and A P A' + Q + rate (1 − rate) B u u' B' (F eq. 24).
    """
    mean, covariance = constant_times(model.a, x), predict(model.a, P, model.noise)
    if not model.q:
        return mean, covariance
    push = model.control_effect(u)
    return add(mean, scale(rate, push)), add_outer(covariance, rate * (1.0 - rate), push)
