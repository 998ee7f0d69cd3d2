"""Congestion avoidance: how the window grows, and what is left of it after a loss. Windows count segments."""

from __future__ import annotations

from typing import Protocol

WINDOW_INITIAL = 10
WINDOW_LEAST = 2
UNLIMITED = 2**31 - 1
"""The slow-start threshold before the first loss."""


class Window:
    """The congestion window, the slow-start threshold, and acknowledgements counted towards one segment more."""

    __slots__ = ("counted", "size", "threshold")

    def __init__(self) -> None:
        self.size, self.threshold, self.counted = WINDOW_INITIAL, UNLIMITED, 0

    @property
    def slow_start(self) -> bool:
        return self.size < self.threshold

    def slow(self, acked: int) -> int:
        """Slow start (RFC 5681, 3.1): one segment more for each acknowledged; returns what is left at its end."""
        size = min(self.size + acked, self.threshold)
        left = acked - (size - self.size)
        self.size = size
        return left

    def count(self, acked: int, each: int) -> None:
        """One segment more for ``each`` acknowledged ones."""
        if self.counted >= each:
            self.counted = 0
            self.size += 1
        self.counted += acked
        if self.counted >= each:
            more, self.counted = divmod(self.counted, each)
            self.size += more


class Congestion(Protocol):
    def threshold(self, size: int) -> int:
        """Slow-start threshold after a loss in a window of ``size``."""

    def grow(self, window: Window, acked: int, now_ns: int) -> None:
        """``acked`` segments were acknowledged while the window limited the sender."""

    def timed_out(self) -> None:
        """The retransmission time-out expired."""


class Reno:
    """Half the window after a loss; one segment more a round trip (RFC 5681)."""

    def threshold(self, size: int) -> int:
        return max(size >> 1, WINDOW_LEAST)

    def grow(self, window: Window, acked: int, now_ns: int) -> None:
        if window.slow_start:
            acked = window.slow(acked)
        if acked:
            window.count(acked, window.size)

    def timed_out(self) -> None:
        pass


class Cubic:
    """CUBIC (RFC 9438): 0.7 of the window after a loss, then 0.4 (t − K)³ around the window before it, t in s.

    Kept: the Reno-friendly window, fast convergence, and Linux's bound of one segment for two acknowledged.
    Left out: HyStart, which only ends the slow start of windows of 16 and more.
    """

    _C = 0.4
    _BETA = 0.7

    def __init__(self) -> None:
        self.timed_out()

    def timed_out(self) -> None:
        self._epoch_ns: int | None = None
        self._max = 0
        self._origin = self._friendly = self._acked = 0
        self._k = 0.0

    def threshold(self, size: int) -> int:
        self._epoch_ns = None
        self._max = int(size * (1 + self._BETA) / 2) if size < self._max else size
        return max(int(size * self._BETA), WINDOW_LEAST)

    def grow(self, window: Window, acked: int, now_ns: int) -> None:
        if window.slow_start:
            acked = window.slow(acked)
        if acked:
            window.count(acked, self._acknowledged_for_one(window.size, acked, now_ns))

    def _acknowledged_for_one(self, size: int, acked: int, now_ns: int) -> int:
        self._acked += acked
        if self._epoch_ns is None:
            self._epoch_ns, self._acked, self._friendly = now_ns, acked, size
            self._origin = max(size, self._max)
            self._k = ((self._origin - size) / self._C) ** (1 / 3)
        t = (now_ns - self._epoch_ns) / 1e9 - self._k
        target = self._origin + int(self._C * t * t * t)
        each = size // (target - size) if target > size else 100 * size
        if not self._max:
            each = min(each, 20)
        one = (size * 15) >> 3  # acknowledged ones for one more of Reno's window: (1 + β) / 3 (1 − β) of it
        more, self._acked = divmod(self._acked, one) if self._acked > one else (0, self._acked)
        self._friendly += more
        if self._friendly > size:
            each = min(each, size // (self._friendly - size))
        return max(each, 2)


def congestion_of(name: str) -> Congestion:
    return Reno() if name == "reno" else Cubic()
