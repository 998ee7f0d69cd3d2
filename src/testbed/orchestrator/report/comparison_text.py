"""Words about a comparison, the same on the page and in the terminal."""

from __future__ import annotations

from testbed.analysis.differences import Method
from testbed.orchestrator.comparison import Comparison
from testbed.orchestrator.report import text

_FIGURES = {"trace_P": "tr P", "squared_error": "‖x − x̂‖²", "nees": "NEES"}
_METHODS: dict[Method, str] = {
    "paired t": "Student's t of the differences lane by lane",
    "Welch": "Welch's, for independent lanes",
    "batch means": "Student's t of batches of steps of the one lane, as if it were stationary",
}


def figure_name(found: Comparison) -> str:
    """The figure that is compared."""
    return _FIGURES.get(found.figure, found.figure)


def headline(found: Comparison) -> str:
    """What is compared."""
    return f"{figure_name(found)}, mean over steps; {text.plural(found.lanes, 'lane')}"


def explanations(found: Comparison) -> list[str]:
    """What the columns are."""
    methods = dict.fromkeys(pair.found.method for pair in found.pairs)
    lines = [f"Intervals: {'; '.join(_METHODS[method] for method in methods)}."]
    if any(pair.found.bootstrap is not None for pair in found.pairs):
        lines.append("BCa: bootstrap, where lanes are few or their differences skewed.")
    if any(pair.found.a_smaller is not None for pair in found.pairs):
        lines.append("a < b: in which share of the lanes.")
    many = f", adjusted for {len(found.pairs)} pairs (Holm)" if len(found.pairs) > 1 else ""
    return [*lines, f"p: of no difference{many}."]
