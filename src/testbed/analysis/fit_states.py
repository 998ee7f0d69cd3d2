"""What the fates of a link tell of two hidden states behind them: the E step of Baum and Welch.

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


@dataclass(frozen=True, eq=False)
class Expected:
    """Given the fates: their log-likelihood, and expected counts.

    moves (kinds, 2, 2): how often, at a symbol, the first state was met and left for the second. For Gilbert–Elliott
    the symbols are the fates (0 lost), and state 0 is bad, 1 good. first (2,): probability of the first state.
    """

    log_likelihood: float
    moves: Floats
    first: Floats


class Blocks:
    """A row of symbols (n,), 0 … kinds − 1, cut into about √n blocks that are worked on side by side.

    With a matrix M_s (2, 2) for each symbol, P(all) = start M_{s_0} M_{s_1} … 1.
    """

    def __init__(self, symbols: NDArray[np.intp], kinds: int) -> None:
        length = max(1, math.isqrt(len(symbols)))
        blocks = -(-len(symbols) // length)
        padded = np.full(length * blocks, kinds, dtype=np.intp)
        padded[: len(symbols)] = symbols
        self._steps: NDArray[np.intp] = np.ascontiguousarray(padded.reshape(blocks, length).T)
        self._kinds = kinds

    def expected(self, start: Floats, matrices: Floats) -> Expected:
        """Forwards and backwards, scaled at each symbol. start (2,), matrices (kinds, 2, 2)."""
        steps = np.concatenate([matrices, np.eye(2)[None]])[self._steps]
        products = _products(steps)
        forward, log_likelihood = _forward(start, steps, products)
        backward = _backward(steps, products)
        moves = np.empty((self._kinds, 2, 2))
        for symbol in range(self._kinds):
            before, after = forward[self._steps == symbol], backward[self._steps == symbol]
            weight = np.einsum("ks,st,kt->k", before, matrices[symbol], after)
            moves[symbol] = matrices[symbol] * ((before / weight[:, None]).T @ after)
        first = start * (steps[0, 0] @ backward[0, 0])
        return Expected(log_likelihood, moves, first / first.sum())

    def log_likelihood(self, start: Floats, matrices: Floats) -> float:
        """log P(all)."""
        steps = np.concatenate([matrices, np.eye(2)[None]])[self._steps]
        return _forward(start, steps, _products(steps))[1]


class Fates:
    """The fates (n,), True where a packet arrived, as a Gilbert–Elliott channel gives them, stationary at the first."""

    def __init__(self, fates: Bools) -> None:
        self._blocks = Blocks(fates.astype(np.intp), 2)

    def expected(self, losses: GilbertElliott) -> Expected:
        """With M_f = diag(P(f | state)) · transition."""
        return self._blocks.expected(losses.stationary, _matrices(losses))

    def log_likelihood(self, losses: GilbertElliott) -> float:
        """log P(fates)."""
        return self._blocks.log_likelihood(losses.stationary, _matrices(losses))


def _matrices(losses: GilbertElliott) -> Floats:
    """M of a lost packet, and of one that arrived."""
    loss = losses.loss[:, None]
    return np.array([loss * losses.transition, (1.0 - loss) * losses.transition])


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
