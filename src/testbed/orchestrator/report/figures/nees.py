"""Normalised estimation error squared along k, with the band that it should keep to."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from testbed.orchestrator.report.derived import Vector, as_vector, nees_in_band
from testbed.orchestrator.report.figures import axes as common
from testbed.orchestrator.report.figures.panels import panels
from testbed.orchestrator.report.svg import colour
from testbed.orchestrator.summary import EstimatorFigures, Summary

_LOG_FROM_RATIO = 20.0


def draw(summary: Summary) -> Figure:
    """The figure; at least one estimator and one step."""
    figure, grid = panels(summary, r"mean NEES, $(x_k-\hat{x}_k)'P_k^{-1}(x_k-\hat{x}_k)$")
    estimators = list(summary.estimators.values())
    low, high, log = _limits(estimators)
    for index, axes in enumerate(grid):
        k = common.steps_axis(axes, summary.completed_steps)
        _panel(axes, estimators[index], k, colour(index))
        axes.set_yscale("log" if log else "linear")
        axes.set_ylim(low, high)
    return figure


def _panel(axes: Axes, figures: EstimatorFigures, k: Vector, line_colour: str) -> None:
    nees = common.every(as_vector(figures.nees_mean))
    outside = common.every(nees_in_band(figures)) == 0
    band_low, band_high = figures.nees_band_95
    axes.axhspan(band_low, band_high, color="#d9d9d9", linewidth=0, zorder=0.5)
    common.single(axes, k, nees, line_colour)
    common.dots(axes, k, nees, outside)


def _limits(estimators: list[EstimatorFigures]) -> tuple[float, float, bool]:
    """Limits that hold every band and every figure, and whether a logarithmic axis is needed for that."""
    values = np.concatenate([as_vector(e.nees_mean) for e in estimators])
    bands = [limit for e in estimators for limit in e.nees_band_95 if limit > 0]
    values = np.append(values[np.isfinite(values) & (values > 0)], bands or [1.0])
    top, band_top = float(values.max()), max(bands, default=1.0)
    if top > _LOG_FROM_RATIO * band_top:
        return max(float(values.min()), min(bands, default=1.0) / 10) / 1.5, min(top * 1.5, common.LARGEST), True
    return 0.0 if values.min() < 0.5 * band_top else 0.9 * float(values.min()), top * 1.05, False
