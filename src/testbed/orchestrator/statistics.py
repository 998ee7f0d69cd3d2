"""Figures of one estimator: exact means and standard errors over lanes, step by step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from scipy.special import gammaincinv

from testbed.numerics.exact import ExactMoments
from testbed.numerics.lanes import Cholesky, Component, Matrix, Vector, dot, subtract, trace

ERROR_FIGURES = ("trace_P", "squared_error", "nees", "excess")
Figures = dict[str, Component]


def error_figures(x: Vector, x_hat: Vector, P: Matrix) -> Figures:
    """tr P, ‖x − x̂‖², (x − x̂)' P⁻¹ (x − x̂) and ‖x − x̂‖² − tr P of every lane."""
    error = subtract(x, x_hat)
    squared, spread = dot(error, error), trace(P)
    return {
        "trace_P": spread,
        "squared_error": squared,
        "nees": Cholesky(P).quadratic(error),
        "excess": squared - spread,
    }


def nees_band_95(n: int, lanes: int) -> tuple[float, float]:
    """The 95 % band of the mean NEES over lanes: χ² with n·lanes degrees of freedom, divided by lanes."""
    low, high = (2.0 * float(gammaincinv(0.5 * n * lanes, level)) / lanes for level in (0.025, 0.975))
    return low, high


@dataclass
class Series:
    """Mean and standard error of some figures along k, from moments that are exact until a step is closed."""

    names: tuple[str, ...]
    mean: dict[str, list[float | None]] = field(default_factory=dict)
    stderr: dict[str, list[float | None]] = field(default_factory=dict)
    undefined: int = 0
    _open: dict[int, dict[str, ExactMoments]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in self.names:
            self.mean[name], self.stderr[name] = [], []

    def add(self, step: int, figures: Figures) -> None:
        """Take in the figures of a block of lanes."""
        moments = self._open.get(step)
        if moments is None:
            moments = self._open[step] = {name: ExactMoments() for name in self.names}
        for name, component in figures.items():
            moments[name].add(component)

    def close(self, step: int) -> None:
        """The next step is complete: round its figures and forget the sums."""
        moments = self._open.pop(step, None)
        for name in self.names:
            self.mean[name].append(None if moments is None else moments[name].mean)
            self.stderr[name].append(None if moments is None else moments[name].standard_error)
        if moments is not None and "nees" in moments:
            self.undefined += moments["nees"].undefined


Progress = Callable[[int, int], None]
"""Called with (completed steps, steps)."""
