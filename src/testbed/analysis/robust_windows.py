"""How much RSEIO's recursion contracts over a window of steps, over all patterns of arrivals that can occur."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from testbed.analysis.homography import Homography
from testbed.analysis.robust_ranks import Rank, pattern_ranks
from testbed.analysis.robust_recursion import Pairs, RobustRecursion
from testbed.channel.loss import Chain

LONGEST = 10
"""Patterns of up to this many steps are enumerated: 2^10."""

Pattern = tuple[bool, ...]


@dataclass(frozen=True)
class RankedPattern:
    """The pattern, and the ranks of its O_b and C_n; ``checked``: how many patterns were looked at."""

    pattern: Pattern
    observation: Rank
    noise: Rank
    checked: int

    @property
    def contracts(self) -> bool:
        return self.observation.full and self.noise.full


@dataclass(frozen=True)
class Window:
    """The contraction factors of all patterns of ``steps`` steps, with the chain in its stationary law.

    best: the least of them; mean_log: E log of the factor, the expectation of R (8); patterns: how many can occur.
    """

    steps: int
    patterns: int
    best: float
    mean_log: float

    @property
    def rate(self) -> float:
        """exp(mean_log / steps): in the long run δ shrinks at least by this factor a step, with probability one."""
        return math.exp(self.mean_log / self.steps)


def possible_patterns(chain: Chain, steps: int) -> list[tuple[Pattern, float]]:
    """Patterns of ``steps`` steps that can occur, γ_1 first, with their probabilities (R Lemma 4): likeliest first."""
    found: list[tuple[Pattern, float]] = [((), 1.0)]
    for _ in range(steps):
        found = [
            ((*pattern, arrived), chance * p)
            for pattern, chance in found
            for arrived, p in _next(chain, pattern[-1] if pattern else None)
        ]
    return sorted(found, key=lambda entry: -entry[1])


def shortest_contraction(pairs: Pairs, chain: Chain, longest: int = LONGEST) -> RankedPattern:
    """The shortest pattern that can occur, and of these the likeliest, with O_b and C_n of full rank (R Theorems 3, 4).

    Without one: the likeliest of length ``longest``, which then does not contract.
    """
    checked = 0
    for steps in range(1, longest + 1):
        candidates = possible_patterns(chain, steps)
        for pattern, _ in candidates:
            checked += 1
            observation, noise = pattern_ranks(pairs, pattern)
            if observation.full and noise.full:
                return RankedPattern(pattern, observation, noise, checked)
    pattern = candidates[0][0]
    return RankedPattern(pattern, *pattern_ranks(pairs, pattern), checked)


def product(recursion: RobustRecursion, pattern: Pattern) -> Homography:
    """The map of P over the steps of ``pattern``."""
    out = Homography.identity(recursion.A.shape[0])
    for arrived in pattern:
        out = out.then(recursion.arrived if arrived else recursion.lost)
    return out


def contraction_window(recursion: RobustRecursion, chain: Chain, steps: int) -> Window:
    """Every pattern of ``steps`` steps (at most ``LONGEST``, if you want to wait for it) by its own factor."""
    entries = list(_factors(recursion, chain, None, Homography.identity(recursion.A.shape[0]), 1.0, steps))
    chances, factors = np.array(entries).T
    with np.errstate(divide="ignore"):
        mean_log = float(np.sum(chances * np.log(factors)))
    return Window(steps, len(entries), float(factors.min()), mean_log)


def _factors(
    recursion: RobustRecursion, chain: Chain, last: bool | None, so_far: Homography, chance: float, left: int
) -> Iterator[tuple[float, float]]:
    if left == 0:
        yield chance, so_far.contraction()
        return
    for arrived, p in _next(chain, last):
        longer = so_far.then(recursion.arrived if arrived else recursion.lost)
        yield from _factors(recursion, chain, arrived, longer, chance * p, left - 1)


def _next(chain: Chain, last: bool | None) -> list[tuple[bool, float]]:
    """What can come after ``last`` (None: the stationary law), with its probability."""
    p = chain.arrival if last is None else 1.0 - chain.failure if last else chain.recovery
    return [(arrived, weight) for arrived, weight in ((True, p), (False, 1.0 - p)) if weight > 0.0]
