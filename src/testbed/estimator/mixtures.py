"""Mixtures of Gaussians on components: weights as logarithms, and two Gaussians merged by their moments.

A *score* is the logarithm of a weight up to a constant a lane. Scores are finite: what cannot happen has the score
IMPOSSIBLE, so that differences of scores are numbers too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from testbed.channel.law import Law
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

Scores = tuple[float, ...]
"""Of the states of a law; for a chain of arrivals of ν = 0 and of ν = 1."""


def start_scores(law: Law) -> Scores:
    """log P(h_0)."""
    return tuple(map(score_of, law.initial))


def transition_scores(law: Law) -> tuple[Scores, ...]:
    """log P(h_k | h_{k−1}), a row for each h_{k−1}."""
    return tuple(tuple(map(score_of, row)) for row in law.transition)


def share(a: Component, b: Component) -> tuple[Component, Component, Component]:
    """Weights of two scores, each to full relative accuracy and together 1, and the score of both."""
    top = larger(a, b)
    first, second = exp(a - top), exp(b - top)
    total = first + second
    return first / total, second / total, top + log(total)


def total(scores: Sequence[Component]) -> Component:
    """The score of all of them."""
    whole = scores[0]
    for score in scores[1:]:
        whole = share(whole, score)[2]
    return whole


def merged(
    weights: tuple[Component, Component], first: tuple[Vector, Matrix], second: tuple[Vector, Matrix]
) -> tuple[Vector, Matrix]:
    """The mean and the covariance of a mixture of two Gaussians."""
    (a, b), (x, p), (z, r) = weights, first, second
    away = subtract(z, x)
    within = symmetric(len(x), lambda i, j: a * p[i][j] + b * r[i][j])
    return add(x, scale(b, away)), add_outer(within, a * b, away)


Part = tuple[Vector, Matrix, Component]
"""Mean, covariance and score of one Gaussian of a mixture."""


def all_merged(parts: Sequence[Part]) -> Part:
    """One Gaussian with the moments of all, and the score of all."""
    x, p, score = parts[0]
    for z, r, other in parts[1:]:
        a, b, both = share(score, other)
        x, p = merged((a, b), (x, p), (z, r))
        score = both
    return x, p, score


def score_of(probability: float) -> float:
    """Its logarithm, finite."""
    return math.log(probability) if probability > 0.0 else IMPOSSIBLE
