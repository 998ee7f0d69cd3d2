"""Squared error less the estimator's own claim tr P, relative to it: zero for an estimator that is honest."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from testbed.orchestrator.report.derived import Vector, excess_consistent, relative_excess
from testbed.orchestrator.report.figures import axes as common
from testbed.orchestrator.report.figures.panels import panels
from testbed.orchestrator.report.svg import colour
from testbed.orchestrator.summary import EstimatorFigures, Summary

_SYMLOG_FROM = 20.0


def draw(summary: Summary) -> Figure:
    """The figure; at least one estimator and one step."""
    figure, grid = panels(
        summary, r"$(\mathrm{E}\,\|x_k-\hat{x}_k\|^2-\mathrm{tr}\,\mathrm{E}[P_k])\,/\,\mathrm{tr}\,\mathrm{E}[P_k]$"
    )
    estimators = list(summary.estimators.values())
    low, high, symlog = _limits(estimators)
    for index, axes in enumerate(grid):
        k = common.steps_axis(axes, summary.completed_steps)
        if symlog:
            axes.set_yscale("symlog", linthresh=1.0)
        _panel(axes, estimators[index], k, colour(index))
        axes.set_ylim(low, high)
    return figure


def _panel(axes: Axes, figures: EstimatorFigures, k: Vector, line_colour: str) -> None:
    excess, stderr = (common.every(values) for values in relative_excess(figures))
    apart = common.every(excess_consistent(figures)) == 0
    axes.axhline(0.0, color="black", linewidth=0.8, linestyle=common.LOWER_DASH)
    common.fill(axes, k, *common.interval(excess, stderr), line_colour)
    common.single(axes, k, excess, line_colour)
    common.dots(axes, k, excess, apart)


def _limits(estimators: list[EstimatorFigures]) -> tuple[float, float, bool]:
    """Limits for every mean and, unless they dwarf the means, the intervals; whether a symlog axis is needed."""
    relative = [relative_excess(figures) for figures in estimators]
    means = _finite(np.concatenate([mean for mean, _ in relative]))
    ends = _finite(np.concatenate([np.concatenate(common.interval(mean, stderr)) for mean, stderr in relative]))
    size = max(float(np.abs(means).max(initial=0.0)), 0.05)
    low = max(float(ends.min(initial=0.0)), -3 * size)
    high = min(float(ends.max(initial=0.0)), 3 * size)
    low, high = min(low, float(means.min(initial=0.0))), max(high, float(means.max(initial=0.0)))
    if max(-low, high) > _SYMLOG_FROM:
        return max(1.5 * low - 1.0, -common.LARGEST), min(1.5 * high + 1.0, common.LARGEST), True
    margin = max(0.06 * (high - low), 0.02)
    return low - margin, high + margin, False


def _finite(values: Vector) -> Vector:
    return values[np.isfinite(values)]
