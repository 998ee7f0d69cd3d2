"""Vertical marks in the figures along k, where events took effect."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from testbed.orchestrator.report.figures.axes import shortened
from testbed.orchestrator.report.svg import GREY
from testbed.orchestrator.summary import Happened, Summary

MARKS_MAX = 40
"""More marks than this are not drawn: the table has them."""
LABELS_MAX = 12
_LABEL_LENGTH_MAX = 24


def shown(summary: Summary) -> list[Happened]:
    """The events that took effect at a completed step; none where there are too many to tell them apart."""
    done = [event for event in summary.events if event.ok and 1 <= event.step <= summary.completed_steps]
    return done if len(done) <= MARKS_MAX else []


def mark_events(figure: Figure, summary: Summary) -> None:
    """Mark the steps in every panel whose axis is k, with labels in the first of them."""
    events = shown(summary)
    panels = [axes for axes in figure.axes if axes.get_visible() and _along_steps(axes, summary)]
    for axes in panels:
        for step in {event.step for event in events}:
            axes.axvline(step, color=GREY, linewidth=0.7, linestyle=(0, (1, 1)), zorder=1.6)
    if panels and len(events) <= LABELS_MAX:
        _label(panels[0], events)


def _along_steps(axes: Axes, summary: Summary) -> bool:
    low, high = axes.get_xlim()
    return low <= 1.0 and high >= summary.completed_steps


def _label(axes: Axes, events: Sequence[Happened]) -> None:
    """Those of one step in one label, beside its line, from the top downwards."""
    by_step: dict[int, list[str]] = {}
    for event in events:
        by_step.setdefault(event.step, []).append(shortened(event.label, _LABEL_LENGTH_MAX))
    for step, labels in by_step.items():
        axes.annotate(
            "; ".join(labels),
            (step, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(2, -2),
            textcoords="offset points",
            rotation=90,
            ha="left",
            va="top",
            fontsize=6,
            color=GREY,
            parse_math=False,
        )
