"""The quadratic cost of each step along k, and its terms of the state and of the applied input."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from testbed.orchestrator.report.derived import Vector, as_vector
from testbed.orchestrator.report.figures import axes as common
from testbed.orchestrator.report.svg import WIDTH_IN, colour
from testbed.orchestrator.summary import CostFigures, Series

_LOG_FROM_RATIO = 100.0


def draw(cost: CostFigures, completed_steps: int) -> Figure:
    """The figure; at least one step."""
    figure = Figure(figsize=(WIDTH_IN, 2.5))
    axes = figure.subplots()
    k = common.steps_axis(axes, completed_steps)
    step, stderr = as_vector(cost.step_mean), as_vector(cost.step_stderr)
    low, high = common.interval(step, stderr)
    log = _logarithmic(step)
    floor = float(np.min(step[step > 0], initial=1.0)) / 10.0 if log else 0.0
    common.fill(axes, k, common.every(np.maximum(low, floor)), common.every(high), colour(0))
    common.single(axes, k, common.every(step), colour(0))
    lines = [axes.lines[0]]
    for index, series in enumerate((cost.state_mean, cost.input_mean), start=1):
        lines += axes.plot(k, common.every(_shown(series)), color=colour(index), linewidth=1.0)
    common.literal_legend(axes, lines, ["cost", "of the state", "of the input"], loc="best", ncols=3)
    axes.set_xlabel("step $k$")
    axes.set_ylabel("cost of a step")
    if log:
        axes.set_yscale("log")
    else:
        axes.set_ylim(bottom=0.0)
    return figure


def _shown(series: Series) -> Vector:
    values = as_vector(series)
    return np.where(np.abs(values) < common.LARGEST, values, np.nan)


def _logarithmic(values: Vector) -> bool:
    positive = values[np.isfinite(values) & (values > 0)]
    return bool(positive.size and positive.max() > _LOG_FROM_RATIO * np.median(positive))
