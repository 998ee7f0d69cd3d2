"""AOE: the approximate optimal estimator for unacknowledged Markov control losses (M Theorem 2, theory.md 3.4).

For i.i.d. control losses it is the same estimator as GPB1 and IMM.
"""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from testbed.estimator.model import Ack, Estimate, Model, newest_ack
from testbed.estimator.riccati import Gain, log_odds, phi, predict
from testbed.numerics.lanes import (
    Component,
    Floats,
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

_Weights = tuple[Component, Component]
"""Posterior of ν = 0 and of ν = 1, each kept to full relative accuracy."""


class Aoe:
    """One Gaussian and the posterior of the last ν; two hypotheses a step, merged by their moments."""

    def __init__(self, model: Model, lanes: int) -> None:
        self._model, self._lanes = model, lanes
        self._x, self._p = model.prior(lanes)
        self._posterior: _Weights | None = None  # of the last ν
        self._k = 0
        self.counters: dict[str, int] = {}

    def step(self, u: Floats, y: Floats, arrived: NDArray[Any], acks: tuple[Ack, ...] = ()) -> Estimate:
        """An ACK of ν_{k−1} decides between the hypotheses; older ones come too late and are counted."""
        model, gamma = self._model, mask_of(arrived)
        self._k += 1
        weights = self._prior_weights(acks)
        idle = constant_times(model.a, self._x)
        shift = model.control_effect(vector_of(u)) if model.q else [0.0] * model.n
        covariance = predict(model.a, self._p, model.noise)
        gain = Gain(covariance, model.c, model.sensor_noise)
        if any_of(gamma):
            innovation = subtract(vector_of(y), constant_times(model.c, idle))
            updated = _bayes(weights, log_odds(gain, shift, innovation))
            weights = where(gamma, updated[0], weights[0]), where(gamma, updated[1], weights[1])
            idle, shift = (
                where_vector(gamma, gain.correct(idle, vector_of(y)), idle),
                where_vector(gamma, gain.propagate(shift), shift),
            )
        self._posterior = weights
        self._x = add(idle, scale(weights[1], shift))
        self._p = add_outer(phi(covariance, gain, gamma), weights[0] * weights[1], shift)
        return Estimate(self._x, self._p, self._lanes)

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


def _bayes(weights: _Weights, odds: Component) -> _Weights:
    """Bayes' rule for two hypotheses and the log-likelihood ratio in favour of the second.

    Both weights are kept, since one formed as 1 minus the other loses what is near zero.
    """
    favoured = weights[1] * exp(clip(odds, -700.0, 700.0))
    total = weights[0] + favoured
    return weights[0] / total, favoured / total
