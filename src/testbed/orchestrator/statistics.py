"""Figures of one estimator: means and standard errors over lanes, step by step."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.numerics.lanes import (
    Cholesky,
    Component,
    Floats,
    Matrix,
    Vector,
    dot,
    many_lanes,
    one_lane,
    subtract,
    trace,
)
from testbed.numerics.moments import LaneMoments, Result
from testbed.numerics.symbols import Shape
from testbed.orchestrator.lane_windows import LaneWindows

Arrays = dict[str, NDArray[Any]]

LANE_FIGURES = ("trace_P", "squared_error", "nees")
"""Those that are kept of each lane."""
ERROR_FIGURES = (*LANE_FIGURES, "excess")
Figures = dict[str, Component]


def error_figures(x: Vector, x_hat: Vector, P: Matrix) -> Figures:
    """tr P, ‖x − x̂‖², (x − x̂)' P⁻¹ (x − x̂) and ‖x − x̂‖² − tr P of every lane."""
    lanes = 1 if isinstance(x[0], float) else len(x[0])
    compute = _compute(len(x), lanes)
    return dict(zip(ERROR_FIGURES, compute(x, x_hat, P), strict=True))


def prepare(n: int, lanes: int) -> None:
    """Make the code that ``error_figures`` needs for blocks of that many lanes, which may take a second."""
    _compute(n, lanes)


def _figures(x: Vector, x_hat: Vector, P: Matrix) -> tuple[Component, ...]:
    error = subtract(x, x_hat)
    squared, spread = dot(error, error), trace(P)
    return spread, squared, Cholesky(P).quadratic(error), squared - spread


@lru_cache
def _compute(n: int, lanes: int) -> Callable[..., tuple[Component, ...]]:
    arguments: tuple[Shape, ...] = (("vector", n), ("vector", n), ("symmetric", n))
    results: tuple[Shape, ...] = (("scalar", 1),) * len(ERROR_FIGURES)
    if lanes == 1:
        return one_lane(_figures, arguments, results)
    return many_lanes(_figures, arguments, results, lanes)


