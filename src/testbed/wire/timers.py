"""The wall clock, and what is to be done at a given time of it."""

from __future__ import annotations

import heapq
import time
from collections.abc import Callable
from itertools import count


class WallClock:
    """Waiting goes by the monotonic clock, which nobody sets; dates, which processes can share, by the time since 1970.

    All processes of a host have the same of both. Between hosts dates differ by as much as their clocks do.
    """

    def monotonic_ns(self) -> int:
        return time.monotonic_ns()

    def date_ns(self) -> int:
        """Nanoseconds since 1970 (UTC)."""
        return time.time_ns()

    def sleep(self, duration_s: float) -> None:
        time.sleep(duration_s)

    def monotonic_of(self, date_ns: int) -> int:
        """The monotonic time of a date, as the clocks stand now; never before it."""
        date = self.date_ns()
        return self.monotonic_ns() + date_ns - date


class Timers:
    """Calls that are due at a monotonic time, in the order of time; those of one time in the order they were made."""

    def __init__(self, clock: WallClock) -> None:
        self._clock = clock
        self._calls: list[tuple[int, int, Callable[[], None]]] = []
        self._number = count()

    def at(self, due_ns: int, call: Callable[[], None]) -> None:
        heapq.heappush(self._calls, (due_ns, next(self._number), call))

    @property
    def wait_s(self) -> float:
        """Seconds until the next call is due, zero if one is; infinity if there is none."""
        return max(0, self._calls[0][0] - self._clock.monotonic_ns()) / 1e9 if self._calls else float("inf")

    def fire(self) -> bool:
        """Make the calls that are due, those included that they add; False if none was."""
        fired = False
        while self._calls and self._calls[0][0] <= self._clock.monotonic_ns():
            fired = True
            heapq.heappop(self._calls)[2]()
        return fired
