"""Figures of one estimator: means and standard errors over lanes, step by step."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache

import numpy as np

from testbed.numerics.lanes import Cholesky, Component, Matrix, Vector, dot, many_lanes, one_lane, subtract, trace
from testbed.numerics.moments import LaneMoments
from testbed.numerics.symbols import Shape

ERROR_FIGURES = ("trace_P", "squared_error", "nees", "excess")
Figures = dict[str, Component]


def error_figures(x: Vector, x_hat: Vector, P: Matrix) -> Figures:
    """tr P, ‖x − x̂‖², (x − x̂)' P⁻¹ (x − x̂) and ‖x − x̂‖² − tr P of every lane."""
    lanes = 1 if isinstance(x[0], float) else len(x[0])
    compute = _compute(len(x), lanes)
    return dict(zip(ERROR_FIGURES, compute(x, x_hat, P), strict=True))


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
    """Mean and standard error over lanes of some figures along k; a step's lanes may come in any blocks and order."""

    def __init__(self, names: tuple[str, ...], lanes: int) -> None:
        self.names, self._lanes = names, lanes
        self.mean: dict[str, list[float | None]] = {name: [] for name in names}
        self.stderr: dict[str, list[float | None]] = {name: [] for name in names}
        self.undefined = 0
        self._open: dict[int, dict[str, float] | LaneMoments] = {}

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
        moments.add(lane, np.array([figures.get(name, absent) for name in self.names]).reshape(len(self.names), -1))

    def close(self, step: int) -> None:
        """The next step is complete: note its figures and forget the sums."""
        moments = self._open.pop(step, None)
        for i, name in enumerate(self.names):
            mean: float | None = None
            stderr: float | None = None
            if isinstance(moments, LaneMoments):
                count, mean, stderr = moments.result(i)
                if name == "nees":
                    self.undefined += self._lanes - count
            elif moments is not None and name in moments:
                finite = math.isfinite(moments[name])
                mean = moments[name] if finite else None
                self.undefined += name == "nees" and not finite
            self.mean[name].append(mean)
            self.stderr[name].append(stderr)


Progress = Callable[[int, int], None]
"""Called with (completed steps, steps)."""
