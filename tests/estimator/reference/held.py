"""GPB and IMM with an actuator that holds, by their definitions: a linear system of (x, a) that jumps with ν.

(x, a)⁺ = F_ν (x, a) + g_ν + (w, 0) and y = [C 0] (x, a) + v; weights are numbers, for chains of ν alone.
"""

from __future__ import annotations

from itertools import groupby

import numpy as np
from scipy.linalg import block_diag
from scipy.stats import multivariate_normal

from estimator.reference.cases import Bools, Floats, System
from estimator.reference.gaussian import Estimate

_Part = tuple[tuple[int, ...], float, Floats, Floats]
"""Bits, oldest first; weight; mean and covariance of (x, a)."""


class Jumps:
    """The matrices of the jump linear system."""

    def __init__(self, system: System) -> None:
        n, q = system.n, system.q
        eye, none = np.eye(q), np.zeros((q, q))
        self.F = [
            np.block([[system.A, system.B], [np.zeros((q, n)), eye]]),
            np.block([[system.A, np.zeros((n, q))], [np.zeros((q, n)), none]]),
        ]
        self.entry = np.vstack([system.B, eye])
        self.Q = np.asarray(block_diag(system.Q, none))
        self.C = np.hstack([system.C, np.zeros((system.p, q))])
        self.R, self.n = system.R, n
        self.mean, self.cov = np.concatenate([system.x0_mean, np.zeros(q)]), np.asarray(block_diag(system.P0, none))

    def moved(self, nu: int, mean: Floats, cov: Floats, u: Floats) -> tuple[Floats, Floats]:
        F = self.F[nu]
        return F @ mean + nu * self.entry @ u, F @ cov @ F.T + self.Q

    def observed(self, weight: float, mean: Floats, cov: Floats, y: Floats) -> tuple[float, Floats, Floats]:
        S = self.C @ cov @ self.C.T + self.R
        gain = cov @ self.C.T @ np.linalg.inv(S)
        likelihood = float(multivariate_normal(self.C @ mean, S).pdf(y))
        return weight * likelihood, mean + gain @ (y - self.C @ mean), cov - gain @ S @ gain.T

    def of_state(self, mean: Floats, cov: Floats) -> Estimate:
        return mean[: self.n], cov[: self.n, : self.n]


def gpb(
    system: System, order: int, u: Floats, y: Floats, arrived: Bools, known: list[dict[int, int]]
) -> list[Estimate]:
    """Estimates of steps 1 … K of one lane; known[k − 1]: {j: ν_j} of what is known at step k. Order 0 is AOE."""
    jumps = Jumps(system)
    parts: list[tuple[_Part, float]] = [(((), 1.0, jumps.mean, jumps.cov), system.start)]
    estimates = []
    for k in range(1, len(u) + 1):
        children: list[_Part] = []
        for (bits, weight, mean, cov), arrival in parts:
            for nu in (0, 1):
                moved = jumps.moved(nu, mean, cov, u[k - 1])
                children.append(((*bits, nu), weight * (arrival if nu else 1.0 - arrival), *moved))
        oldest = k - len(children[0][0])
        children = [
            child
            for child in children
            if all(known[k - 1].get(oldest + i, bit) == bit for i, bit in enumerate(child[0])) and child[1] > 0
        ]
        if arrived[k - 1]:
            children = [(bits, *jumps.observed(weight, m, c, y[k - 1])) for bits, weight, m, c in children]
        total = sum(child[1] for child in children)
        children = [(bits, weight / total, mean, cov) for bits, weight, mean, cov in children]
        estimates.append(jumps.of_state(*_moments(children)[1:]))
        parts = [(child, system.arrival(child[0][-1])) for child in children]
        if len(children[0][0]) > order:
            children.sort(key=lambda child: child[0][1:])
            same = [list(group) for _, group in groupby(children, key=lambda child: child[0][1:])]
            parts = [((group[0][0][1:], *_moments(group)), _next_arrival(system, group)) for group in same]
    return estimates


def _next_arrival(system: System, group: list[_Part]) -> float:
    """P(next ν = 1) of a group, which may hold both values of the newest bit."""
    weights = np.array([part[1] for part in group])
    return float(weights @ [system.arrival(part[0][-1]) for part in group] / weights.sum())


def imm(system: System, u: Floats, y: Floats, arrived: Bools, known: dict[int, int]) -> list[Estimate]:
    """The textbook's four steps with the modes ν = 0 and 1; known: {j: ν_j} of the packets known in time."""
    jumps = Jumps(system)
    moves = np.array([[1.0 - system.arrival(last), system.arrival(last)] for last in (0, 1)])
    weights, parts = np.zeros(2), [(jumps.mean, jumps.cov)] * 2
    estimates = []
    for k in range(1, len(u) + 1):
        joint = weights[:, None] * moves if k > 1 else 0.5 * np.array([[1.0 - system.start, system.start]] * 2)
        weights, after = joint.sum(axis=0), []
        for nu in (0, 1):
            mixed = [((), float(joint[i, nu]), *parts[i]) for i in (0, 1) if joint[i, nu] > 0.0]
            mean, cov = _moments(mixed)[1:] if mixed else parts[nu]
            mean, cov = jumps.moved(nu, mean, cov, u[k - 1])
            if known.get(k - 1, nu) != nu:
                weights[nu] = 0.0
            if arrived[k - 1]:
                weights[nu], mean, cov = jumps.observed(float(weights[nu]), mean, cov, y[k - 1])
            after.append((mean, cov))
        parts, weights = after, weights / weights.sum()
        whole: list[_Part] = [((), float(weights[nu]), *parts[nu]) for nu in (0, 1)]
        estimates.append(jumps.of_state(*_moments(whole)[1:]))
    return estimates


def _moments(parts: list[_Part]) -> tuple[float, Floats, Floats]:
    total = sum(part[1] for part in parts)
    mean = np.sum([part[1] * part[2] for part in parts], axis=0) / total
    second = np.sum([part[1] * (part[3] + np.outer(part[2] - mean, part[2] - mean)) for part in parts], axis=0)
    return total, mean, second / total
