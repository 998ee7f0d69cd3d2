"""Differences between two estimators along k, a panel for each pair."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from testbed.orchestrator.comparison import Comparison, Pair
from testbed.orchestrator.report.comparison_text import figure_name
from testbed.orchestrator.report.figures import axes as common
from testbed.orchestrator.report.svg import WIDTH_IN, colour

_PANEL_HEIGHT_IN = 1.6
_TITLE_LENGTH_MAX = 90
PANELS_MAX = 24
"""Pairs that are drawn; the CSV has them all."""


def draw(found: Comparison) -> Figure:
    """The figure; at least one pair."""
    shown = found.pairs[:PANELS_MAX]
    columns = 1 if len(shown) == 1 else 2
    rows = -(-len(shown) // columns)
    figure = Figure(figsize=(WIDTH_IN, 0.6 + _PANEL_HEIGHT_IN * rows))
    grid = figure.subplots(rows, columns, squeeze=False)
    for index, axes in enumerate(grid.flat):
        if index >= len(shown):
            axes.set_visible(False)
            continue
        pair = shown[index]
        title = common.shortened(f"{found.name(pair.a)} − {found.name(pair.b)}", _TITLE_LENGTH_MAX // columns)
        axes.set_title(title, loc="left", fontweight="bold", parse_math=False)
        _panel(axes, pair, colour(index))
        if index + columns >= len(shown):
            axes.set_xlabel("step $k$")
    figure.supylabel(f"difference of {figure_name(found)}", fontsize=9, parse_math=False)
    return figure


def _panel(axes: Axes, pair: Pair, line_colour: str) -> None:
    course = pair.course
    common.steps_axis(axes, int(course.ends[-1]))
    begins = np.concatenate([[1], course.ends[:-1] + 1])
    stride = common.stride(len(course.ends))
    k, mean = ((begins + course.ends) / 2.0)[::stride], course.mean[::stride]
    axes.axhline(0.0, color="black", linewidth=0.8, linestyle=common.LOWER_DASH)
    axes.axvspan(pair.first - 0.5, pair.last + 0.5, color="#f0f0ee", linewidth=0, zorder=0.5)
    if course.stderr is not None:
        common.fill(axes, k, *common.interval(mean, course.stderr[::stride]), line_colour)
    common.single(axes, k, mean, line_colour)
