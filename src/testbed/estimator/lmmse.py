"""LMMSE: the best linear filter for unacknowledged i.i.d. control losses (theory.md 3.8)."""

from __future__ import annotations

from functools import lru_cache, partial
from typing import Any, ClassVar

from numpy.typing import NDArray

from testbed.errors import UsageError
from testbed.estimator.hold import (
    kept,
    no_input,
    of_state,
    prior_of,
    refuse_moments,
    renewal,
    size_of,
    with_input,
)
from testbed.estimator.model import Ack, Estimate, Model, expected_nu
from testbed.estimator.riccati import Gain, phi, predict_with_mean_control
from testbed.estimator.state import Given, OneGaussian, State, state_of
from testbed.numerics.lanes import (
    Component,
    Floats,
    Mask,
    Matrix,
    Vector,
    add,
    any_of,
    mask_of,
    scale,
    subtract,
    symmetric,
    vector_of,
    where_vector,
)
from testbed.numerics.stepping import Step, masked_step
from testbed.numerics.symbols import Shape


class Lmmse(OneGaussian):
    """Linear: the control enters with its mean, its variance counts as noise, the gain is that of the whole P.

    An ACK of ν_{k−1} in time replaces the mean ν̄ of that packet by ν itself, so that with every ACK it is KFIO.

    With an actuator that holds, it estimates (x, a), a the input applied last: a_k = a + ν̄(u − a) + (ν_k − ν̄)(u − a),
    where the last term is uncorrelated with all that came before. Its variance ν̄(1 − ν̄) E[(u − a)(u − a)'] follows from
    the moments of a that the losses alone give, without data (u is taken as given, fed back or not).
    """

    STATE_VERSION: ClassVar[int] = 1
    takes_hold: ClassVar[bool] = True

    def __init__(self, model: Model, lanes: int) -> None:
        if not model.control.independent:
            raise UsageError(
                "estimator 'lmmse' holds for i.i.d. control losses only; for others use 'aoe', 'gpb', 'imm' or 'oe'"
            )
        self._model, self._lanes = model, lanes
        self._advance = (_held_stepper if model.holds else _stepper)(model, lanes)
        self._x, self._p = prior_of(model, lanes)
        self._applied = no_input(model.q, lanes) if model.holds else None
        """Mean and covariance of the input applied last, by the losses alone."""
        self._k = 0
        self.counters: dict[str, int] = {}

    def step(self, u: Floats, y: Floats, arrived: NDArray[Any], acks: tuple[Ack, ...] = ()) -> Estimate:
        """Older ACKs than that of ν_{k−1} cannot be used and are counted."""
        gamma = mask_of(arrived)
        self._k += 1
        given = expected_nu(self._model, acks, self._k - 1, self.counters), vector_of(u), vector_of(y)
        if self._applied is None:
            self._x, self._p = self._advance(gamma, self._x, self._p, *given)
            return Estimate(self._x, self._p, self._lanes)
        self._x, self._p, *moments = self._advance(gamma, self._x, self._p, *self._applied, *given)
        self._applied = moments[0], moments[1]
        return Estimate(*of_state(self._model, self._x, self._p), self._lanes)

    def state(self) -> State:
        """x (M, n), P (M, n, n); with an actuator that holds n + q in place of n, and the moments of a."""
        if self._applied is None:
            return super().state()
        mean, spread = self._applied
        return state_of(self._k, self._lanes, {"x": self._x, "P": self._p, "applied": mean, "spread": spread})

    def set_state(self, state: State) -> None:
        if self._applied is None:
            return super().set_state(state)
        size, q = size_of(self._model), self._model.q
        given = Given(state, self._lanes, self._model.n)
        x, p = given.vector("x", size), given.matrix("P", size)
        applied = given.vector("applied", q), given.matrix("spread", q)
        given.end()
        self._k, self._x, self._p, self._applied = given.step, x, p, applied
        return None

    def start_from(self, step: int, x_hat: Floats, P: Floats) -> None:
        refuse_moments(self._model, step)
        super().start_from(step, x_hat, P)
        if self._applied is not None:
            self._applied = no_input(self._model.q, self._lanes)
            self._x, self._p = with_input(self._x, self._p, self._applied[0])


def _advance(
    model: Model, gamma: Mask, x: Vector, P: Matrix, rate: Component, u: Vector, y: Vector
) -> tuple[Vector, Matrix]:
    """One step from x̂ and P, with P(ν = 1) = rate."""
    mean, covariance = predict_with_mean_control(model, x, P, rate, u)
    gain = Gain(covariance, model.c, model.sensor_noise)
    updated = where_vector(gamma, gain.correct(mean, y), mean) if any_of(gamma) else mean
    return updated, phi(covariance, gain, gamma)


def _advance_held(
    model: Model,
    gamma: Mask,
    z: Vector,
    P: Matrix,
    applied: Vector,
    spread: Matrix,
    rate: Component,
    u: Vector,
    y: Vector,
) -> tuple[Vector, Matrix, Vector, Matrix]:
    """The same for (x, a), and the moments of a by the losses alone."""
    n, size, stays, weight = model.n, len(z), 1.0 - rate, rate * (1.0 - rate)
    away = subtract(u, applied)

    def chosen(i: int, j: int) -> Component:
        """Of the covariance of (x_{k−1}, a_{k−1}) once ν_{k−1} has chosen."""
        if j < n:
            return P[i][j]
        if i < n:
            return stays * P[i][j]
        second = away[i - n] * away[j - n] + spread[i - n][j - n]
        return stays * stays * P[i][j] + weight * second

    mean = [*z[:n], *add(z[n:], scale(rate, subtract(u, z[n:])))]
    z, P, _ = kept(model, gamma, mean, symmetric(size, chosen), y)
    return z, P, *renewal(rate, u, applied, spread)


@lru_cache(maxsize=16)
def _held_stepper(model: Model, lanes: int) -> Step:
    state: tuple[Shape, ...] = (
        ("vector", size_of(model)),
        ("symmetric", size_of(model)),
        ("vector", model.q),
        ("symmetric", model.q),
    )
    given: tuple[Shape, ...] = (("scalar", 1), ("vector", model.q), ("vector", model.p))
    return masked_step(partial(_advance_held, model), (*state, *given), state, lanes)


@lru_cache(maxsize=16)
def _stepper(model: Model, lanes: int) -> Step:
    state: tuple[Shape, ...] = (("vector", model.n), ("symmetric", model.n))
    given: tuple[Shape, ...] = (("scalar", 1), ("vector", model.q), ("vector", model.p))
    return masked_step(partial(_advance, model), (*state, *given), state, lanes)
