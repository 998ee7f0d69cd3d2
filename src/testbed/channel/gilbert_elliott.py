"""The Gilbert–Elliott channel: a hidden state, good or bad, that says how likely a packet is lost (theory.md 1)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from testbed.channel.hidden import Hidden
from testbed.channel.loss import Chain, LossProcess
from testbed.numerics.chances import happens
from testbed.numerics.lanes import Floats, Mask
from testbed.numerics.streams import Stream


@dataclass(frozen=True)
class GilbertElliott(Hidden):
    """Two states, bad and good, in this order where they are counted.

    states: the chain of the states, 1 = good, that is Chain(P(bad→good), P(good→bad), P(first state good)).
    loss_good, loss_bad: probability of a loss in each state.
    """

    states: Chain
    loss_good: float
    loss_bad: float

    @classmethod
    def of(
        cls,
        to_bad: float,
        to_good: float,
        loss_good: float = 0.0,
        loss_bad: float = 1.0,
        start_good: float | None = None,
    ) -> GilbertElliott:
        """Stationary at the first packet unless ``start_good`` is given."""
        return cls(Chain.markov(to_good, to_bad, start_good), loss_good, loss_bad)

    @cached_property
    def initial(self) -> Floats:
        return np.array([1.0 - self.states.start, self.states.start])

    @cached_property
    def transition(self) -> Floats:
        states = self.states
        return np.array([[1.0 - states.recovery, states.recovery], [states.failure, 1.0 - states.failure]])

    @cached_property
    def loss(self) -> Floats:
        return np.array([self.loss_bad, self.loss_good])

    @cached_property
    def stationary(self) -> Floats:
        return np.array([1.0 - self.states.arrival, self.states.arrival])

    @cached_property
    def as_chain(self) -> Chain | None:
        """The same process as a chain of arrivals; None where it is none."""
        states = self.states
        if self.loss_good == self.loss_bad or (states.start == 1.0 and states.failure == 0.0):
            return Chain.bernoulli(1.0 - self.loss_good)
        if states.start == 0.0 and states.recovery == 0.0:
            return Chain.bernoulli(1.0 - self.loss_bad)
        if states.independent:
            return Chain.bernoulli(self.first_arrival)
        if (self.loss_good, self.loss_bad) == (0.0, 1.0):
            return states
        if (self.loss_good, self.loss_bad) == (1.0, 0.0):
            return Chain(states.failure, states.recovery, 1.0 - states.start)
        return None

    @property
    def first_arrival(self) -> float:
        """P(first packet delivered)."""
        return 1.0 - self._mixed(self.states.start)

    @property
    def arrival(self) -> float:
        """Stationary arrival probability."""
        return 1.0 - self._mixed(self.states.arrival)

    @property
    def memory(self) -> float:
        """r of Corr(γ_0, γ_j) = coupling · r^j, in the stationary law."""
        return self.states.memory

    @property
    def contrast(self) -> float:
        """How far the arrival probabilities of the states are apart."""
        return abs(self.loss_bad - self.loss_good)

    @property
    def coupling(self) -> float:
        """What the state tells of the fate: Corr(γ_0, γ_j) = coupling · memory^j for j = 1, 2, …"""
        good, spread = self.states.arrival, self.arrival * (1.0 - self.arrival)
        return self.contrast**2 * good * (1.0 - good) / spread if spread > 0.0 else 0.0

    @property
    def correlation(self) -> float:
        return self.coupling * self.memory

    @property
    def covariance_factor(self) -> float | None:
        r = 0.0 if self.independent or self.never_loses else abs(self.memory)
        return 1.0 + 2.0 * self.contrast**2 * r / (1.0 - r) if r < 1.0 else None

    @property
    def burst_decay(self) -> float:
        """θ: P(m losses in a row) falls like θ^m. The spectral radius of (P(s → s') loss(s'))."""
        chain = self.as_chain
        if chain is not None:
            return chain.burst_decay
        states = self.states
        stay_good, stay_bad = (1.0 - states.failure) * self.loss_good, (1.0 - states.recovery) * self.loss_bad
        turn = states.failure * self.loss_bad * states.recovery * self.loss_good
        return 0.5 * (stay_good + stay_bad + math.sqrt((stay_good - stay_bad) ** 2 + 4.0 * turn))

    @property
    def worst_loss(self) -> float:
        """A bound of the limsup of P(packet k is lost | the fates before it), over all fates.

        Where the states keep themselves (memory ≥ 0) it is θ. Let b be the probability of the state that loses more,
        given the past. A loss makes the next b = F(b), an arrival makes it less than F(b), F is increasing, and at its
        fixed point P(loss) = θ. So b never passes that point if it begins below it, as the stationary law does, and
        otherwise sinks to it. Where the states alternate, the bound is that for a known state.
        """
        if self.memory >= 0.0:
            return self.burst_decay
        return max(self._mixed(1.0 - self.states.failure), self._mixed(self.states.recovery))

    def _mixed(self, good: float) -> float:
        """P(loss) where the state is good with this probability."""
        return good * self.loss_good + (1.0 - good) * self.loss_bad


class GilbertElliottProcess:
    """Draws the fate of packet 0, 1, 2, … for a block of lanes: the moves of the state and the drops apart."""

    states = 2

    def __init__(self, losses: GilbertElliott, states: Stream, drops: Stream, lanes: int) -> None:
        self._states = LossProcess(losses.states, states, lanes)
        self._drops = drops
        self._arrival = 1.0 - losses.loss_bad, 1.0 - losses.loss_good

    def next(self, number: int) -> Mask:
        """Arrival mask of packet ``number``: a ``bool`` for one lane, else a boolean array of shape (M,)."""
        return self.fate(number, self._states.next(number))

    @property
    def state(self) -> Mask | None:
        """The state that the last packet met, 1 = good; None before the first."""
        return self._states.state

    @state.setter
    def state(self, state: Mask | None) -> None:
        self._states.state = state

    def move(self, number: int) -> Mask:
        """State ``number`` where states are not counted by packets."""
        return self._states.next(number)

    def fate(self, number: int, good: Mask) -> Mask:
        """The fate of packet ``number`` in that state."""
        bad_arrival, good_arrival = self._arrival
        if isinstance(good, bool):
            return self._drops.first(number) < (good_arrival if good else bad_arrival)
        return happens(self._drops.words(number)[0], good, bad_arrival, good_arrival)
