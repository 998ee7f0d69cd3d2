"""FF: the fast filter of F (eq. 24, theory.md 3.3), for unacknowledged i.i.d. control losses."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from testbed.errors import UsageError
from testbed.estimator.hold import held, no_input, refuse_moments, renewal
from testbed.estimator.model import Ack, Estimate, Model, expected_nu
from testbed.estimator.riccati import Gain, phi, predict, predict_with_mean_control
from testbed.estimator.state import Given, State, start_of, state_of
from testbed.numerics.lanes import (
    Component,
    Floats,
    Mask,
    Matrix,
    Vector,
    add,
    any_of,
    constant_times,
    full_vector,
    mask_of,
    scale,
    symmetric,
    vector_of,
    where_symmetric,
    where_vector,
)
from testbed.numerics.stepping import Step, masked_step
from testbed.numerics.symbols import Shape


class Ff:
    """Linear: the control enters with its mean, the gain is the ACK filter's.

    An ACK of ν_{k−1} in time replaces the mean ν̄ of that packet by ν itself, so that with every ACK it is KFIO.

    With an actuator that holds, the control enters with the mean ā_k = ν̄ u_k + (1 − ν̄) ā_{k−1} of what is applied. Its
    error δ_k = a_k − ā_k is correlated with that of the state, E[e δ_k'] = (1 − ν̄) E[e δ_{k−1}'], so that P̃ follows
    from the covariance of (e, δ) and is the covariance of the error as before.
    """

    STATE_VERSION: ClassVar[int] = 1
    takes_hold: ClassVar[bool] = True

    def __init__(self, model: Model, lanes: int) -> None:
        if not model.control.independent:
            raise UsageError("estimator 'ff' holds for i.i.d. control losses only; for others use 'aoe' or 'oe'")
        self._model, self._lanes = model, lanes
        self._advance = (_held_stepper if model.holds else _stepper)(model, lanes)
        self._x, self._p = model.prior(lanes)
        self._ack_p = self._p
        self._applied = _nothing(model, lanes) if model.holds else None
        """Mean of the input applied last, its covariance, and, a vector a channel, E[e δ']."""
        self._k = 0
        self.counters: dict[str, int] = {}

    def step(self, u: Floats, y: Floats, arrived: NDArray[Any], acks: tuple[Ack, ...] = ()) -> Estimate:
        """Older ACKs than that of ν_{k−1} cannot be used and are counted."""
        gamma = mask_of(arrived)
        self._k += 1
        given = expected_nu(self._model, acks, self._k - 1, self.counters), vector_of(u), vector_of(y)
        held = () if self._applied is None else (self._applied.mean, self._applied.spread, *self._applied.cross)
        self._x, self._p, self._ack_p, *after = self._advance(gamma, self._x, self._p, self._ack_p, *held, *given)
        if self._applied is not None:
            self._applied = _Applied(after[0], after[1], after[2:])
        return Estimate(self._x, self._p, self._lanes)

    def state(self) -> State:
        """x̃, P̃, Pᴬ; with an actuator that holds, the mean and covariance of a, and ``cross0`` …, E[e δ'] by channel."""
        parts: dict[str, Any] = {"x": self._x, "P": self._p, "ack_P": self._ack_p}
        if self._applied is not None:
            parts |= {"applied": self._applied.mean, "spread": self._applied.spread}
            parts |= {f"cross{i}": column for i, column in enumerate(self._applied.cross)}
        return state_of(self._k, self._lanes, parts)

    def set_state(self, state: State) -> None:
        given = Given(state, self._lanes, self._model.n)
        x, p, ack_p = given.vector("x"), given.matrix("P"), given.matrix("ack_P")
        applied = None
        if self._applied is not None:
            q = self._model.q
            cross = [given.vector(f"cross{i}") for i in range(q)]
            applied = _Applied(given.vector("applied", q), given.matrix("spread", q), cross)
        given.end()
        self._k, self._x, self._p, self._ack_p, self._applied = given.step, x, p, ack_p, applied

    def start_from(self, step: int, x_hat: Floats, P: Floats) -> None:
        """Pᴬ, from which the gain comes, begins at P as well: it is what an ACK filter that starts there has."""
        refuse_moments(self._model, step)
        self._x, self._p = start_of(step, x_hat, P, self._lanes, self._model.n)
        self._k, self._ack_p = step, self._p
        self._applied = _nothing(self._model, self._lanes) if self._model.holds else None


@dataclass(frozen=True)
class _Applied:
    """Of the input applied last: mean (q), covariance (q × q), and E[e δ'], a vector (n) for each channel."""

    mean: Vector
    spread: Matrix
    cross: list[Vector]


def _nothing(model: Model, lanes: int) -> _Applied:
    cross = [full_vector(np.zeros(model.n), lanes) for _ in range(model.q)]
    return _Applied(*no_input(model.q, lanes), cross)


def _advance(
    model: Model, gamma: Mask, x: Vector, P: Matrix, ack_P: Matrix, rate: Component, u: Vector, y: Vector
) -> tuple[Vector, Matrix, Matrix]:
    """One step from x̃, P̃ and Pᴬ, with P(ν = 1) = rate."""
    mean, covariance = predict_with_mean_control(model, x, P, rate, u)
    ack_covariance = predict(model.a, ack_P, model.noise)
    gain = Gain(ack_covariance, model.c, model.sensor_noise)
    if any_of(gamma):
        mean = where_vector(gamma, gain.correct(mean, y), mean)
        covariance = where_symmetric(gamma, gain.joseph(covariance), covariance)
    return mean, covariance, phi(ack_covariance, gain, gamma)


def _advance_held(
    model: Model, gamma: Mask, x: Vector, P: Matrix, ack_P: Matrix, mean: Vector, spread: Matrix, *rest: Any
) -> tuple[Any, ...]:
    """The same with an actuator that holds. rest: E[e δ'] by channel, rate, u, y."""
    n, q = model.n, model.q
    cross, (rate, u, y) = [scale(1.0 - rest[q], column) for column in rest[:q]], rest[q:]
    mean, spread = renewal(rate, u, mean, spread)

    def entry(i: int, j: int) -> Component:
        """Of the covariance of (e_{k−1}, δ_{k−1})."""
        return P[i][j] if j < n else cross[j - n][i] if i < n else spread[i - n][j - n]

    joint = predict(held(model).move, symmetric(n + q, entry), held(model).noise)
    x, P = add(constant_times(model.a, x), model.control_effect(mean)), [row[:n] for row in joint[:n]]
    cross = [[row[n + j] for row in joint[:n]] for j in range(q)]
    ack_covariance = predict(model.a, ack_P, model.noise)
    gain = Gain(ack_covariance, model.c, model.sensor_noise)
    if any_of(gamma):
        x = where_vector(gamma, gain.correct(x, y), x)
        P = where_symmetric(gamma, gain.joseph(P), P)
        cross = [where_vector(gamma, gain.propagate(column), column) for column in cross]
    return x, P, phi(ack_covariance, gain, gamma), mean, spread, *cross


@lru_cache(maxsize=16)
def _held_stepper(model: Model, lanes: int) -> Step:
    n, q = model.n, model.q
    own: tuple[Shape, ...] = (("vector", n), ("symmetric", n), ("symmetric", n))
    state = (*own, ("vector", q), ("symmetric", q), *(("vector", n),) * q)
    given: tuple[Shape, ...] = (("scalar", 1), ("vector", q), ("vector", model.p))
    return masked_step(partial(_advance_held, model), (*state, *given), state, lanes)


@lru_cache(maxsize=16)
def _stepper(model: Model, lanes: int) -> Step:
    state: tuple[Shape, ...] = (("vector", model.n), ("symmetric", model.n), ("symmetric", model.n))
    given: tuple[Shape, ...] = (("scalar", 1), ("vector", model.q), ("vector", model.p))
    return masked_step(partial(_advance, model), (*state, *given), state, lanes)
