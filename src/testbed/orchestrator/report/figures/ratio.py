"""Mean tr P relative to the lower bound: tells estimators apart that coincide beside their common growth."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from testbed.orchestrator.report.derived import Vector, as_vector
from testbed.orchestrator.report.figures import axes as common
from testbed.orchestrator.report.svg import colour, marker
from testbed.orchestrator.summary import Series, Summary

_LOG_FROM = 10.0
_UPPER_ROOM = 1.5


def ratios(summary: Summary) -> list[Vector]:
    """Mean tr P over the mean of the lower bound, for each estimator; empty when there is none to show."""
    if summary.bounds is None:
        return []
    found = [_ratio(figures.trace_P_mean, summary.bounds.lower_mean) for figures in summary.estimators.values()]
    return found if any(np.isfinite(ratio).any() for ratio in found) else []


def draw_ratios(axes: Axes, summary: Summary, k: Vector) -> None:
    """Draw `ratios`, which must not be empty, and that of the upper bound as far as it has room."""
    shown = ratios(summary)
    values = np.concatenate([ratio[np.isfinite(ratio)] for ratio in shown])
    low, high = min(1.0, float(values.min())), max(1.0, float(values.max()))
    log = high > _LOG_FROM * low > 0
    for index, ratio in enumerate(shown):
        axes.plot(
            k,
            common.every(ratio),
            color=colour(index),
            linewidth=1.1,
            marker=marker(index),
            markersize=3.4,
            markeredgecolor="white",
            markeredgewidth=0.4,
            markevery=common.sparse(len(k), index, len(shown)),
        )
    axes.axhline(1.0, color="black", linestyle=common.LOWER_DASH, linewidth=1.0)
    if summary.bounds is not None and summary.bounds.valid_upper_mean is not None:
        upper = _ratio(summary.bounds.valid_upper_mean, summary.bounds.lower_mean)
        axes.plot(k, common.every(upper), color="black", linestyle=common.UPPER_DASH, linewidth=1.2)
        top = float(np.max(upper[np.isfinite(upper)], initial=high))
        high = min(top, high + _UPPER_ROOM * max(high - low, 0.01))
    if log:
        axes.set_yscale("log")
        axes.set_ylim(low / 1.3, min(high * 1.3, common.LARGEST))
    else:
        margin = 0.08 * max(high - low, 0.01)
        axes.set_ylim(low - margin, high + margin)


def _ratio(series: Series, lower_series: Series) -> Vector:
    lower = as_vector(lower_series)
    lower[lower <= 0] = np.nan
    with np.errstate(over="ignore"):
        ratio = as_vector(series) / lower
    return np.where(np.isfinite(ratio), ratio, np.nan)
