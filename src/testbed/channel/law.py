"""A loss process as estimators hold it: a Markov chain of hidden states, each of which fixes the fate of its packet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from testbed.channel.loss import Chain


@dataclass(frozen=True, eq=False)
class Law:
    """States h = 0 … H − 1: P(h_0) = initial (H,), P(h → h') = transition (H, H); packet k arrives iff arrived[h_k]."""

    initial: NDArray[np.float64]
    transition: NDArray[np.float64]
    arrived: NDArray[np.bool_]

    @property
    def memoryless(self) -> bool:
        """Whether the next state does not depend on this one."""
        return bool(
            np.ptp(self.transition, axis=0).max() <= 1e-15
            and np.ptp([self.initial, self.transition[0]], axis=0).max() <= 1e-15
        )


def law_of(chain: Chain) -> Law:
    """Of the two-state chain: state 0 lost, state 1 delivered."""
    return Law(
        np.array([1.0 - chain.start, chain.start]),
        np.array([[1.0 - chain.recovery, chain.recovery], [chain.failure, 1.0 - chain.failure]]),
        np.array([False, True]),
    )
