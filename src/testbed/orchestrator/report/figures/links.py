"""Loss rate and mean burst of each link beside what its loss model says."""

from __future__ import annotations

from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from testbed.orchestrator.report.figures import axes as common
from testbed.orchestrator.report.link_model import Expected
from testbed.orchestrator.report.svg import COLOURS, WIDTH_IN
from testbed.orchestrator.summary import Z_95, Summary

_UNKNOWN = Expected(None, None, None, None)
_RANGE: dict[str, Any] = {"color": "#9a9a9a", "linewidth": 5, "alpha": 0.45, "solid_capstyle": "butt"}
_MODEL: dict[str, Any] = {"linestyle": "", "marker": "|", "markersize": 13, "markeredgewidth": 1.3, "color": "black"}
_COUNTED: dict[str, Any] = {"linestyle": "", "marker": "o", "markersize": 4, "color": COLOURS[0]}


def draw(summary: Summary, expected: dict[str, Expected]) -> Figure:
    """The figure; at least one link."""
    names = list(summary.links)
    figure = Figure(figsize=(WIDTH_IN, 1.15 + 0.32 * len(names)))
    loss, burst = figure.subplots(1, 2, sharey=True)
    for row, name in enumerate(names):
        counted, model = summary.links[name], expected.get(name, _UNKNOWN)
        _row(loss, row, counted.loss_rate, model.loss_rate, model.loss_rate_deviation)
        _row(burst, row, counted.mean_burst, model.mean_burst, model.mean_burst_deviation)
    loss.set_yticks(range(len(names)), [common.shortened(name) for name in names], parse_math=False)
    loss.set_ylim(len(names) - 0.5, -0.5)
    loss.set_xlabel("loss rate")
    burst.set_xlabel("mean burst (packets)")
    loss.set_xlim(left=0.0, right=max(loss.get_xlim()[1], 0.05))
    burst.set_xlim(left=0.0)
    for axes in (loss, burst):
        axes.tick_params(axis="y", length=0)
        axes.spines["left"].set_visible(False)
    marks = {
        "counted": Line2D([], [], **_COUNTED),
        "model": Line2D([], [], **_MODEL),
        "model, 95 % of runs": Line2D([], [], **_RANGE),
    }
    figure.legend(list(marks.values()), list(marks), loc="outside upper center", ncols=3)
    return figure


def _row(axes: Axes, row: int, counted: float | None, model: float | None, deviation: float | None) -> None:
    if model is not None:
        half = Z_95 * (deviation or 0.0)
        axes.plot([model - half, model + half], [row, row], **_RANGE)
        axes.plot(model, row, **_MODEL)
    if counted is not None:
        axes.plot(counted, row, **_COUNTED)
