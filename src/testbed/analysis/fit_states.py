"""What the fates of a link tell of the hidden states of a Gilbert–Elliott channel: the E step of Baum and Welch.

L. E. Baum, T. Petrie, G. Soules, N. Weiss: A maximization technique occurring in the statistical analysis of
probabilistic functions of Markov chains. Ann. Math. Statist. 41 (1970) 164–171.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from testbed.channel.gilbert_elliott import GilbertElliott
from testbed.numerics.lanes import Bools, Floats

_LOST, _ARRIVED, _PADDING = 0, 1, 2


@dataclass(frozen=True, eq=False)
class Expected:
    """Given the fates: their log-likelihood, and expected counts. State 0 is bad, 1 good.

    moves (2, 2, 2): packets of a fate (0 lost) that met the first state and left it for the second.
    first (2,): probability of the state that the first packet met.
    """

    log_likelihood: float
    moves: Floats
    first: Floats


class Fates:
    """The fates (n,), True where a packet arrived, cut into about √n blocks that are worked on side by side."""

    def __init__(self, fates: Bools) -> None:
        length = max(1, math.isqrt(len(fates)))
        blocks = -(-len(fates) // length)
        padded = np.full(length * blocks, _PADDING, dtype=np.intp)
        padded[: len(fates)] = fates
        self._steps: NDArray[np.intp] = np.ascontiguousarray(padded.reshape(blocks, length).T)

    def expected(self, losses: GilbertElliott) -> Expected:
        """Forwards and backwards, scaled at each packet. The channel is stationary at the first one.

        With M_f = diag(P(f | state)) · transition, the likelihood is π M_{f_0} M_{f_1} … 1.
        """
        start, matrices = _start(losses), _matrices(losses)
        steps = matrices[self._steps]
        products = _products(steps)
        forward, log_likelihood = _forward(start, steps, products)
        backward = _backward(steps, products)
        moves = np.empty((2, 2, 2))
        for fate in (_LOST, _ARRIVED):
            before, after = forward[self._steps == fate], backward[self._steps == fate]
            weight = np.einsum("ks,st,kt->k", before, matrices[fate], after)
            moves[fate] = matrices[fate] * ((before / weight[:, None]).T @ after)
        first = start * (steps[0, 0] @ backward[0, 0])
        return Expected(log_likelihood, moves, first / first.sum())

    def log_likelihood(self, losses: GilbertElliott) -> float:
        """log P(fates)."""
        steps = _matrices(losses)[self._steps]
        return _forward(_start(losses), steps, _products(steps))[1]


def _start(losses: GilbertElliott) -> Floats:
    """The stationary law of the states."""
    good = losses.states.arrival
    return np.array([1.0 - good, good])


def _matrices(losses: GilbertElliott) -> Floats:
    """M of a lost packet, of one that arrived, and of none."""
    states = losses.states
    move = np.array([[1.0 - states.recovery, states.recovery], [states.failure, 1.0 - states.failure]])
    loss = np.array([losses.loss_bad, losses.loss_good])[:, None]
    return np.array([loss * move, (1.0 - loss) * move, np.eye(2)])


def _products(steps: Floats) -> Floats:
    """The product of the matrices of each block, up to a factor. steps: (length, blocks, 2, 2)."""
    product = np.tile(np.eye(2), (steps.shape[1], 1, 1))
    for m in steps:
        product = product[:, :, :1] * m[:, :1] + product[:, :, 1:] * m[:, 1:]
        product /= product.sum(axis=(1, 2))[:, None, None]
    return product


def _forward(start: Floats, steps: Floats, products: Floats) -> tuple[Floats, float]:
    """P(state of packet k | the fates before it), (length, blocks, 2), and the log-likelihood."""
    state = np.empty((steps.shape[1], 2))
    for block, product in enumerate(products):
        state[block] = start
        start = start @ product
        start = start / start.sum()
    out, scales = np.empty(steps.shape[:3]), np.empty(steps.shape[:2])
    for j, m in enumerate(steps):
        out[j] = state
        state = state[:, :1] * m[:, 0] + state[:, 1:] * m[:, 1]
        scales[j] = state[:, 0] + state[:, 1]
        state /= scales[j][:, None]
    return out, float(np.log(scales).sum())


def _backward(steps: Floats, products: Floats) -> Floats:
    """Proportional to P(the fates after packet k | the state after it), (length, blocks, 2)."""
    state, end = np.empty((steps.shape[1], 2)), np.ones(2)
    for block in reversed(range(len(products))):
        state[block] = end
        end = products[block] @ end
        end = end / end.sum()
    out = np.empty(steps.shape[:3])
    for j in reversed(range(len(steps))):
        out[j] = state
        m = steps[j]
        state = m[:, :, 0] * state[:, :1] + m[:, :, 1] * state[:, 1:]
        state /= (state[:, 0] + state[:, 1])[:, None]
    return out
