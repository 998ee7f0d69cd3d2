"""GPB by its definition: hypotheses in a table by their last control bits, and the moments of those that agree.

Each hypothesis has a tuple of the bits that are told apart; there are no logarithms of weights and no pairs here.
"""

from __future__ import annotations

from itertools import groupby

import numpy as np
from scipy.stats import multivariate_normal

from estimator.reference.cases import Bools, Floats, System
from estimator.reference.gaussian import Estimate

_Part = tuple[tuple[int, ...], float, Floats, Floats]
"""Bits, oldest first; weight; mean; covariance."""


def gpb(
    system: System, order: int, u: Floats, y: Floats, arrived: Bools, known: list[dict[int, int]]
) -> list[Estimate]:
    """Estimates of steps 1 … K of one lane; known[k − 1]: {j: ν_j} of what is known at step k. order ≥ 1."""
    parts: list[_Part] = [((), 1.0, system.x0_mean, system.P0)]
    estimates = []
    for k in range(1, len(u) + 1):
        children: list[_Part] = []
        for bits, weight, mean, cov in parts:
            for nu in (0, 1):
                arrival = system.arrival(bits[-1] if bits else None)
                prior = weight * (arrival if nu else 1.0 - arrival)
                moved = system.A @ mean + nu * system.B @ u[k - 1]
                children.append(((*bits, nu), prior, moved, system.A @ cov @ system.A.T + system.Q))
        oldest = k - len(children[0][0])
        children = [
            child
            for child in children
            if all(known[k - 1].get(oldest + i, bit) == bit for i, bit in enumerate(child[0])) and child[1] > 0
        ]
        if arrived[k - 1]:
            children = [_observed(system, child, y[k - 1]) for child in children]
        total = sum(child[1] for child in children)
        children = [(bits, weight / total, mean, cov) for bits, weight, mean, cov in children]
        estimates.append(_moments(children)[1:])
        if len(children[0][0]) > order:
            children.sort(key=lambda child: child[0][1:])
            same = [list(group) for _, group in groupby(children, key=lambda child: child[0][1:])]
            children = [(group[0][0][1:], *_moments(group)) for group in same]
        parts = children
    return estimates


def _observed(system: System, part: _Part, y: Floats) -> _Part:
    bits, weight, mean, cov = part
    S = system.C @ cov @ system.C.T + system.R
    gain = cov @ system.C.T @ np.linalg.inv(S)
    likelihood = float(multivariate_normal(system.C @ mean, S).pdf(y))
    return bits, weight * likelihood, mean + gain @ (y - system.C @ mean), cov - gain @ S @ gain.T


def _moments(parts: list[_Part]) -> tuple[float, Floats, Floats]:
    total = sum(part[1] for part in parts)
    mean = np.sum([part[1] * part[2] for part in parts], axis=0) / total
    second = np.sum([part[1] * (part[3] + np.outer(part[2] - mean, part[2] - mean)) for part in parts], axis=0)
    return total, mean, second / total
