"""tr E[P_k] along k beside the mean squared error and the bounds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from testbed.orchestrator.report.derived import Vector, as_vector
from testbed.orchestrator.report.figures import axes as common
from testbed.orchestrator.report.figures.ratio import draw_ratios, ratios
from testbed.orchestrator.report.svg import GREY, WIDTH_IN, colour, marker
from testbed.orchestrator.summary import Summary

_UPPER_ROOM_LINEAR = 1.5
_UPPER_ROOM_LOG = 100.0
_DECADES_LOG = 2.0
_FLOOR_SHARE = 0.4  # a linear axis starts at zero when something is below this share of its end


@dataclass(frozen=True)
class Scale:
    """The vertical axis: its limits, and whether the upper bound leaves it."""

    log: bool
    low: float
    high: float
    upper_leaves: bool


def draw(summary: Summary) -> Figure:
    """The figure; at least one step must be complete."""
    if ratios(summary):
        figure = Figure(figsize=(WIDTH_IN, 5.4))
        axes, below = figure.subplots(2, 1, sharex=True, height_ratios=[2.6, 1.0])
    else:
        figure = Figure(figsize=(WIDTH_IN, 4.0))
        axes = below = figure.subplots()
    scale = choose_scale(summary)
    axes.set_yscale("log" if scale.log else "linear")
    k = common.steps_axis(axes, summary.completed_steps)
    for index in range(len(summary.estimators)):
        _draw_estimator(axes, summary, index, k, scale)
    _draw_bounds(axes, summary, k)
    axes.set_ylim(scale.low, scale.high)
    if not scale.log and not 1e-3 <= scale.high < 1e5:
        axes.ticklabel_format(axis="y", useMathText=True)  # slow to typeset, so only where a power of ten shows
    if below is not axes:
        draw_ratios(below, summary, k)
        below.set_ylabel("relative to\nlower bound")
        figure.align_ylabels([axes, below])
    below.set_xlabel("step $k$")
    axes.set_ylabel(r"$\mathrm{tr}\,\mathrm{E}[P_k]$,  $\mathrm{E}\,\|x_k-\hat{x}_k\|^2$")
    _legends(figure, summary, scale)
    return figure


def choose_scale(summary: Summary) -> Scale:
    """Fit the axis to the estimators and the lower bound; the upper bound may extend it, within reason.

    Logarithmic when the range exceeds two decades. The smallest squared errors do not count: with few lanes they come
    near zero by chance.
    """
    traces = [as_vector(e.trace_P_mean) for e in summary.estimators.values()]
    errors = [as_vector(e.squared_error_mean) for e in summary.estimators.values()]
    lower = [as_vector(summary.bounds.lower_mean)] if summary.bounds else []
    upper = (
        as_vector(summary.bounds.valid_upper_mean)
        if summary.bounds and summary.bounds.valid_upper_mean
        else np.array([])
    )
    top = _largest([*traces, *errors, *lower])
    bottom = _smallest([*traces, *lower])
    if top is None or top <= 0:
        top = _largest([upper]) or 1.0
    if bottom is None:
        bottom = top
    log = np.log10(top) - np.log10(bottom) > _DECADES_LOG
    upper_top = _largest([upper]) or 0.0
    room = _UPPER_ROOM_LOG if log else _UPPER_ROOM_LINEAR
    limit = top * room if top < 1e305 else top
    high = max(top, min(upper_top, limit))
    if log:
        return Scale(True, bottom / 1.6, min(high * 1.6, common.LARGEST), upper_top > high)
    floor = _smallest([*traces, *errors, *lower]) or 0.0
    low = 0.92 * floor if floor > _FLOOR_SHARE * high else 0.0
    return Scale(False, low, min(high * 1.06, common.LARGEST), upper_top > high)


def _largest(series: list[Vector]) -> float | None:
    values = np.concatenate([np.array([]), *series])
    values = values[np.isfinite(values)]
    return float(values.max()) if values.size else None


def _smallest(series: list[Vector]) -> float | None:
    values = np.concatenate([np.array([]), *series])
    values = values[np.isfinite(values) & (values > 0)]
    return float(values.min()) if values.size else None


def _draw_estimator(axes: Axes, summary: Summary, index: int, k: Vector, scale: Scale) -> None:
    figures = list(summary.estimators.values())[index]
    count = len(summary.estimators)
    trace, stderr = common.every(as_vector(figures.trace_P_mean)), common.every(as_vector(figures.trace_P_stderr))
    error = common.every(as_vector(figures.squared_error_mean))
    low, high = common.interval(trace, stderr)
    if scale.log:
        low = np.where(np.isfinite(low), np.maximum(low, scale.low / 10), np.nan)
        trace, error = np.where(trace > 0, trace, np.nan), np.where(error > 0, error, np.nan)
    common.fill(axes, k, low, high, colour(index))
    alone = "." if len(k) == 1 else ""
    axes.plot(k, error, color=colour(index), linewidth=0.6, alpha=0.5, marker=alone, markersize=4, zorder=1.8)
    axes.plot(
        k,
        trace,
        color=colour(index),
        linewidth=_width(index, count),
        marker=marker(index),
        markersize=3.8,
        markeredgecolor="white",
        markeredgewidth=0.4,
        markevery=common.sparse(len(k), index, count),
    )


def _width(index: int, count: int) -> float:
    """Later lines are thinner, so that one that they cover still shows at its sides."""
    return 2.4 - 1.2 * index / max(1, count - 1)


def _draw_bounds(axes: Axes, summary: Summary, k: Vector) -> None:
    if summary.bounds is None:
        return
    end = "_" if len(k) == 1 else ""
    lower = common.every(as_vector(summary.bounds.lower_mean))
    axes.plot(k, lower, color="black", linestyle=common.LOWER_DASH, linewidth=1.0, marker=end, markersize=14, zorder=3)
    if summary.bounds.valid_upper_mean is not None:
        upper = common.every(as_vector(summary.bounds.valid_upper_mean))
        axes.plot(
            k, upper, color="black", linestyle=common.UPPER_DASH, linewidth=1.2, marker=end, markersize=14, zorder=3
        )


def _legends(figure: Figure, summary: Summary, scale: Scale) -> None:
    names = list(summary.estimators)
    lines = [
        Line2D([], [], color=colour(i), linewidth=_width(i, len(names)), marker=marker(i), markeredgecolor="white",
               markeredgewidth=0.4)
        for i in range(len(names))
    ]  # fmt: skip
    meanings: dict[str, Line2D | Patch] = {
        r"$\mathrm{tr}\,\mathrm{E}[P_k]$": Line2D([], [], color=GREY, linewidth=1.6),
        r"$\mathrm{E}\,\|x_k-\hat{x}_k\|^2$": Line2D([], [], color=GREY, linewidth=0.6),
    }
    if summary.lanes > 1:
        meanings[r"$\pm 1.96$ standard errors"] = Patch(color=GREY, alpha=0.25, linewidth=0)
    if summary.bounds is not None:
        meanings[r"lower bound $\mathrm{tr}\,\mathrm{E}[P_k^{\mathrm{A}}]$"] = Line2D(
            [], [], color="black", linestyle=common.LOWER_DASH, linewidth=1.0
        )
    if summary.bounds is not None and summary.bounds.valid_upper_mean is not None:
        away = " (leaves the axes)" if scale.upper_leaves else ""
        meanings[rf"upper bound $\mathrm{{tr}}\,\mathrm{{E}}[S_k]${away}"] = Line2D(
            [], [], color="black", linestyle=common.UPPER_DASH, linewidth=1.2
        )
    if names:
        common.literal_legend(figure, lines, names, loc="outside upper center", ncols=min(len(names), 6))
    figure.legend(
        list(meanings.values()), list(meanings), loc="outside lower center", ncols=min(len(meanings), 3), fontsize=8
    )
