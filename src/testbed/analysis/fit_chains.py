"""Maximum likelihood for losses whose state is seen: independent ones, and Markov chains of arrivals.

Every chain is stationary at the first packet, as the links of a scenario are. So the likelihoods of all models are of
the same fates, and a model within another is never more likely than it.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.special import xlogy

from testbed.channel.loss import Chain
from testbed.numerics.lanes import Bools, Floats


def fit_bernoulli(fates: Bools) -> Chain:
    """The share that arrived. fates: (n,), True where a packet arrived, both kinds among them."""
    return Chain.bernoulli(float(np.mean(fates)))


def fit_markov(fates: Bools) -> Chain:
    """The chain of largest likelihood; fates as above.

    Given the first fate, that is the shares of ``transitions``: there the search begins. It ends where the first fate
    counts too, a packet's weight away.
    """
    counts = transitions(fates).astype(np.float64)
    first = np.array([0.0, 1.0]) if fates[0] else np.array([1.0, 0.0])
    rates = closed_form(counts)
    for _ in range(200):
        last, rates = rates, stationary_rates(counts, first, sum(rates))
        if max(abs(a - b) for a, b in zip(rates, last, strict=True)) < 1e-15:
            break
    failure, recovery = rates
    return Chain.markov(recovery, failure)


def transitions(fates: Bools) -> np.ndarray:
    """(2, 2): how often a packet of fate b (0 lost, 1 arrived) followed one of fate a."""
    return np.bincount(2 * fates[:-1].astype(np.intp) + fates[1:], minlength=4).reshape(2, 2)


def closed_form(counts: Floats) -> tuple[float, float]:
    """(failure, recovery): the shares of the transitions. 0 where there are none to take them from."""
    lost, arrived = counts.sum(axis=1)
    return float(counts[1, 0] / arrived) if arrived else 0.0, float(counts[0, 1] / lost) if lost else 0.0


def stationary_rates(counts: Floats, first: Floats, moves: float) -> tuple[float, float]:
    """(to_bad, to_good) that make a lower bound of the log-likelihood of a stationary chain largest.

    counts: (2, 2), from a state (0 bad) to the next. first: (2,), weights of the first state. moves: to_bad + to_good
    before. The bound is the tangent there of −log(to_bad + to_good), of the stationary law, so it touches the
    log-likelihood and to climb one is to climb the other (D. R. Hunter, K. Lange: A tutorial on MM algorithms.
    Am. Stat. 58 (2004) 30–37).
    """
    return (
        _largest(counts[1, 0] + first[0], counts[1, 1], 1.0 / moves),
        _largest(counts[0, 1] + first[1], counts[0, 0], 1.0 / moves),
    )


def _largest(moved: float, stayed: float, slope: float) -> float:
    """Where moved · log x + stayed · log(1 − x) − slope · x is largest, 0 ≤ x ≤ 1."""
    half = moved + stayed + slope
    return min(1.0, float(2.0 * moved / (half + math.sqrt(max(0.0, half**2 - 4.0 * slope * moved)))))


def chain_log_likelihood(fates: Bools, chain: Chain) -> float:
    """log P(fates) for a chain; −∞ where they cannot happen."""
    matrix = np.array([[1.0 - chain.recovery, chain.recovery], [chain.failure, 1.0 - chain.failure]])
    first = chain.first_arrival if fates[0] else 1.0 - chain.first_arrival
    return float(xlogy(1.0, first) + xlogy(transitions(fates), matrix).sum())
