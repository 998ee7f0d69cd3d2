"""Fates drawn straight from the definition of each loss model, for the tests of the fits."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from testbed.channel.gilbert_elliott import GilbertElliott
from testbed.channel.hidden import Hidden
from testbed.channel.loss import Chain

Bools = NDArray[np.bool_]


def bernoulli(number: int, loss: float, seed: int) -> Bools:
    return np.random.default_rng(seed).random(number) >= loss


def markov(number: int, chain: Chain, seed: int) -> Bools:
    out, arrival = [], chain.arrival
    for uniform in np.random.default_rng(seed).random(number):
        out.append(bool(uniform < arrival))
        arrival = 1.0 - chain.failure if out[-1] else chain.recovery
    return np.array(out)


def gilbert_elliott(number: int, losses: GilbertElliott, seed: int) -> Bools:
    good = markov(number, losses.states, seed)
    return np.random.default_rng([seed, 1]).random(number) >= np.where(good, losses.loss_good, losses.loss_bad)


def hidden(number: int, losses: Hidden, seed: int) -> Bools:
    """A packet meets a state, which decides over its fate; then the state moves."""
    points = np.random.default_rng(seed).random((number, 2))
    ends, state, out = losses.transition.cumsum(axis=1)[:, :-1], 0, []
    for k, (drop, move) in enumerate(points.tolist()):
        state = int((move >= (ends[state] if k else losses.initial.cumsum()[:-1])).sum())
        out.append(drop >= losses.loss[state])
    return np.array(out)


def probability(fates: tuple[bool, ...], losses: GilbertElliott) -> float:
    """P(fates): the sum over all paths of the hidden state, 1 = good."""
    return sum(weight for _, weight in paths(fates, losses))


def paths(fates: tuple[bool, ...], losses: GilbertElliott) -> list[tuple[tuple[int, ...], float]]:
    """Each path of the states, one packet longer than the fates, with the probability of both."""
    states, loss = losses.states, (losses.loss_bad, losses.loss_good)
    to_good = (states.recovery, 1.0 - states.failure)
    out = []
    for path in product((0, 1), repeat=len(fates) + 1):
        weight = states.arrival if path[0] else 1.0 - states.arrival
        for k, fate in enumerate(fates):
            weight *= 1.0 - loss[path[k]] if fate else loss[path[k]]
            weight *= to_good[path[k]] if path[k + 1] else 1.0 - to_good[path[k]]
        out.append((path, weight))
    return out
