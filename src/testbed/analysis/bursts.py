"""How long the fates of a link stay the same: geometric for chains of arrivals (P section 2), else of phase type."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from testbed.channel.law import LossModel, law_of, stationary_of
from testbed.channel.loss import Chain
from testbed.numerics.lanes import Floats


@dataclass(frozen=True)
class Sojourn:
    """The geometric law on 1, 2, … of a run of equal fates that ends with probability ``end`` at each packet."""

    end: float

    @property
    def mean(self) -> float:
        """1/end; infinite if the run never ends."""
        return 1.0 / self.end if self.end > 0.0 else math.inf

    def probability(self, lengths: Floats) -> Floats:
        """P(length = l) for each entry of ``lengths`` (any shape), integers of 1 or more."""
        result: Floats = self.end * (1.0 - self.end) ** (lengths - 1.0)
        return result

    def quantile(self, level: float) -> int | None:
        """The least l with P(length ≤ l) ≥ level, 0 < level < 1; None if there is none."""
        if self.end <= 0.0:
            return None
        if self.end >= 1.0:
            return 1
        return max(1, math.ceil(math.log1p(-level) / math.log1p(-self.end) - 1e-12))


def lost_run(chain: Chain) -> Sojourn:
    """The law of a burst of losses: P calls its length β*."""
    return Sojourn(chain.recovery)


def delivered_run(chain: Chain) -> Sojourn:
    """The law of a run of deliveries: P calls its length τ*."""
    return Sojourn(chain.failure)


@dataclass(frozen=True, eq=False)
class PhaseType:
    """The law of a run of equal fates behind which states move: P(length = l) = α T^{l−1} (I − T) 1, l = 1, 2, …

    start: α (m,), the state of the first packet of a run. stay: T (m, m), moves to a state of the same fate.
    again: G (m, m), from the state in which a run begins to that in which the next one of that fate does; α G = α.
    """

    start: Floats
    stay: Floats
    again: Floats

    @property
    def _sums(self) -> Floats:
        """(I − T)^{-1}, the sum of the powers of T."""
        return np.asarray(np.linalg.inv(np.eye(len(self.start)) - self.stay), dtype=np.float64)

    @property
    def mean(self) -> float:
        """α (I − T)^{-1} 1."""
        return float(self.start @ self._sums.sum(axis=1))

    @property
    def variance(self) -> float:
        """From E[l²] = α (2 (I − T)^{-2} − (I − T)^{-1}) 1."""
        sums = self._sums
        second = float(self.start @ (2.0 * sums @ sums - sums).sum(axis=1))
        return second - self.mean**2

    @property
    def variance_of_mean(self) -> float:
        """n Var(mean length of n runs), n → ∞. Successive runs are correlated through the states in which they begin.

        E[l; next start] = α (I − T)^{-1} G, and Σ_j (G^j − 1 α) = (I − G + 1 α)^{-1} − 1 α.
        """
        sums, ones = self._sums, np.ones((len(self.start), 1))
        forever = ones @ self.start[None, :]
        weights = np.linalg.inv(np.eye(len(self.start)) - self.again + forever) - forever
        return self.variance + 2.0 * float(self.start @ sums @ self.again @ weights @ sums.sum(axis=1))

    def probability(self, lengths: Floats) -> Floats:
        """P(length = l) for each entry of ``lengths`` (any shape), integers of 1 or more."""
        out = [self.tail(int(length) - 1) - self.tail(int(length)) for length in np.ravel(lengths)]
        return np.reshape(np.array(out, dtype=np.float64), np.shape(lengths))

    def tail(self, length: int) -> float:
        """P(length > l)."""
        return float(self.start @ np.linalg.matrix_power(self.stay, length).sum(axis=1))

    def quantile(self, level: float) -> int:
        """The least l with P(length ≤ l) ≥ level, 0 < level < 1."""
        above, rest = 1, (1.0 - level) * (1.0 + 1e-12)
        while self.tail(above) > rest:
            above *= 2
        below = above // 2
        while above - below > 1:
            middle = (above + below) // 2
            below, above = (middle, above) if self.tail(middle) > rest else (below, middle)
        return above


def run_law(losses: LossModel, fate: bool) -> PhaseType | None:
    """The law of the runs of a fate in the stationary law; None where there are none, or one that never ends."""
    law = law_of(losses)
    same, other = law.states_of(fate), law.states_of(not fate)
    T = law.transition
    start = stationary_of(losses)[other] @ T[np.ix_(other, same)]
    if not start.sum() > 0.0:
        return None
    stay, back = T[np.ix_(same, same)], np.eye(len(other)) - T[np.ix_(other, other)]
    leave = T[np.ix_(same, other)] @ np.linalg.solve(back, T[np.ix_(other, same)])
    again = np.asarray(np.linalg.solve(np.eye(len(same)) - stay, leave), dtype=np.float64)
    return PhaseType(start / start.sum(), stay, again)
