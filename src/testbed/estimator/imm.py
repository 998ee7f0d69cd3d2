"""IMM: the interacting multiple model estimator of Blom and Bar-Shalom, with the modes ν = 0 and ν = 1 (theory.md 3.5).

For i.i.d. control losses it is the same estimator as AOE and GPB1.
"""

from __future__ import annotations

from functools import lru_cache, partial
from typing import Any, ClassVar

from numpy.typing import NDArray

from testbed.channel.law import law_of
from testbed.estimator.mixtures import IMPOSSIBLE, merged, score_of, share, start_scores, transition_scores
from testbed.estimator.model import Ack, Estimate, Model, newest_ack
from testbed.estimator.riccati import Gain, phi, predict
from testbed.estimator.state import Given, State, last_law, start_of, state_of
from testbed.numerics.lanes import (
    Component,
    Floats,
    Mask,
    Matrix,
    Vector,
    add,
    any_of,
    array_of,
    constant_times,
    full,
    larger,
    mask_of,
    subtract,
    vector_of,
    where,
    where_vector,
)
from testbed.numerics.stepping import Step, masked_step
from testbed.numerics.symbols import Shape

_SURE = (0.0, IMPOSSIBLE)


class Imm:
    """Two Gaussians with the posterior of the last ν: mixed by the chain, one filter each, weighed by likelihood."""

    STATE_VERSION: ClassVar[int] = 1

    def __init__(self, model: Model, lanes: int) -> None:
        self._model, self._lanes = model, lanes
        self._advance = _stepper(model, lanes)
        x, p = model.prior(lanes)
        self._modes = [x, p, full(_SURE[0], lanes), x, p, full(_SURE[1], lanes)]
        self._delivered: tuple[Component, Component] = (full(0.0, lanes), full(0.0, lanes))
        self._k = 0
        self.counters: dict[str, int] = {}

    @property
    def mode_probabilities(self) -> Floats:
        """P(ν_{k−1} = 0) and P(ν_{k−1} = 1) after step k, (M, 2)."""
        return array_of(list(self._delivered), self._lanes)

    def step(self, u: Floats, y: Floats, arrived: NDArray[Any], acks: tuple[Ack, ...] = ()) -> Estimate:
        """An ACK of ν_{k−1} decides between the modes; older ones come too late and are counted."""
        gamma = mask_of(arrived)
        self._k += 1
        chain = self._model.control
        rows = transition_scores(chain) if self._k > 1 else (start_scores(chain),) * 2
        given = (*rows[0], *rows[1], *self._barred(acks), vector_of(u), vector_of(y))
        x, p, lost, delivered, *self._modes = self._advance(gamma, *self._modes, *given)
        self._delivered = lost, delivered
        return Estimate(x, p, self._lanes)

    def state(self) -> State:
        """x, P and the score of each mode, and their probabilities."""
        names = (*(f"{name}{mode}" for mode in (0, 1) for name in ("x", "P", "score")), "lost", "delivered")
        return state_of(self._k, self._lanes, dict(zip(names, (*self._modes, *self._delivered), strict=True)))

    def set_state(self, state: State) -> None:
        given = Given(state, self._lanes, self._model.n)
        modes = []
        for mode in (0, 1):
            modes += [given.vector(f"x{mode}"), given.matrix(f"P{mode}"), given.component(f"score{mode}")]
        delivered = given.component("lost"), given.component("delivered")
        given.end()
        self._k, self._modes, self._delivered = given.step, modes, delivered

    def start_from(self, step: int, x_hat: Floats, P: Floats) -> None:
        x, p = start_of(step, x_hat, P, self._lanes, self._model.n)
        lost, delivered = last_law(law_of(self._model.control), step) if step else (0.0, 0.0)
        scores = [score_of(lost), score_of(delivered)] if step else list(_SURE)
        self._modes = [x, p, full(scores[0], self._lanes), x, p, full(scores[1], self._lanes)]
        self._k, self._delivered = step, (full(lost, self._lanes), full(delivered, self._lanes))

    def _barred(self, acks: tuple[Ack, ...]) -> tuple[Component, Component]:
        """What is added to the scores of ν_{k−1} = 0 and 1: an ACK makes one of them impossible."""
        ack = newest_ack(acks, self._k - 1, self.counters)
        if ack is None:
            return 0.0, 0.0
        known, nu = ack
        return where(known, nu * IMPOSSIBLE, 0.0), where(known, (1.0 - nu) * IMPOSSIBLE, 0.0)


def _advance(
    model: Model,
    gamma: Mask,
    x0: Vector,
    P0: Matrix,
    score0: Component,
    x1: Vector,
    P1: Matrix,
    score1: Component,
    stay_lost: Component,
    recover: Component,
    fail: Component,
    stay_delivered: Component,
    bar0: Component,
    bar1: Component,
    u: Vector,
    y: Vector,
) -> tuple[Any, ...]:
    """One step of both modes; x̂, P and the mode probabilities come first in what it returns."""
    modes: list[tuple[Vector, Matrix, Component]] = []
    for nu, rows, bar in ((0, (stay_lost, fail), bar0), (1, (recover, stay_delivered), bar1)):
        *weights, score = share(score0 + rows[0], score1 + rows[1])
        x, P = merged((weights[0], weights[1]), (x0, P0), (x1, P1))
        mean, covariance = constant_times(model.a, x), predict(model.a, P, model.noise)
        if nu and model.q:
            mean = add(mean, model.control_effect(u))
        score = score + bar
        gain = Gain(covariance, model.c, model.sensor_noise)
        if any_of(gamma):
            innovation = subtract(y, constant_times(model.c, mean))
            score = where(gamma, score + gain.innovation.log_density(innovation), score)
            mean = where_vector(gamma, gain.correct(mean, y), mean)
        modes.append((mean, phi(covariance, gain, gamma), score))
    (x0, P0, score0), (x1, P1, score1) = modes
    top = larger(score0, score1)
    lost, delivered, _ = share(score0, score1)
    out = merged((lost, delivered), (x0, P0), (x1, P1))
    return (*out, lost, delivered, x0, P0, score0 - top, x1, P1, score1 - top)


@lru_cache(maxsize=16)
def _stepper(model: Model, lanes: int) -> Step:
    mean: Shape = ("vector", model.n)
    covariance: Shape = ("symmetric", model.n)
    number: Shape = ("scalar", 1)
    modes = (mean, covariance, number) * 2
    given: tuple[Shape, ...] = (*(number,) * 6, ("vector", model.q), ("vector", model.p))
    results = (mean, covariance, number, number, *modes)
    return masked_step(partial(_advance, model), (*modes, *given), results, lanes)
