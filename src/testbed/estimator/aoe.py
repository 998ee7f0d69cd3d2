"""AOE: the approximate optimal estimator for unacknowledged Markov control losses (M Theorem 2, theory.md 3.4).

For i.i.d. control losses it is the same estimator as GPB1 and IMM.
"""

from __future__ import annotations

from functools import lru_cache, partial
from typing import Any, ClassVar

from numpy.typing import NDArray

from testbed.channel.law import law_of
from testbed.estimator.model import Ack, Estimate, Model, newest_ack
from testbed.estimator.riccati import Gain, log_odds, phi, predict
from testbed.estimator.state import Given, State, last_law, start_of, state_of
from testbed.numerics.lanes import (
    Component,
    Floats,
    Mask,
    Matrix,
    Vector,
    add,
    add_outer,
    any_of,
    clip,
    constant_times,
    exp,
    full,
    mask_of,
    scale,
    subtract,
    vector_of,
    where,
    where_vector,
)
from testbed.numerics.stepping import Step, masked_step
from testbed.numerics.symbols import Shape

_Weights = tuple[Component, Component]
"""Posterior of ν = 0 and of ν = 1, each kept to full relative accuracy."""


class Aoe:
    """One Gaussian and the posterior of the last ν; two hypotheses a step, merged by their moments."""

    STATE_VERSION: ClassVar[int] = 1

    def __init__(self, model: Model, lanes: int) -> None:
        self._model, self._lanes = model, lanes
        self._advance = _stepper(model, lanes)
        self._x, self._p = model.prior(lanes)
        self._posterior: _Weights | None = None  # of the last ν
        self._k = 0
        self.counters: dict[str, int] = {}

    def step(self, u: Floats, y: Floats, arrived: NDArray[Any], acks: tuple[Ack, ...] = ()) -> Estimate:
        """An ACK of ν_{k−1} decides between the hypotheses; older ones come too late and are counted."""
        gamma = mask_of(arrived)
        self._k += 1
        weights = self._prior_weights(acks)
        self._x, self._p, *posterior = self._advance(gamma, self._x, self._p, *weights, vector_of(u), vector_of(y))
        self._posterior = posterior[0], posterior[1]
        return Estimate(self._x, self._p, self._lanes)

    def state(self) -> State:
        """Without ``lost`` and ``delivered``, the posterior of the last ν, before the first step."""
        posterior = {} if self._posterior is None else dict(zip(("lost", "delivered"), self._posterior, strict=True))
        return state_of(self._k, self._lanes, {"x": self._x, "P": self._p, **posterior})

    def set_state(self, state: State) -> None:
        given = Given(state, self._lanes, self._model.n)
        x, p = given.vector("x"), given.matrix("P")
        posterior = (given.component("lost"), given.component("delivered")) if given.step else None
        given.end()
        self._k, self._x, self._p, self._posterior = given.step, x, p, posterior

    def start_from(self, step: int, x_hat: Floats, P: Floats) -> None:
        self._x, self._p = start_of(step, x_hat, P, self._lanes, self._model.n)
        self._k, self._posterior = step, None
        if step:
            lost, delivered = last_law(law_of(self._model.control), step)
            self._posterior = full(lost, self._lanes), full(delivered, self._lanes)

    def _prior_weights(self, acks: tuple[Ack, ...]) -> _Weights:
        """P(ν_{k−1} = 0) and P(ν_{k−1} = 1) before y_k, with the ACK of it if one came."""
        chain, last = self._model.control, self._posterior
        if last is None:
            weights = full(1.0 - chain.start, self._lanes), full(chain.start, self._lanes)
        else:
            weights = (
                (1.0 - chain.recovery) * last[0] + chain.failure * last[1],
                chain.recovery * last[0] + (1.0 - chain.failure) * last[1],
            )
        ack = newest_ack(acks, self._k - 1, self.counters)
        if ack is None:
            return weights
        return where(ack[0], 1.0 - ack[1], weights[0]), where(ack[0], ack[1], weights[1])


def _advance(
    model: Model, gamma: Mask, x: Vector, P: Matrix, lost: Component, delivered: Component, u: Vector, y: Vector
) -> tuple[Vector, Matrix, Component, Component]:
    """One step from x̂, P and the prior weights of ν = 0 and ν = 1 to x̂, P and the posterior ones."""
    idle = constant_times(model.a, x)
    shift = model.control_effect(u) if model.q else [0.0] * model.n
    covariance = predict(model.a, P, model.noise)
    gain = Gain(covariance, model.c, model.sensor_noise)
    if any_of(gamma):
        innovation = subtract(y, constant_times(model.c, idle))
        updated = _bayes((lost, delivered), log_odds(gain, shift, innovation))
        lost, delivered = where(gamma, updated[0], lost), where(gamma, updated[1], delivered)
        idle, shift = (
            where_vector(gamma, gain.correct(idle, y), idle),
            where_vector(gamma, gain.propagate(shift), shift),
        )
    merged = add_outer(phi(covariance, gain, gamma), lost * delivered, shift)
    return add(idle, scale(delivered, shift)), merged, lost, delivered


@lru_cache(maxsize=16)
def _stepper(model: Model, lanes: int) -> Step:
    state: tuple[Shape, ...] = (("vector", model.n), ("symmetric", model.n), ("scalar", 1), ("scalar", 1))
    return masked_step(partial(_advance, model), (*state, ("vector", model.q), ("vector", model.p)), state, lanes)


def _bayes(weights: _Weights, odds: Component) -> _Weights:
    """Bayes' rule for two hypotheses and the log-likelihood ratio in favour of the second.

    Both weights are kept, since one formed as 1 minus the other loses what is near zero.
    """
    favoured = weights[1] * exp(clip(odds, -700.0, 700.0))
    total = weights[0] + favoured
    return weights[0] / total, favoured / total
