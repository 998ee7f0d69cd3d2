"""IMM: the interacting multiple model estimator of Blom and Bar-Shalom, with the modes ν = 0 and ν = 1 (theory.md 3.5).

For i.i.d. control losses it is the same estimator as AOE and GPB1. For Gilbert–Elliott losses the modes are the hidden
state with ν, up to four.
"""

from __future__ import annotations

from functools import lru_cache, partial, reduce
from itertools import chain
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from testbed.estimator.hold import kept, of_state, prior_of, refuse_moments, renewed, size_of, with_input
from testbed.estimator.mixtures import (
    IMPOSSIBLE,
    Part,
    all_merged,
    score_of,
    share,
    start_scores,
    total,
    transition_scores,
)
from testbed.estimator.model import Ack, Estimate, Model, newest_ack
from testbed.estimator.riccati import Gain, phi, predict
from testbed.estimator.state import Given, State, last_law, start_of, state_of
from testbed.numerics.lanes import (
    Component,
    Floats,
    Mask,
    add,
    any_of,
    array_of,
    constant_times,
    full,
    full_vector,
    larger,
    mask_of,
    subtract,
    vector_of,
    where,
    where_vector,
)
from testbed.numerics.stepping import Step, masked_step
from testbed.numerics.symbols import Shape


class Imm:
    """A Gaussian for each state of the losses: mixed by their chain, one filter each, weighed by likelihood.

    With an actuator that holds, they are Gaussians of (x, a), a the input applied last (see ``hold``).
    """

    STATE_VERSION: ClassVar[int] = 1
    takes_hold: ClassVar[bool] = True

    def __init__(self, model: Model, lanes: int) -> None:
        self._model, self._lanes = model, lanes
        self._advance = _stepper(model, lanes)
        x, p = prior_of(model, lanes)
        states = len(model.law.arrived)
        self._modes = [part for h in range(states) for part in (x, p, full(IMPOSSIBLE if h else 0.0, lanes))]
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
        law = self._model.law
        rows = transition_scores(law) if self._k > 1 else (start_scores(law),) * len(law.arrived)
        given = (*chain.from_iterable(rows), *self._barred(acks), vector_of(u), vector_of(y))
        x, p, lost, delivered, *self._modes = self._advance(gamma, *self._modes, *given)
        self._delivered = lost, delivered
        if self._model.holds:
            x, p = of_state(self._model, x, p)
        return Estimate(x, p, self._lanes)

    def state(self) -> State:
        """x, P and the score of each mode, and the probabilities of ν = 0 and 1."""
        modes = range(len(self._model.law.arrived))
        names = (*(f"{name}{mode}" for mode in modes for name in ("x", "P", "score")), "lost", "delivered")
        return state_of(self._k, self._lanes, dict(zip(names, (*self._modes, *self._delivered), strict=True)))

    def set_state(self, state: State) -> None:
        given = Given(state, self._lanes, self._model.n)
        modes = []
        for mode in range(len(self._model.law.arrived)):
            x, p = given.vector(f"x{mode}", size_of(self._model)), given.matrix(f"P{mode}", size_of(self._model))
            modes += [x, p, given.component(f"score{mode}")]
        delivered = given.component("lost"), given.component("delivered")
        given.end()
        self._k, self._modes, self._delivered = given.step, modes, delivered

    def start_from(self, step: int, x_hat: Floats, P: Floats) -> None:
        law, lanes = self._model.law, self._lanes
        refuse_moments(self._model, step)
        x, p = start_of(step, x_hat, P, lanes, self._model.n)
        if self._model.holds:
            x, p = with_input(x, p, full_vector(np.zeros(self._model.q), lanes))
        weights = last_law(law, step).tolist() if step else [1.0, *[0.0] * (len(law.arrived) - 1)]
        self._modes = [part for weight in weights for part in (x, p, full(score_of(weight), lanes))]
        lost, delivered = (sum(weights[h] for h in law.states_of(fate)) if step else 0.0 for fate in (False, True))
        self._k, self._delivered = step, (full(lost, lanes), full(delivered, lanes))

    def _barred(self, acks: tuple[Ack, ...]) -> tuple[Component, Component]:
        """What is added to the scores of ν_{k−1} = 0 and 1: an ACK makes one of them impossible."""
        ack = newest_ack(acks, self._k - 1, self.counters)
        if ack is None:
            return 0.0, 0.0
        known, nu = ack
        return where(known, nu * IMPOSSIBLE, 0.0), where(known, (1.0 - nu) * IMPOSSIBLE, 0.0)


def _advance(model: Model, gamma: Mask, *given: Any) -> tuple[Any, ...]:
    """One step of all modes; x̂, P and the probabilities of ν = 0 and 1 come first in what it returns.

    given: x, P and score of each mode; the scores of the moves, a row for each mode; what bars ν = 0 and ν = 1; u; y.
    """
    fates = [int(fate) for fate in model.law.arrived]
    count = len(fates)
    modes: list[Part] = [(given[3 * h], given[3 * h + 1], given[3 * h + 2]) for h in range(count)]
    moves, (bar0, bar1, u, y) = given[3 * count : -4], given[-4:]
    after: list[Part] = []
    for h, nu in enumerate(fates):
        x, P, score = all_merged([(m, p, s + moves[i * count + h]) for i, (m, p, s) in enumerate(modes)])
        if model.holds:
            score = score + (bar1 if nu else bar0)
            mean, covariance, gained = renewed(model, gamma, x, P, u, y) if nu else kept(model, gamma, x, P, y)
            after.append((mean, covariance, score + gained))
            continue
        mean, covariance = constant_times(model.a, x), predict(model.a, P, model.noise)
        if nu and model.q:
            mean = add(mean, model.control_effect(u))
        score = score + (bar1 if nu else bar0)
        gain = Gain(covariance, model.c, model.sensor_noise)
        if any_of(gamma):
            innovation = subtract(y, constant_times(model.c, mean))
            score = where(gamma, score + gain.innovation.log_density(innovation), score)
            mean = where_vector(gamma, gain.correct(mean, y), mean)
        after.append((mean, phi(covariance, gain, gamma), score))
    x, P, _ = all_merged(after)
    of_fate = [[score for (_, _, score), nu in zip(after, fates, strict=True) if nu == v] for v in (0, 1)]
    lost, delivered, _ = share(total(of_fate[0]), total(of_fate[1]))
    top = reduce(larger, [score for _, _, score in after])
    levelled = [part for mean, covariance, score in after for part in (mean, covariance, score - top)]
    return x, P, lost, delivered, *levelled


@lru_cache(maxsize=16)
def _stepper(model: Model, lanes: int) -> Step:
    mean: Shape = ("vector", size_of(model))
    covariance: Shape = ("symmetric", size_of(model))
    number: Shape = ("scalar", 1)
    states = len(model.law.arrived)
    modes = (mean, covariance, number) * states
    given: tuple[Shape, ...] = (*(number,) * (states * states + 2), ("vector", model.q), ("vector", model.p))
    results = (mean, covariance, number, number, *modes)
    return masked_step(partial(_advance, model), (*modes, *given), results, lanes)
