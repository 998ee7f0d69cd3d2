"""Losses behind which a Markov chain moves that nobody sees: each of its states loses packets with its own probability.

A packet meets a state, which decides how likely it is lost; then the chain moves, once a packet (or once a slot).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from bisect import bisect_right
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np

from testbed.channel.loss import Chain
from testbed.errors import UsageError
from testbed.numerics.lanes import Floats, Mask
from testbed.numerics.markov import long_run, mixing_sums, reached, summed_ranges
from testbed.numerics.streams import Stream

State: TypeAlias = Any  # int | NDArray[np.intp]
_SAME = 1e-15


class Hidden(ABC):
    """What follows from the law of the first state, the moves of the states, and the loss in each.

    Figures without another word are those of the stationary law.
    """

    @property
    @abstractmethod
    def initial(self) -> Floats:
        """P(first state), (H,)."""

    @property
    @abstractmethod
    def transition(self) -> Floats:
        """P(state → next state), (H, H)."""

    @property
    @abstractmethod
    def loss(self) -> Floats:
        """P(a packet that meets the state is lost), (H,)."""

    @cached_property
    def stationary(self) -> Floats:
        """The law of the states in the long run, (H,)."""
        return long_run(self.initial, self.transition)

    @cached_property
    def as_chain(self) -> Chain | None:
        """The same process as a chain of arrivals; None where it is none, as far as is seen from the states.

        It is one if the next arrival is as likely after each pair of a state and a fate that has this fate.
        J. G. Kemeny, J. L. Snell: Finite Markov chains (1960), section 6.3.
        """
        here = reached(self.initial > 0.0, self.transition)
        arrives = self.transition @ (1.0 - self.loss)
        lost, delivered = arrives[here & (self.loss > 0.0)], arrives[here & (self.loss < 1.0)]
        if not len(lost):
            return Chain.lossless()
        if not len(delivered):
            return Chain.bernoulli(0.0)
        if max(np.ptp(lost), np.ptp(delivered)) > _SAME:
            return None
        fails = (self.transition @ self.loss)[here & (self.loss < 1.0)]
        return Chain(float(lost[0]), float(fails[0]), self.first_arrival)

    @property
    def never_loses(self) -> bool:
        chain = self.as_chain
        return chain is not None and chain.never_loses

    @property
    def independent(self) -> bool:
        """True when arrivals are independent and identically distributed."""
        return self.as_chain is not None and self.as_chain.independent

    @property
    def recovery(self) -> float:
        """That of ``as_chain``. Raises UsageError where there is none."""
        return self._chain().recovery

    @property
    def failure(self) -> float:
        """That of ``as_chain``. Raises UsageError where there is none."""
        return self._chain().failure

    @property
    def start(self) -> float:
        """That of ``as_chain``. Raises UsageError where there is none."""
        return self._chain().start

    @property
    def first_arrival(self) -> float:
        """P(first packet delivered)."""
        return float(self.initial @ (1.0 - self.loss))

    @property
    def arrival(self) -> float:
        """P(a packet is delivered)."""
        return float(self.stationary @ (1.0 - self.loss))

    @property
    def mean_burst(self) -> float | None:
        """Mean length of a run of losses: losses a packet over bursts a packet. None if there is no such run."""
        begins = float((self.stationary * (1.0 - self.loss)) @ self.transition @ self.loss)
        return float(self.stationary @ self.loss) / begins if begins > 0.0 else None

    @property
    def correlation(self) -> float:
        """Corr(γ_0, γ_1) of the fates of neighbours."""
        arrives, mean = 1.0 - self.loss, self.arrival
        spread = mean * (1.0 - mean)
        both = float((self.stationary * arrives) @ self.transition @ arrives)
        return (both - mean**2) / spread if spread > 0.0 else 0.0

    @property
    def memory(self) -> float:
        """r: Corr(γ_0, γ_j) falls like r^j. The largest modulus of the eigenvalues of the moves but the 1."""
        return float(np.abs(np.linalg.eigvals(self.transition - self.stationary)).max())

    @property
    def burst_decay(self) -> float:
        """θ: P(m losses in a row) falls like θ^m. The spectral radius of (P(s → s') loss(s')) over the states met."""
        chain = self.as_chain
        if chain is not None:
            return chain.burst_decay
        here = reached(self.initial > 0.0, self.transition)
        lost = (self.transition * self.loss)[np.ix_(here, here)]
        return float(np.abs(np.linalg.eigvals(lost)).max())

    @property
    def worst_loss(self) -> float:
        """A bound of the limsup of P(packet k is lost | the fates before it), over all fates: for a known state."""
        return float((self.transition @ self.loss)[self.stationary > 0.0].max())

    @property
    def covariance_factor(self) -> float | None:
        """f with Σ_j |Cov(γ_i, γ_j)| ≤ ¼ f for all i and any start; None where there is no such bound.

        With a the arrivals of the states, Cov(γ_i, γ_j) = Cov(a(s_i), (T^{j−i} a)(s_i)) ≤ ¼ range(a) range(T^{j−i} a).
        """
        if self.never_loses or self.independent:
            return 1.0
        here = reached(self.initial > 0.0, self.transition)
        arrives = 1.0 - self.loss[here]
        ahead = summed_ranges(self.transition[np.ix_(here, here)], self.stationary[here], arrives)
        return None if ahead is None else 1.0 + 2.0 * float(np.ptp(arrives)) * ahead

    def share_moments(self, packets: int) -> tuple[float, float]:
        """Mean of the share of so many packets that is delivered, from the first on, and its stationary variance."""
        law, arrives, mean = self.stationary, 1.0 - self.loss, self.arrival
        plain, weighted = mixing_sums(self.transition, law, packets)
        together = float((law * arrives) @ weighted @ arrives)
        share = mean + float((self.initial - law) @ plain @ arrives) / packets
        return share, (packets * mean * (1.0 - mean) + 2.0 * together) / packets**2

    def _chain(self) -> Chain:
        """For what holds for chains of arrivals alone, so that it is not silently wrong here."""
        chain = self.as_chain
        if chain is None:
            raise UsageError(
                "losses with a hidden state have no recovery and failure rate, and this holds for Markov losses only; "
                "allowed here: none, bernoulli, markov, or a kind whose states say no more than the fates do, such as "
                "gilbert-elliott with loss_good = 0 and loss_bad = 1"
            )
        return chain


@dataclass(frozen=True)
class HiddenChain(Hidden):
    """Any number of states. first (H,), moves (H, H) and losses (H,) are plain numbers, so that it can be compared."""

    first: tuple[float, ...]
    moves: tuple[tuple[float, ...], ...]
    losses: tuple[float, ...]

    @cached_property
    def initial(self) -> Floats:
        return np.array(self.first)

    @cached_property
    def transition(self) -> Floats:
        return np.array(self.moves)

    @cached_property
    def loss(self) -> Floats:
        return np.array(self.losses)


class HiddenProcess:
    """Draws the fate of packet 0, 1, 2, … for a block of lanes: the moves of the state and the drops apart.

    A state is the number of its row, an ``int`` for one lane, else an array (M,). It is drawn by where a uniform number
    lies on the probabilities of the states, side by side in their order.
    """

    def __init__(self, losses: HiddenChain, states: Stream, drops: Stream, lanes: int) -> None:
        self._states, self._drops, self._lanes = states, drops, lanes
        self._first, ends = _ends(losses.initial).tolist(), _ends(losses.transition)
        self._rows, self._columns = ends.tolist(), list(np.ascontiguousarray(ends.T))
        self._arrival = 1.0 - losses.loss
        self._drawn = bool(((losses.loss > 0.0) & (losses.loss < 1.0)).any())
        self.states = len(losses.losses)
        self.state: State | None = None

    def next(self, number: int) -> Mask:
        """Arrival mask of packet ``number``: a ``bool`` for one lane, else a boolean array of shape (M,)."""
        return self.fate(number, self.move(number))

    def move(self, number: int) -> State:
        """State ``number``, from the one before."""
        if self._lanes == 1:
            ends = self._first if self.state is None else self._rows[self.state]
            self.state = bisect_right(ends, self._states.first(number))
            return self.state
        (point,) = self._states.uniforms(number)
        before, state = self.state, np.zeros(self._lanes, dtype=np.intp)
        for column, end in zip(self._columns, self._first, strict=True):
            state += point >= (end if before is None else column[before])
        self.state = state
        return state

    def fate(self, number: int, state: State) -> Mask:
        """The fate of packet ``number`` in that state."""
        arrival = self._arrival[state]
        if self._lanes == 1:
            return bool((self._drops.first(number) if self._drawn else 0.5) < arrival)
        (point,) = self._drops.uniforms(number) if self._drawn else (0.5,)
        return np.asarray(point < arrival)


def _ends(chances: Floats) -> Floats:
    """Where the places of the states but the last end on 0 … 1, (…, H − 1); beyond it if no later one can be, so that
    rounding does not lead there."""
    later = np.cumsum(chances[..., ::-1], axis=-1)[..., ::-1][..., 1:]
    return np.where(later > 0.0, np.cumsum(chances, axis=-1)[..., :-1], np.inf)
