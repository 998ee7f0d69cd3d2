"""What the figures along k share."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from testbed.orchestrator.report.derived import Vector
from testbed.orchestrator.report.svg import GREY
from testbed.orchestrator.summary import Z_95

LARGEST = 1.7e308
"""No axis ends beyond it."""
LOWER_DASH = (0, (5, 2))
UPPER_DASH = (0, (1, 1.5))
POINTS_MAX = 2000
DOTS_STEPS_MAX = 400
_NAME_LENGTH_MAX = 40


def stride(steps: int) -> int:
    """Every how many steps a figure shows one."""
    return max(1, -(-steps // POINTS_MAX))


def every(values: Vector) -> Vector:
    """The steps of `values` that a figure shows."""
    return values[:: stride(len(values))]


def steps_axis(axes: Axes, steps: int) -> Vector:
    """Set the axis k = 1 … steps; returns the steps that are shown."""
    margin = 0.5 if steps == 1 else 0.015 * (steps - 1)
    axes.set_xlim(1 - margin, steps + margin)
    if steps == 1:
        axes.set_xticks([1])
    else:
        axes.xaxis.set_major_locator(MaxNLocator(integer=True, steps=[1, 2, 5, 10]))
    return every(np.arange(1, steps + 1, dtype=np.float64))


def interval(mean: Vector, stderr: Vector) -> tuple[Vector, Vector]:
    """mean ± 1.96 standard errors, kept finite."""
    with np.errstate(over="ignore"):
        low, high = mean - Z_95 * stderr, mean + Z_95 * stderr
    largest = LARGEST / 1e3
    return np.clip(low, -largest, largest), np.clip(high, -largest, largest)


def fill(axes: Axes, k: Vector, low: Vector, high: Vector, colour: str) -> None:
    """Shade low … high; a single step gets a bar, which a shade cannot show."""
    if np.isfinite(low).sum() == 1:
        axes.vlines(k, low, high, color=colour, alpha=0.5, linewidth=3)
    else:
        axes.fill_between(k, low, high, color=colour, alpha=0.18, linewidth=0)


def sparse(steps_shown: int, index: int, count: int) -> tuple[int, int] | None:
    """`markevery` for line `index` of `count`: about ten markers, no two lines at the same steps."""
    if steps_shown <= 12:
        return None
    gap = steps_shown // 10
    return (gap * index) // count, gap


def single(axes: Axes, k: Vector, values: Vector, colour: str) -> None:
    """One line in a panel of its own; says so when there is nothing to draw."""
    width = 1.0 if len(k) <= DOTS_STEPS_MAX else 0.5
    axes.plot(k, values, color=colour, linewidth=width, marker="o" if len(k) <= 12 else "", markersize=3)
    if not np.isfinite(values).any():
        axes.text(0.5, 0.8, "no figures", transform=axes.transAxes, ha="center", va="center", color=GREY)


def dots(axes: Axes, k: Vector, values: Vector, where: NDArray[np.bool_]) -> None:
    """Mark the steps `where`, unless there are too many steps to tell them apart."""
    if len(k) <= DOTS_STEPS_MAX:
        axes.plot(k[where], values[where], linestyle="", marker=".", markersize=2.8, color="black")


def literal_legend(owner: Axes | Figure, handles: list[Any], names: list[str], **options: Any) -> Legend:
    """A legend whose names are shown as they are: `$` starts no formula and a leading `_` hides nothing."""
    legend = owner.legend(handles, ["-"] * len(names), **options)
    for text, name in zip(legend.get_texts(), names, strict=True):
        text.set_parse_math(False)
        text.set_text(shortened(name))
    return legend


def shortened(name: str, length_max: int = _NAME_LENGTH_MAX) -> str:
    """`name` without control characters and not too long for a figure."""
    name = "".join(character if character.isprintable() else " " for character in name)
    return name if len(name) <= length_max else name[: length_max - 1] + "…"
