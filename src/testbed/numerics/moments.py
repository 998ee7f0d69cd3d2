"""Means and standard errors over lanes that do not depend on how the lanes were split.

A sum of floating-point numbers depends on the order of its terms. Here the order is fixed by the lanes themselves: they
are taken in groups of 64 in a row, each group is summed as a whole, whichever packets brought its lanes, and the
groups are merged in order. Within a group the deviations are taken from the group's own mean, and
groups are merged by the formula of Chan, Golub and LeVeque (The American Statistician 37, 1983), so that nothing
cancels. A mean is corrected once by the mean of what is left: equal values have exactly their mean and no spread.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from testbed.numerics.lanes import Floats

GROUP = 64
Result = tuple[int, float | None, float | None]
"""Number of values, their mean, and its standard error."""


class LaneMoments:
    """Count, mean and squared deviations of F figures over the lanes 0 … lanes − 1, brought in blocks in any order.

    Values that are not finite are left out and counted.
    """

    def __init__(self, figures: int, lanes: int) -> None:
        groups = -(-lanes // GROUP)
        self._figures, self._lanes = figures, lanes
        self._count = np.zeros((figures, groups))
        self._mean = np.zeros((figures, groups))
        self._squares = np.zeros((figures, groups))
        self._partial: dict[int, tuple[Floats, int]] = {}

    def add(self, lane: int, values: Floats) -> None:
        """Values of shape (F, M) of the lanes lane … lane + M − 1."""
        end, position = lane + values.shape[1], lane
        while position < end:
            group = position // GROUP
            begin, stop = group * GROUP, min((group + 1) * GROUP, self._lanes)
            if position == begin and end >= stop:
                whole = (end - position) // GROUP if stop - begin == GROUP else 1
                taken = whole * (stop - begin)
                block = values[:, position - lane : position - lane + taken]
                self._reduce(group, block.reshape(self._figures, whole, stop - begin))
            else:
                taken = min(end, stop) - position
                self._gather(
                    group, position - begin, values[:, position - lane : position - lane + taken], stop - begin
                )
            position += taken

    def results(self) -> list[Result]:
        """Of each figure; None where there are too few values."""
        count, mean, squares = self._count, self._mean, self._squares
        n = count.sum(axis=1)
        with np.errstate(all="ignore"):
            rough = (count * mean).sum(axis=1) / n
            centre = rough + (count * (mean - rough[:, None])).sum(axis=1) / n
            away = mean - centre[:, None]
            spread = squares.sum(axis=1) + (count * away * away).sum(axis=1)
            stderr = np.sqrt(spread / (n * (n - 1.0)))
        return [
            (int(k), m if k else None, e if k > 1 else None)
            for k, m, e in zip(n.tolist(), centre.tolist(), stderr.tolist(), strict=True)
        ]

    def _gather(self, group: int, offset: int, values: Floats, size: int) -> None:
        buffer, filled = self._partial.pop(group, (None, 0))
        if buffer is None:
            buffer = np.empty((self._figures, size))
        buffer[:, offset : offset + values.shape[1]] = values
        filled += values.shape[1]
        if filled == size:
            self._reduce(group, buffer[:, None, :])
        else:
            self._partial[group] = buffer, filled

    def _reduce(self, group: int, values: Floats) -> None:
        """Whole groups from ``group`` on: values (F, G, lanes of a group). What overflows has no figure."""
        with np.errstate(over="ignore", invalid="ignore"):
            self._reduce_quietly(group, values)

    def _reduce_quietly(self, group: int, values: Floats) -> None:
        size = values.shape[2]
        rough = values.sum(axis=2) / size
        mean = rough + (values - rough[:, :, None]).sum(axis=2) / size
        away = values - mean[:, :, None]
        squares = np.multiply(away, away, out=away).sum(axis=2)
        self._set((slice(None), slice(group, group + values.shape[1])), size, mean, squares)
        for figure, i in np.argwhere(~np.isfinite(mean)):
            usable = values[figure, i][np.isfinite(values[figure, i])]
            centre = usable.sum() / len(usable) if len(usable) else 0.0
            self._set((figure, group + i), len(usable), centre, np.square(usable - centre).sum())

    def _set(self, at: Any, count: int, mean: Any, squares: Any) -> None:
        self._count[at], self._mean[at], self._squares[at] = count, mean, squares
