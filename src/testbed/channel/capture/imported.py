"""What an import makes: rows of a trace, and an account of what it could not use."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.errors import UsageError
from testbed.scenario.trace_file import Row

PACKETS_MAX = 5_000_000


@dataclass(frozen=True)
class Imported:
    """Rows in the order of delivery, lost packets where they were sent.

    measures: what a delivery and a delay are here. left_out: frames or lines that were not used, by reason. notes:
    what the figures cannot tell.
    """

    rows: list[Row]
    measures: str
    left_out: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def figures(self) -> dict[str, Any]:
        """Counts, as for a trace that was sampled."""
        fates: dict[int, bool] = {}
        for seq, _, delivered in self.rows:
            fates[seq] = fates.get(seq, False) or delivered is not None
        delivered = sum(fates.values())
        return {
            "measures": self.measures,
            "sent": len(fates),
            "delivered": delivered,
            "dropped": len(fates) - delivered,
            "duplicates": len(self.rows) - len(fates),
            "loss_rate": 1.0 - delivered / len(fates),
            "left_out": self.left_out,
            "notes": self.notes,
        }


def rows_of(sent: Sequence[int], arrivals: Sequence[Sequence[int]]) -> list[Row]:
    """The rows of packets 0, 1, …: when each was sent, and when it arrived, once, several times or never.

    A lost packet stands where it would have arrived with the least delay: clocks of two hosts may differ.
    """
    delays = [at - start for start, times in zip(sent, arrivals, strict=True) for at in times]
    least = min(delays, default=0)
    keyed: list[tuple[int, int, Row]] = []
    for seq, (start, times) in enumerate(zip(sent, arrivals, strict=True)):
        if not times:
            keyed.append((start + least, seq, (seq, start, None)))
        keyed += [(at, seq, (seq, start, at)) for at in times]
    keyed.sort(key=lambda entry: entry[:2])
    return [row for _, _, row in keyed]


def interpolated(known: dict[int, int], first: int, last: int) -> list[int]:
    """Times of the numbers first … last from those of some of them, in proportion between and beyond.

    known: two numbers or more, or one, then all get its time.
    """
    numbers = sorted(known)
    base = known[numbers[0]]
    x: NDArray[np.int64] = np.array(numbers)
    y: NDArray[np.float64] = np.array([known[number] - base for number in numbers], dtype=np.float64)
    asked = np.arange(first, last + 1)
    times = np.interp(asked, x, y)
    if len(numbers) > 1:
        step = (y[-1] - y[0]) / (x[-1] - x[0])
        times = np.where(asked < x[0], y[0] - step * (x[0] - asked), times)
        times = np.where(asked > x[-1], y[-1] + step * (asked - x[-1]), times)
    return [known.get(int(n), base + round(float(t))) for n, t in zip(asked, times, strict=True)]


class Unwrapped:
    """Sequence numbers of a few bits as numbers that go on: each as near as can be to the largest so far."""

    def __init__(self, bits: int, where: str, jump_max: int = 100_000) -> None:
        self._size, self._where, self._jump_max = 1 << bits, where, jump_max
        self._top: int | None = None

    def next(self, number: int) -> int:
        """Raises UsageError for a number that cannot follow."""
        if self._top is None:
            self._top = number
            return number
        ahead = (number - self._top + self._size // 2) % self._size - self._size // 2
        if abs(ahead) > self._jump_max:
            raise UsageError(
                f"{self._where}: got sequence number {number} after {self._top % self._size}; allowed: steps of "
                f"{self._jump_max} or less; there may be another number, or several senders"
            )
        self._top = max(self._top, self._top + ahead)
        return self._top + min(ahead, 0)


def counted(left_out: Counter[str]) -> dict[str, int]:
    """The most frequent reason first."""
    return dict(left_out.most_common())
