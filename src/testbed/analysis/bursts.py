"""How long a link stays good and bad: the laws of the sojourn times (P section 2)."""

from __future__ import annotations

import math
from dataclasses import dataclass

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


def mean_lengths(chain: Chain) -> tuple[float, float]:
    """Mean length of a burst of losses and of a run of deliveries; their shares are the stationary law."""
    return lost_run(chain).mean, delivered_run(chain).mean
