"""Mixtures of Gaussians on components: weights as logarithms, and two Gaussians merged by their moments.

A *score* is the logarithm of a weight up to a constant a lane. Scores are finite: what cannot happen has the score
IMPOSSIBLE, so that differences of scores are numbers too.
"""

from __future__ import annotations

import math

from testbed.channel.loss import Chain
from testbed.numerics.lanes import (
    Component,
    Matrix,
    Vector,
    add,
    add_outer,
    exp,
    larger,
    log,
    scale,
    subtract,
    symmetric,
)

IMPOSSIBLE = -1e200

Scores = tuple[float, float]
"""Of ν = 0 and of ν = 1."""


def start_scores(chain: Chain) -> Scores:
    """log P(ν_0)."""
    return score_of(1.0 - chain.start), score_of(chain.start)


def transition_scores(chain: Chain) -> tuple[Scores, Scores]:
    """log P(ν_k | ν_{k−1}): the row of ν_{k−1} = 0 and that of ν_{k−1} = 1."""
    return (
        (score_of(1.0 - chain.recovery), score_of(chain.recovery)),
        (score_of(chain.failure), score_of(1.0 - chain.failure)),
    )


def share(a: Component, b: Component) -> tuple[Component, Component, Component]:
    """Weights of two scores, each to full relative accuracy and together 1, and the score of both."""
    top = larger(a, b)
    first, second = exp(a - top), exp(b - top)
    total = first + second
    return first / total, second / total, top + log(total)


def merged(
    weights: tuple[Component, Component], first: tuple[Vector, Matrix], second: tuple[Vector, Matrix]
) -> tuple[Vector, Matrix]:
    """The mean and the covariance of a mixture of two Gaussians."""
    (a, b), (x, p), (z, r) = weights, first, second
    away = subtract(z, x)
    within = symmetric(len(x), lambda i, j: a * p[i][j] + b * r[i][j])
    return add(x, scale(b, away)), add_outer(within, a * b, away)


def score_of(probability: float) -> float:
    """Its logarithm, finite."""
    return math.log(probability) if probability > 0.0 else IMPOSSIBLE
