"""One panel for each estimator, with common axes."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from testbed.orchestrator.report.figures import axes as common
from testbed.orchestrator.report.svg import WIDTH_IN, colour
from testbed.orchestrator.summary import Summary

_PANEL_HEIGHT_IN = 1.7
_TITLE_LENGTH_MAX = 72


def panels(summary: Summary, ylabel: str) -> tuple[Figure, list[Axes]]:
    """A figure with a titled panel for each estimator; at least one estimator and one step."""
    names = list(summary.estimators)
    columns = 1 if len(names) == 1 else 2 if len(names) in (2, 4) else 3
    rows = -(-len(names) // columns)
    figure = Figure(figsize=(WIDTH_IN, 0.5 + _PANEL_HEIGHT_IN * rows + (0.5 if rows == 1 else 0.0)))
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    flat: list[Axes] = list(grid.flat)
    for index, axes in enumerate(flat):
        if index >= len(names):
            axes.set_visible(False)
            continue
        title = common.shortened(names[index], _TITLE_LENGTH_MAX // columns)
        axes.set_title(title, color=colour(index), loc="left", fontweight="bold", parse_math=False)
        if index + columns >= len(names):
            axes.tick_params(labelbottom=True)
            axes.set_xlabel("step $k$")
    figure.supylabel(ylabel, fontsize=9)
    return figure, flat[: len(names)]
