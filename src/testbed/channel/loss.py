"""Loss processes: which packets arrive. One draw a packet and lane, indexed by the packet's number."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from testbed.numerics.chances import happens, prepare
from testbed.numerics.lanes import Mask
from testbed.numerics.streams import Stream


@dataclass(frozen=True)
class Chain:
    """The two-state Markov chain of arrivals (1 = delivered), clocked by packets.

    recovery: P(0→1); failure: P(1→0); start: P(first packet delivered). A Bernoulli link of arrival rate λ is
    Chain(λ, 1 − λ, λ). The state drawn for a packet decides its fate; the chain then moves to the next packet.
    """

    recovery: float
    failure: float
    start: float

    @classmethod
    def lossless(cls) -> Chain:
        return cls(1.0, 0.0, 1.0)

    @classmethod
    def bernoulli(cls, arrival: float) -> Chain:
        return cls(arrival, 1.0 - arrival, arrival)

    @classmethod
    def markov(cls, recovery: float, failure: float, start: float | None = None) -> Chain:
        """Stationary at the first packet unless ``start`` is given."""
        return cls(recovery, failure, recovery / (recovery + failure) if start is None else start)

    @property
    def as_chain(self) -> Chain:
        """Itself: what is more than a chain of arrivals may be one in a special case."""
        return self

    @property
    def never_loses(self) -> bool:
        return self.start == 1.0 and self.failure == 0.0

    @property
    def independent(self) -> bool:
        """True when arrivals are independent and identically distributed."""
        stays = 1.0 - self.failure
        return abs(self.recovery - stays) <= 1e-15 and abs(self.start - self.recovery) <= 1e-15

    @property
    def first_arrival(self) -> float:
        """P(first packet delivered)."""
        return self.start

    @property
    def arrival(self) -> float:
        """Stationary arrival probability."""
        return self.recovery / (self.recovery + self.failure)

    @property
    def mean_burst(self) -> float | None:
        """Mean length of a run of losses, 1/recovery; None if losses never end."""
        return 1.0 / self.recovery if self.recovery > 0.0 else None

    @property
    def memory(self) -> float:
        """r of Corr(γ_0, γ_j) = r^j, in the stationary law."""
        return 1.0 - self.recovery - self.failure

    @property
    def correlation(self) -> float:
        """Corr(γ_0, γ_1) of the fates of neighbours."""
        return self.memory

    @property
    def covariance_factor(self) -> float | None:
        """f with Σ_j |Cov(γ_i, γ_j)| ≤ ¼ f for all i and any start: (1 + |r|)/(1 − |r|), None where it is infinite."""
        r = 0.0 if self.independent or self.never_loses else abs(self.memory)
        return (1.0 + r) / (1.0 - r) if r < 1.0 else None

    def share_moments(self, packets: int) -> tuple[float, float]:
        """Mean of the share of so many packets that is delivered, from the first on, and its stationary variance."""
        leaving, rho, arrival = self.recovery + self.failure, self.memory, self.arrival
        geometric = (1.0 - rho**packets) / leaving  # Σ ρ^j, j = 0 … n − 1
        together = rho * (packets - geometric) / leaving  # Σ (n − j) ρ^j, j = 1 … n − 1
        mean = arrival + (self.start - arrival) * geometric / packets
        return mean, arrival * (1.0 - arrival) * (packets + 2.0 * together) / packets**2

    @property
    def burst_decay(self) -> float:
        """P(m losses in a row) falls like burst_decay^m."""
        return 1.0 - self.recovery


class LossProcess:
    """Draws the fate of packet 0, 1, 2, … for a block of lanes."""

    states = 2

    def __init__(self, chain: Chain, stream: Stream, lanes: int) -> None:
        self.chain, self._stream, self._lanes = chain, stream, lanes
        prepare(lanes)
        self._last: Mask | None = None
        self._lossless = chain.never_loses
        self._start, self._recovery, self._stays = chain.start, chain.recovery, 1.0 - chain.failure

    def next(self, number: int) -> Mask:
        """Arrival mask of packet ``number``: a ``bool`` for one lane, else a boolean array of shape (M,)."""
        last = self._last
        if self._lanes == 1:
            if self._lossless:
                return True
            chance = self._start if last is None else self._stays if last else self._recovery
            self._last = fate = self._stream.first(number) < chance
            return fate
        if self._lossless:
            return np.ones(self._lanes, dtype=np.bool_)
        if last is None:
            (uniforms,) = self._stream.uniforms(number)
            self._last = np.asarray(uniforms < self._start)
        else:
            self._last = happens(self._stream.words(number)[0], last, self._recovery, self._stays)
        return self._last

    @property
    def state(self) -> Mask | None:
        """The state that the last packet met; None before the first."""
        return self._last

    @state.setter
    def state(self, state: Mask | None) -> None:
        self._last = state

    def move(self, number: int) -> Mask:
        """State ``number`` where states are not counted by packets."""
        return self.next(number)

    def fate(self, number: int, state: Mask) -> Mask:
        """The fate of packet ``number`` in that state."""
        return state


@dataclass
class LossCounts:
    """What happened to the packets of a block of lanes, counted over lane-packets; the books balance by construction.

    ``transitions[a][b]``: how often a packet of fate b followed one of fate a in the same lane.
    """

    sent: int = 0
    delivered: int = 0
    bursts: int = 0
    transitions: list[list[int]] = field(default_factory=lambda: [[0, 0], [0, 0]])
    last: Mask | None = None
    """The fate of the last packet."""

    def count(self, arrived: Mask) -> None:
        """Take in the fate of one packet."""
        last, self.last = self.last, arrived
        if isinstance(arrived, bool):
            self.sent += 1
            self.delivered += arrived
            if last is not None:
                self.transitions[last][arrived] += 1
            self.bursts += (not arrived) and last is not False
            return
        lanes, ones = len(arrived), int(np.count_nonzero(arrived))
        self.sent += lanes
        self.delivered += ones
        if last is None:
            self.bursts += lanes - ones
            return
        before, both = int(np.count_nonzero(last)), int(np.count_nonzero(last & arrived))
        t = self.transitions
        t[1][1] += both
        t[1][0] += before - both
        t[0][1] += ones - both
        t[0][0] += lanes - before - ones + both
        self.bursts += before - both

    @property
    def dropped(self) -> int:
        return self.sent - self.delivered

    def as_counters(self) -> dict[str, int]:
        t = self.transitions
        return {
            "sent": self.sent,
            "delivered": self.delivered,
            "dropped": self.dropped,
            "bursts": self.bursts,
            "00": t[0][0],
            "01": t[0][1],
            "10": t[1][0],
            "11": t[1][1],
        }
