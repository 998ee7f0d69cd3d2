"""AOE: the approximate optimal estimator for unacknowledged Markov control losses (M Theorem 2, theory.md 3.4).

For i.i.d. control losses it is the same estimator as GPB1 and IMM.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.estimator.model import Ack, Estimate, Model, newest_ack
from testbed.estimator.riccati import Gain, log_odds, phi, predict
from testbed.numerics.lanes import (
    Component,
    Floats,
    Vector,
    add,
    add_outer,
    any_of,
    clip,
    constant_times,
    exp,
    mask_of,
    scale,
    subtract,
    vector_of,
    where,
    where_vector,
)


class Aoe:
    """One Gaussian and the posterior of the last ν; two hypotheses a step, merged by their moments."""

    def __init__(self, model: Model, lanes: int) -> None:
        self._model, self._lanes = model, lanes
        self._x, self._p = model.prior(lanes)
        self._delivered: Component | None = None  # posterior of ν_{k−1} = 1
        self._k = 0
        self.counters: dict[str, int] = {}

    def step(self, u: Floats, y: Floats, arrived: NDArray[Any], acks: tuple[Ack, ...] = ()) -> Estimate:
        """An ACK of ν_{k−1} decides between the hypotheses; older ones come too late and are counted."""
        model, gamma = self._model, mask_of(arrived)
        self._k += 1
        weight = self._prior_weight(acks)
        idle = constant_times(model.a, self._x)
        shift = model.control_effect(vector_of(u)) if model.q else [0.0] * model.n
        covariance = predict(model.a, self._p, model.noise)
        gain = Gain(covariance, model.c, model.sensor_noise)
        if any_of(gamma):
            innovation = subtract(vector_of(y), constant_times(model.c, idle))
            weight = where(gamma, _posterior(weight, log_odds(gain, shift, innovation)), weight)
            idle, shift = (
                where_vector(gamma, gain.correct(idle, vector_of(y)), idle),
                where_vector(gamma, gain.propagate(shift), shift),
            )
        self._delivered = weight
        self._x = add(idle, scale(weight, shift))
        self._p = self._merged(phi(covariance, gain, gamma), weight, shift)
        return Estimate(self._x, self._p, self._lanes)

    def _merged(self, common: list[Vector], weight: Component, shift: Vector) -> list[Vector]:
        """The covariance of two Gaussians with means ``shift`` apart: common + w (1 − w) shift shift'."""
        return add_outer(common, weight * (1.0 - weight), shift)

    def _prior_weight(self, acks: tuple[Ack, ...]) -> Component:
        """P(ν_{k−1} = 1) before y_k, with the ACK of it if one came."""
        chain, last = self._model.control, self._delivered
        if last is None:
            weight: Component = chain.start if self._lanes == 1 else np.full(self._lanes, chain.start)
        else:
            weight = chain.recovery * (1.0 - last) + (1.0 - chain.failure) * last
        ack = newest_ack(acks, self._k - 1, self.counters)
        return weight if ack is None else where(ack[0], ack[1], weight)


def _posterior(weight: Component, odds: Component) -> Component:
    """Bayes' rule for a weight and the log-likelihood ratio in favour of it."""
    ratio = exp(clip(odds, -700.0, 700.0))
    favoured = weight * ratio
    return favoured / (favoured + (1.0 - weight))
