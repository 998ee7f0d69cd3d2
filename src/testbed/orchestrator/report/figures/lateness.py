"""How long after the beginning of each step its control left and its estimates came, on the wall clock."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from testbed.orchestrator.realtime_figures import RealTime
from testbed.orchestrator.report.derived import as_vector
from testbed.orchestrator.report.figures import axes as common
from testbed.orchestrator.report.svg import GREY, WIDTH_IN, colour
from testbed.orchestrator.summary import Summary


def draw(summary: Summary, realtime: RealTime) -> Figure:
    """The figure; at least one step."""
    figure = Figure(figsize=(WIDTH_IN, 2.6))
    axes = figure.subplots()
    k = common.steps_axis(axes, summary.completed_steps)
    lines = {"control": ("control/sent", "black")}
    lines |= {name: (f"estimate/{name}", colour(index)) for index, name in enumerate(summary.estimators)}
    shown, least = [], realtime.deadline_us
    for topic, shade in lines.values():
        values = common.every(as_vector(realtime.stages[topic].published_us))
        values[values <= 0] = np.nan
        shown.append(axes.plot(k, values, color=shade, linewidth=0.8, marker="o" if len(k) <= 12 else "")[0])
        least = min(least, np.nanmin(values, initial=np.inf))
    shown.append(Line2D([], [], color=GREY, linestyle="--"))
    axes.axhline(realtime.deadline_us, color=GREY, linestyle="--", linewidth=1.0)
    axes.set_yscale("log")
    axes.set_ylim(bottom=max(least, 1.0) / 1.5)
    axes.set_xlabel("step $k$")
    axes.set_ylabel("time since $t_k$ (µs)")
    common.literal_legend(figure, shown, [*lines, "deadline"], loc="outside upper center", ncols=4)
    return figure
