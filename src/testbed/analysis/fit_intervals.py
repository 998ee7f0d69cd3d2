"""Confidence intervals of probabilities, at the level 95 %."""

from __future__ import annotations

import math
from typing import NamedTuple

from scipy.special import expit, logit, ndtri

from testbed.channel.loss import Chain

Z = float(ndtri(0.975))


class Interval(NamedTuple):
    """From low to high."""

    low: float
    high: float


def wilson(count: float, number: float) -> Interval:
    """For a probability of which ``count`` of ``number`` independent trials came true; all of 0 … 1 without trials.

    E. B. Wilson: Probable inference, the law of succession, and statistical inference. JASA 22 (1927) 209–212.
    """
    if number == 0:
        return Interval(0.0, 1.0)
    rate, weight = count / number, Z**2 / number
    centre = (rate + weight / 2.0) / (1.0 + weight)
    half = math.sqrt(weight * (rate * (1.0 - rate) + weight / 4.0)) / (1.0 + weight)
    return Interval(max(0.0, centre - half) if count > 0 else 0.0, min(1.0, centre + half) if count < number else 1.0)


def chain_loss(lost: int, number: int, chain: Chain) -> Interval:
    """For the stationary loss of a chain: Wilson's, of as many independent packets as tell as much.

    The variance of the loss rate of n packets is (2 − p − r)/(p + r) times that of independent ones, n → ∞, with the
    recovery p and the failure r.
    """
    moves = chain.recovery + chain.failure
    worth = number * moves / max(2.0 - moves, moves / number)
    return wilson(lost * worth / number, worth)


def around(value: float, deviation: float) -> Interval:
    """From the standard deviation of the logit of an estimate in (0, 1)."""
    middle = float(logit(value))
    return Interval(float(expit(middle - Z * deviation)), float(expit(middle + Z * deviation)))
