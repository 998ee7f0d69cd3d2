"""A loss process as estimators hold it: a Markov chain of hidden states, each of which fixes the fate of its packet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from testbed.channel.gilbert_elliott import GilbertElliott
from testbed.channel.loss import Chain

LossModel = Chain | GilbertElliott
"""What a link's losses can be; both have never_loses, independent, first_arrival, arrival, mean_burst, memory,
coupling and burst_decay."""


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

    Of a Gilbert–Elliott channel: (bad, lost), (good, lost), (bad, delivered), (good, delivered), less those that cannot
    happen; where it is a chain of arrivals, the law of that.
    """
    if isinstance(losses, GilbertElliott):
        chain = losses.as_chain
        return _hidden(losses) if chain is None else law_of(chain)
    return Law(
        np.array([1.0 - losses.start, losses.start]),
        np.array([[1.0 - losses.recovery, losses.recovery], [losses.failure, 1.0 - losses.failure]]),
        np.array([False, True]),
    )


def stationary_of(losses: LossModel) -> NDArray[np.float64]:
    """The stationary law of the states of ``law_of(losses)``, (H,)."""
    if isinstance(losses, GilbertElliott):
        chain = losses.as_chain
        if chain is None:
            state, _, chance = _pairs(losses)
            pairs: NDArray[np.float64] = np.array([1.0 - losses.states.arrival, losses.states.arrival])[state] * chance
            return pairs
        losses = chain
    return np.array([1.0 - losses.arrival, losses.arrival])


def _hidden(losses: GilbertElliott) -> Law:
    states = law_of(losses.states)
    state, fate, chance = _pairs(losses)
    return Law(states.initial[state] * chance, states.transition[np.ix_(state, state)] * chance, fate)


def _pairs(losses: GilbertElliott) -> tuple[NDArray[np.intp], NDArray[np.bool_], NDArray[np.float64]]:
    """State (0 bad, 1 good), fate, and P(fate | state) of each pair that can happen."""
    lost = np.array([losses.loss_bad, losses.loss_good])
    state, fate = np.tile([0, 1], 2), np.repeat([False, True], 2)
    chance = np.where(fate, 1.0 - lost[state], lost[state])
    happens = chance > 0.0
    return state[happens], fate[happens], chance[happens]
