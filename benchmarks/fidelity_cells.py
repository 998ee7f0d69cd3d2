"""What is compared: a link, what is sent over it, and what was seen of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Transport = Literal["tcp", "udp"]
_TOGETHER_MS = 1.0


@dataclass(frozen=True, eq=False)
class Cell:
    """A link and its messages. Of tcp, the link is the same in both directions; of udp, nothing is lost backwards."""

    name: str
    transport: Transport
    delay_ms: float
    link: dict[str, Any]
    """The keys of its table, but for the delay of tcp."""
    size: int = 64
    period_ns: int = 10_000_000

    @property
    def percent(self) -> float:
        """Of independent losses."""
        return round(100.0 * float(self.link.get("loss", {}).get("loss", 0.0)), 6)

    @property
    def drain_s(self) -> float:
        """How long after the last message one is waited for."""
        return 20.0 if self.transport == "tcp" else 2.0

    def messages(self, seconds: float) -> int:
        return max(2, round(seconds * 1e9 / self.period_ns))

    def impairments(self, offset_ms: float = 0.0) -> dict[str, Any]:
        """The keys of the link's table; ``offset_ms`` is added to the delay."""
        if self.transport == "udp":
            return self.link
        return {**self.link, "delay": {"kind": "constant", "by": f"{self.delay_ms + offset_ms:.6f} ms"}}


def tcp_cells() -> list[Cell]:
    return [
        Cell(f"tcp {delay} ms {percent} %", "tcp", delay, _bernoulli(percent))
        for percent in (0, 1, 5, 20)
        for delay in (1, 10, 50)
    ]


def udp_cells() -> list[Cell]:
    """10 kB: 7 IP fragments. Ten of those a second, or the receiver's kernel has no room for all that it waits to
    complete: it keeps the rest of a message of which a fragment was lost for 30 s, and has 4 MB for that."""
    constant = {"delay": {"kind": "constant", "by": "10 ms"}}
    markov = {"loss": {"kind": "markov", "loss": 0.1, "mean_burst": 4.0}, **constant}
    elliott = {"kind": "gilbert-elliott", "to_bad": 0.02, "to_good": 0.2, "loss_good": 0.01, "loss_bad": 0.6}
    jitter = {"delay": {"kind": "uniform", "low": "0 ms", "high": "30 ms"}}
    large: dict[str, Any] = {"size": 10_000, "period_ns": 100_000_000}
    return [
        Cell("udp bernoulli 5 %", "udp", 10, {**_bernoulli(5), **constant}),
        Cell("udp bernoulli 20 %", "udp", 10, {**_bernoulli(20), **constant}),
        Cell("udp markov", "udp", 10, markov),
        Cell("udp gilbert-elliott", "udp", 10, {"loss": elliott, **constant}),
        Cell("udp bernoulli 5 %, 10 kB", "udp", 10, {**_bernoulli(5), **constant}, **large),
        Cell("udp markov, 10 kB", "udp", 10, markov, **large),
        Cell("udp jitter", "udp", 15, jitter),
    ]


def _bernoulli(percent: int) -> dict[str, Any]:
    return {"loss": {"kind": "bernoulli", "loss": percent / 100}} if percent else {}


@dataclass(frozen=True, eq=False)
class Seen:
    """Of so many messages: numbers of those that arrived, in the order of arrival, and their times from the first's
    sending, ms."""

    messages: int
    period_ms: float
    numbers: NDArray[np.int64]
    at_ms: NDArray[np.float64]
    timeouts: int = 0
    back: float = 0.0
    """Packets sent back for each one sent forwards."""
    notes: dict[str, Any] = field(default_factory=dict)

    @property
    def delays_ms(self) -> NDArray[np.float64]:
        """Sorted."""
        return np.sort(self.at_ms - self.numbers * self.period_ms)

    @property
    def loss(self) -> float:
        return 1.0 - len(self.numbers) / self.messages

    @property
    def together(self) -> float:
        """Share of the messages that arrived within 1 ms of the one before."""
        return float((np.diff(np.sort(self.at_ms)) < _TOGETHER_MS).mean()) if len(self.at_ms) > 1 else 0.0

    @property
    def outages(self) -> int:
        """Runs of messages that did not arrive: over a connection, each is a session that ended."""
        missing = np.ones(self.messages + 1, dtype=np.bool_)
        missing[1 + self.numbers] = False
        missing[0] = False
        return int((missing[1:] & ~missing[:-1]).sum())


def quantiles(delays_ms: NDArray[np.float64]) -> list[float]:
    """50, 90 and 99 %: of n sorted values, the least that at least this share does not exceed."""
    if not len(delays_ms):
        return [float("nan")] * 3
    return [float(np.quantile(delays_ms, share, method="inverted_cdf")) for share in (0.5, 0.9, 0.99)]
