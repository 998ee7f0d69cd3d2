"""AOE: the approximate optimal estimator for unacknowledged Markov control losses (M Theorem 2, theory.md 3.4).

For i.i.d. control losses it is the same estimator as GPB1 and IMM. For Gilbert–Elliott losses the posterior is that of
the hidden state; there are still two hypotheses a step, since only ν moves the plant.
"""

from __future__ import annotations

from functools import lru_cache, partial
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from testbed.estimator.hold import kept, of_state, prior_of, refuse_moments, renewed, size_of, with_input
from testbed.estimator.mixtures import merged
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
    full_vector,
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
"""Of ν = 0 and of ν = 1, each kept to full relative accuracy."""


class Aoe:
    """One Gaussian and the posterior of the last state of the losses; two hypotheses a step, merged by moments.

    With an actuator that holds, it is a Gaussian of (x, a), a the input applied last (see ``hold``).
    """

    STATE_VERSION: ClassVar[int] = 1
    takes_hold: ClassVar[bool] = True

    def __init__(self, model: Model, lanes: int) -> None:
        self._model, self._lanes = model, lanes
        self._advance = (_held_stepper if model.holds else _stepper)(model, lanes)
        self._x, self._p = prior_of(model, lanes)
        self._moves: list[list[float]] = model.law.transition.T.tolist()
        self._visible = model.law.visible
        self._among = model.law.states_of(False), model.law.states_of(True)
        self._states: list[Component] | None = None  # posterior of the last state of the losses
        self._k = 0
        self.counters: dict[str, int] = {}

    def step(self, u: Floats, y: Floats, arrived: NDArray[Any], acks: tuple[Ack, ...] = ()) -> Estimate:
        """An ACK of ν_{k−1} decides between the hypotheses; older ones come too late and are counted."""
        gamma = mask_of(arrived)
        self._k += 1
        states = self._prior()
        weights = self._by_fate(states)
        known = self._decided(weights, acks)
        self._x, self._p, *posterior = self._advance(gamma, self._x, self._p, *known, vector_of(u), vector_of(y))
        self._states = self._shared(states, weights, (posterior[0], posterior[1]))
        if self._model.holds:
            return Estimate(*of_state(self._model, self._x, self._p), self._lanes)
        return Estimate(self._x, self._p, self._lanes)

    def state(self) -> State:
        """``state0``, ``state1``, …: the posterior of the last state of the losses, from the first step on."""
        known = {} if self._states is None else {f"state{h}": weight for h, weight in enumerate(self._states)}
        return state_of(self._k, self._lanes, {"x": self._x, "P": self._p, **known})

    def set_state(self, state: State) -> None:
        given = Given(state, self._lanes, self._model.n)
        x, p = given.vector("x", size_of(self._model)), given.matrix("P", size_of(self._model))
        states = [given.component(f"state{h}") for h in range(len(self._model.law.arrived))] if given.step else None
        given.end()
        self._k, self._x, self._p, self._states = given.step, x, p, states

    def start_from(self, step: int, x_hat: Floats, P: Floats) -> None:
        refuse_moments(self._model, step)
        self._x, self._p = start_of(step, x_hat, P, self._lanes, self._model.n)
        if self._model.holds:
            self._x, self._p = with_input(self._x, self._p, full_vector(np.zeros(self._model.q), self._lanes))
        self._k, self._states = step, None
        if step:
            self._states = [full(float(weight), self._lanes) for weight in last_law(self._model.law, step)]

    def _prior(self) -> list[Component]:
        """P(state of packet k − 1), given what came before."""
        last = self._states
        if last is None:
            return [full(float(start), self._lanes) for start in self._model.law.initial]
        if self._visible:
            return [column[0] * last[0] + column[1] * last[1] for column in self._moves]
        return [_sum([move * weight for move, weight in zip(column, last, strict=True)]) for column in self._moves]

    def _by_fate(self, states: list[Component]) -> _Weights:
        if self._visible:
            return states[0], states[1]
        lost, delivered = self._among
        return _sum([states[h] for h in lost]), _sum([states[h] for h in delivered])

    def _decided(self, weights: _Weights, acks: tuple[Ack, ...]) -> _Weights:
        """P(ν_{k−1} = 0) and P(ν_{k−1} = 1) before y_k, with the ACK of it if one came."""
        ack = newest_ack(acks, self._k - 1, self.counters)
        if ack is None:
            return weights
        return where(ack[0], 1.0 - ack[1], weights[0]), where(ack[0], ack[1], weights[1])

    def _shared(self, states: list[Component], before: _Weights, after: _Weights) -> list[Component]:
        """The posterior of ν shared out among the states of each fate, of which y_k and the ACK say nothing.

        A fate of several states has ``before`` > 0, since each of the channel's states can give it.
        """
        if self._visible:
            return list(after)
        shared = list(states)
        for among, had, has in zip(self._among, before, after, strict=True):
            for h in among:
                shared[h] = has if len(among) == 1 else states[h] * (has / had)
        return shared


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


def _advance_held(
    model: Model, gamma: Mask, z: Vector, P: Matrix, lost: Component, delivered: Component, u: Vector, y: Vector
) -> tuple[Vector, Matrix, Component, Component]:
    """The same for (x, a) of an actuator that holds."""
    (idle, first, score), (moved, second, other) = kept(model, gamma, z, P, y), renewed(model, gamma, z, P, u, y)
    if any_of(gamma):
        updated = _bayes((lost, delivered), other - score)
        lost, delivered = where(gamma, updated[0], lost), where(gamma, updated[1], delivered)
    mean, covariance = merged((lost, delivered), (idle, first), (moved, second))
    return mean, covariance, lost, delivered


@lru_cache(maxsize=16)
def _held_stepper(model: Model, lanes: int) -> Step:
    size = size_of(model)
    state: tuple[Shape, ...] = (("vector", size), ("symmetric", size), ("scalar", 1), ("scalar", 1))
    return masked_step(partial(_advance_held, model), (*state, ("vector", model.q), ("vector", model.p)), state, lanes)


@lru_cache(maxsize=16)
def _stepper(model: Model, lanes: int) -> Step:
    state: tuple[Shape, ...] = (("vector", model.n), ("symmetric", model.n), ("scalar", 1), ("scalar", 1))
    return masked_step(partial(_advance, model), (*state, ("vector", model.q), ("vector", model.p)), state, lanes)


def _sum(terms: list[Component]) -> Component:
    whole = terms[0]
    for term in terms[1:]:
        whole = whole + term
    return whole


def _bayes(weights: _Weights, odds: Component) -> _Weights:
    """Bayes' rule for two hypotheses and the log-likelihood ratio in favour of the second.

    Both weights are kept, since one formed as 1 minus the other loses what is near zero.
    """
    favoured = weights[1] * exp(clip(odds, -700.0, 700.0))
    total = weights[0] + favoured
    return weights[0] / total, favoured / total
