"""A loss process as estimators hold it: a Markov chain of hidden states, each of which fixes the fate of its packet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from testbed.channel.hidden import Hidden
from testbed.channel.loss import Chain
from testbed.numerics.markov import reached

LossModel = Chain | Hidden
"""What estimators and theorems take a link's losses for. Both have as_chain, never_loses, independent, first_arrival,
arrival, mean_burst, correlation, memory, burst_decay, covariance_factor and share_moments."""


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

    @property
    def visible(self) -> bool:
        """Whether the state is the fate: state 0 lost, state 1 delivered."""
        return bool(np.array_equal(self.arrived, [False, True]))

    def states_of(self, fate: bool) -> list[int]:
        """The states in which a packet has this fate."""
        return [int(h) for h in np.flatnonzero(self.arrived == fate)]


def law_of(losses: LossModel) -> Law:
    """The law of least states. Of a chain: state 0 lost, state 1 delivered.

    Of losses with hidden states: (state, lost) for each of them, then (state, delivered), less those that cannot
    happen; where they are a chain of arrivals, the law of that.
    """
    chain = losses.as_chain
    if chain is None:
        assert isinstance(losses, Hidden)
        state, fate, chance = _pairs(losses)
        return Law(losses.initial[state] * chance, losses.transition[np.ix_(state, state)] * chance, fate)
    return Law(
        np.array([1.0 - chain.start, chain.start]),
        np.array([[1.0 - chain.recovery, chain.recovery], [chain.failure, 1.0 - chain.failure]]),
        np.array([False, True]),
    )


def stationary_of(losses: LossModel) -> NDArray[np.float64]:
    """The stationary law of the states of ``law_of(losses)``, (H,)."""
    chain = losses.as_chain
    if chain is None:
        assert isinstance(losses, Hidden)
        state, _, chance = _pairs(losses)
        pairs: NDArray[np.float64] = losses.stationary[state] * chance
        return pairs
    return np.array([1.0 - chain.arrival, chain.arrival])


def _pairs(losses: Hidden) -> tuple[NDArray[np.intp], NDArray[np.bool_], NDArray[np.float64]]:
    """State, fate, and P(fate | state) of each pair that can happen."""
    states = np.flatnonzero(reached(losses.initial > 0.0, losses.transition))
    state, fate = np.tile(states, 2), np.repeat([False, True], len(states))
    chance = np.where(fate, 1.0 - losses.loss[state], losses.loss[state])
    happens = chance > 0.0
    return state[happens], fate[happens], chance[happens]