class Series:
    """Mean and standard error over lanes of some figures along k; a step's lanes may come in any blocks and order.

    ``kept``: how many of the first of them are kept of each lane, averaged over windows of steps with these ``ends``.
    """

    def __init__(self, names: tuple[str, ...], lanes: int, *, kept: int = 0, ends: tuple[int, ...] = ()) -> None:
        self.names, self._lanes = names, lanes
        self._kept = names[:kept]
        self._windows = LaneWindows(ends, kept, lanes) if kept else None
        self._open: dict[int, Figures | LaneMoments] = {}
        self._of_lanes: dict[int, list[tuple[int, Floats]]] = {}
        self._closed: list[Figures | list[Result] | None] = []

    def add(self, step: int, lane: int, figures: Figures) -> None:
        """Take in the figures of a block of lanes; what is not among them has no value at this step."""
        if self._lanes == 1:
            self._open[step] = figures
            return
        moments = self._open.get(step)
        if moments is None:
            moments = self._open[step] = LaneMoments(len(self.names), self._lanes)
        assert isinstance(moments, LaneMoments)
        absent = np.full(np.shape(next(iter(figures.values()))), np.nan)
        values = np.array([figures.get(name, absent) for name in self.names]).reshape(len(self.names), -1)
        moments.add(lane, values)
        if self._windows is not None:
            self._of_lanes.setdefault(step, []).append((lane, values))

    def begin_at(self, first: int, completed: int) -> None:
        """There are no figures before step ``first``; so many steps are complete already."""
        self._closed += [None] * completed
        if self._windows is not None:
            self._windows.begin_at(first)

    def close(self, step: int) -> None:
        """The next step is complete: keep its figures and forget the sums."""
        figures = self._open.pop(step, None)
        if not isinstance(figures, LaneMoments):
            self._closed.append(figures)
            return
        self._closed.append(figures.results())
        if self._windows is not None:
            for lane, values in self._of_lanes.pop(step):
                self._windows.add(step, lane, values)

    def drop(self, step: int) -> None:
        """Forget what has come of a step that is not closed."""
        self._open.pop(step, None)
        self._of_lanes.pop(step, None)

    def figures(self, after: int, to: int) -> Arrays:
        """What stays of the closed steps after + 1 … to, and of the windows that end there."""
        rows = self._closed[after:to]
        there = np.array([row is not None for row in rows], dtype=np.uint8)
        arrays = {"there": there, "rows": np.array([self._numbers(row) for row in rows])}
        if self._by_window is not None:
            arrays["windows"] = self._by_window.closed(after, to)
        return arrays

    def put_figures(self, after: int, to: int, arrays: Arrays) -> None:
        """Have what ``figures`` gave, which may go further, up to step ``to``, and nothing after it."""
        closed, count = self._closed, to - after
        del closed[after:]
        closed += [None] * (after - len(closed))
        for there, row in zip(arrays["there"][:count].tolist(), arrays["rows"][:count].tolist(), strict=True):
            closed.append(self._closed_row(row) if there else None)
        if self._by_window is not None:
            self._by_window.put_closed(after, to, arrays["windows"])

    def state(self, step: int) -> Arrays:
        """What outlives step ``step``, the last that is closed, beside the figures."""
        return {} if self._by_window is None else {"open": self._by_window.open_at(step)}

    def put_state(self, step: int, arrays: Arrays) -> None:
        """Have what ``state`` gave, after the figures up to that step."""
        self._closed += [None] * (step - len(self._closed))
        if self._by_window is not None:
            self._by_window.open_at(step)[:] = arrays["open"]

    @property
    def _by_window(self) -> LaneWindows | None:
        """Sums that are made on the way; of one lane they are made at the end."""
        return None if self._lanes == 1 else self._windows

    def _numbers(self, row: Figures | list[Result] | None) -> list[float] | list[list[float]]:
        """A closed step in numbers; NaN for what there is not."""
        if self._lanes == 1:
            assert not isinstance(row, list)
            return [(row or {}).get(name, math.nan) for name in self.names]
        if row is None:
            return [[math.nan] * 3] * len(self.names)
        assert isinstance(row, list)
        return [[count, _or_nan(mean), _or_nan(stderr)] for count, mean, stderr in row]

    def _closed_row(self, row: list[Any]) -> Figures | list[Result]:
        """From the numbers of a closed step."""
        if self._lanes == 1:
            return dict(zip(self.names, row, strict=True))
        return [(int(n), mean if n else None, stderr if n > 1 else None) for n, mean, stderr in row]

    def mean_at(self, step: int) -> dict[str, float | None] | None:
        """Of each figure at one closed step; None where there are no figures."""
        closed = self._closed[step - 1]
        return (
            None if closed is None else {n: mean for n, (_, mean, _) in zip(self.names, self._row(closed), strict=True)}
        )

    @property
    def mean(self) -> dict[str, list[float | None]]:
        """Of each figure, along the closed steps; None where it has no value."""
        return {name: [mean for _, mean, _ in results] for name, results in self._results().items()}

    @property
    def stderr(self) -> dict[str, list[float | None]]:
        """As ``mean``; None also with one lane."""
        return {name: [stderr for _, _, stderr in results] for name, results in self._results().items()}

    @property
    def undefined(self) -> int:
        """Lane-steps without a NEES."""
        if "nees" not in self.names:
            return 0
        results = self._results()["nees"]
        there = [result for result, closed in zip(results, self._closed, strict=True) if closed is not None]
        return self._lanes * len(there) - sum(count for count, _, _ in there)

    def by_lane(self, last: int) -> dict[str, Floats]:
        """Of each figure that is kept of each lane: its means over the windows up to a closed step, (windows, lanes).

        Not finite where a step has no value.
        """
        assert self._windows is not None
        windows = self._windows
        if self._lanes == 1:  # nothing was added on the way: the steps are all here
            windows = LaneWindows(windows.ends, len(self._kept), 1)
            rows = [row if isinstance(row, dict) else {} for row in self._closed[:last]]
            windows.add_from_start(np.array([[row.get(name, math.nan) for row in rows] for name in self._kept]))
        means = windows.means(last)
        return {name: means[:, i] for i, name in enumerate(self._kept)}

    def _results(self) -> dict[str, list[Result]]:
        rows = [[_ABSENT] * len(self.names) if row is None else self._row(row) for row in self._closed]
        return {name: [row[i] for row in rows] for i, name in enumerate(self.names)}

    def _row(self, closed: Figures | list[Result]) -> list[Result]:
        if isinstance(closed, list):
            return closed
        values = [closed.get(name, math.nan) for name in self.names]
        return [(1, value, None) if math.isfinite(value) else _ABSENT for value in values]


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value


_ABSENT: Result = (0, None, None)

Progress = Callable[[int, int], None]
"""Called with (completed steps, steps)."""
