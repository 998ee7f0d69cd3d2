"""Figures of each lane, averaged over windows of steps: what it takes to pair lanes between runs, in bounded memory."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterable

import numpy as np

from testbed.numerics.lanes import Floats

LANE_WINDOWS_MAX = 2**16
"""Values of a figure that are kept, about: up to that many lanes × steps, every step is a window of its own."""


def first_settled(last: int) -> int:
    """The first step of the last quarter of the steps 1 … last."""
    return last - max(1, last // 4) + 1


def window_ends(steps: int, lanes: int, lasts: Iterable[int]) -> tuple[int, ...]:
    """The last step of each window.

    Windows are as short as the bound allows, and of one length, but for cuts where the last quarter of the steps
    1 … last begins and ends, for each of ``lasts``.
    """
    length = -(-steps // max(1, LANE_WINDOWS_MAX // lanes))
    cuts = {steps, *range(length, steps, length)}
    for last in lasts:
        cuts |= {first_settled(last) - 1, last}
    return tuple(sorted(cuts - {0}))


class LaneWindows:
    """Sums over windows of F figures of each lane. A value that is not finite makes its window not finite."""

    def __init__(self, ends: tuple[int, ...], figures: int, lanes: int) -> None:
        self.ends = ends
        self._figures = figures
        self._sums = np.zeros((len(ends), figures, lanes))

    def add(self, step: int, lane: int, values: Floats) -> None:
        """Values of shape (F or more, M) of the lanes lane … lane + M − 1; those of a lane come in order of steps."""
        self._sums[bisect_left(self.ends, step), :, lane : lane + values.shape[1]] += values[: self._figures]

    def closed(self, after: int, to: int) -> Floats:
        """(W, F, lanes): sums of the windows whose last step is one of after + 1 … to."""
        sums: Floats = self._sums[bisect_right(self.ends, after) : bisect_right(self.ends, to)]
        return sums

    def put_closed(self, after: int, to: int, sums: Floats) -> None:
        """Have the sums that ``closed`` gave, which may go further."""
        begin, end = bisect_right(self.ends, after), bisect_right(self.ends, to)
        self._sums[begin:end] = sums[: end - begin]

    def open_at(self, step: int) -> Floats:
        """(F, lanes): sums of the window that the step after ``step`` belongs to; may be written to."""
        sums: Floats = self._sums[min(bisect_right(self.ends, step), len(self.ends) - 1)]
        return sums

    def begin_at(self, first: int) -> None:
        """There are no values before step ``first``: the windows that begin before it have no mean."""
        for i, begin in enumerate([0, *self.ends[:-1]]):
            if begin + 1 < first:
                self._sums[i] = np.nan

    def add_from_start(self, values: Floats) -> None:
        """Values of shape (F, K) of lane 0 at the steps 1 … K."""
        begins = [0, *(end for end in self.ends if end < values.shape[1])]
        if values.size:
            self._sums[: len(begins), :, 0] += np.add.reduceat(values, begins, axis=1).T

    def means(self, last: int) -> Floats:
        """(W, F, lanes): means over the windows that end at step ``last`` or before."""
        whole = sum(end <= last for end in self.ends)
        means: Floats = self._sums[:whole] / np.diff(self.ends[:whole], prepend=0)[:, None, None]
        return means
