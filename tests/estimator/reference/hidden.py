"""GPB and IMM under control losses with a hidden state by their definitions: tables of parts, weights as numbers.

A weight has an entry for each state of the channel, joint with that being the one that the next packet meets.
"""

from __future__ import annotations

from itertools import groupby

import numpy as np
from scipy.stats import multivariate_normal

from estimator.reference.cases import Bools, Channel, Floats, FourStates, System
from estimator.reference.gaussian import Estimate

_Part = tuple[tuple[int, ...], Floats, Floats, Floats]
"""Bits, oldest first; weights (S,); mean; covariance."""


def gpb(
    system: System, order: int, u: Floats, y: Floats, arrived: Bools, known: list[dict[int, int]]
) -> list[Estimate]:
    """Estimates of steps 1 … K of one lane; known[k − 1]: {j: ν_j} of what is known at step k. Order 0 is AOE."""
    channel = system.channel
    assert channel is not None
    parts: list[_Part] = [((), np.array([channel.start(s) for s in channel.states]), system.x0_mean, system.P0)]
    estimates = []
    for k in range(1, len(u) + 1):
        children: list[_Part] = []
        for bits, weights, mean, cov in parts:
            for nu in (0, 1):
                moved = system.A @ mean + nu * system.B @ u[k - 1]
                ahead = _after(channel, weights, nu)
                children.append(((*bits, nu), ahead, moved, system.A @ cov @ system.A.T + system.Q))
        oldest = k - len(children[0][0])
        children = [
            child
            for child in children
            if all(known[k - 1].get(oldest + i, bit) == bit for i, bit in enumerate(child[0])) and child[1].sum() > 0
        ]
        if arrived[k - 1]:
            children = [_observed(system, child, y[k - 1]) for child in children]
        total = sum(child[1].sum() for child in children)
        children = [(bits, weights / total, mean, cov) for bits, weights, mean, cov in children]
        estimates.append(_moments(children)[1:])
        if len(children[0][0]) > order:
            children.sort(key=lambda child: child[0][1:])
            same = [list(group) for _, group in groupby(children, key=lambda child: child[0][1:])]
            children = [(group[0][0][1:], *_moments(group)) for group in same]
        parts = children
    return estimates


def imm(system: System, u: Floats, y: Floats, arrived: Bools, known: dict[int, int]) -> list[Estimate]:
    """The textbook's four steps with the modes (state, ν); known: {j: ν_j} of the packets known in time."""
    channel = system.channel
    assert channel is not None
    modes = [(s, nu) for s in channel.states for nu in (0, 1)]
    count = len(modes)
    prior = np.array([channel.start(s) * channel.fate(s, nu) for s, nu in modes])
    moves = np.array([[channel.move(s, to) * channel.fate(to, nu) for to, nu in modes] for s, _ in modes])
    weights, means, covs = None, np.array([system.x0_mean] * count), np.array([system.P0] * count)
    estimates = []
    for k in range(1, len(u) + 1):
        joint = np.outer(np.full(count, 1.0 / count), prior) if weights is None else weights[:, None] * moves
        weights = joint.sum(axis=0)
        share = joint / np.where(weights > 0.0, weights, 1.0)
        mixed = [_mixture(share[:, j], means, covs) for j in range(count)]
        for j, (_, nu) in enumerate(modes):
            mean, cov = mixed[j]
            mean, cov = system.A @ mean + nu * system.B @ u[k - 1], system.A @ cov @ system.A.T + system.Q
            if known.get(k - 1, nu) != nu:
                weights[j] = 0.0
            if arrived[k - 1]:
                _, pair, mean, cov = _observed(system, ((), np.array([weights[j], 0.0]), mean, cov), y[k - 1])
                weights[j] = pair[0]
            means[j], covs[j] = mean, cov
        weights = weights / weights.sum()
        estimates.append(_mixture(weights, means, covs))
    return estimates


def _after(channel: Channel | FourStates, weights: Floats, nu: int) -> Floats:
    """Joint with ν and with the state of the packet after."""
    met = [weights[s] * channel.fate(s, nu) for s in channel.states]
    return np.array([sum(met[s] * channel.move(s, to) for s in channel.states) for to in channel.states])


def _observed(system: System, part: _Part, y: Floats) -> _Part:
    bits, weights, mean, cov = part
    S = system.C @ cov @ system.C.T + system.R
    gain = cov @ system.C.T @ np.linalg.inv(S)
    likelihood = float(multivariate_normal(system.C @ mean, S).pdf(y))
    return bits, weights * likelihood, mean + gain @ (y - system.C @ mean), cov - gain @ S @ gain.T


def _mixture(weights: Floats, means: Floats, covs: Floats) -> Estimate:
    mean = weights @ means
    away = means - mean
    return mean, np.einsum("i,ijk->jk", weights, covs + away[:, :, None] * away[:, None, :])


def _moments(parts: list[_Part]) -> tuple[Floats, Floats, Floats]:
    each = np.array([part[1].sum() for part in parts])
    whole = np.sum([part[1] for part in parts], axis=0)
    means, covs = np.array([part[2] for part in parts]), np.array([part[3] for part in parts])
    return whole, *_mixture(each / each.sum(), means, covs)
