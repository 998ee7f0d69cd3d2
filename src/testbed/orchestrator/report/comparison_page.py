"""The page of a comparison: the table, and the differences along k."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable

import numpy as np

from testbed.orchestrator.comparison import Comparison
from testbed.orchestrator.report.comparison_text import explanations, headline
from testbed.orchestrator.report.figures import differences
from testbed.orchestrator.report.html import ENVIRONMENT, page_figure


def comparison_html(found: Comparison) -> str:
    """One HTML file that needs nothing else."""
    drawn = page_figure(
        1, "differences", lambda: differences.draw(found), differences_csv(found), "Differences along the steps"
    )
    return ENVIRONMENT.get_template("comparison.html").render(
        found=found,
        drawn=drawn,
        headline=headline(found),
        explanations=explanations(found),
        several=found.lanes > 1,
        banded=any(pair.course.stderr is not None for pair in found.pairs),
        panels_max=differences.PANELS_MAX,
    )


def differences_csv(found: Comparison) -> str:
    """A row a pair and window: a, b, first and last step, mean difference, its standard error; empty: no figure."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["a", "b", "first", "last", "difference", "stderr"])
    for pair in found.pairs:
        course = pair.course
        errors: Iterable[float] = [np.nan] * len(course.ends) if course.stderr is None else course.stderr.tolist()
        begin = 1
        for end, mean, error in zip(course.ends.tolist(), course.mean.tolist(), errors, strict=True):
            writer.writerow([found.name(pair.a), found.name(pair.b), begin, end, *map(_shown, (mean, error))])
            begin = end + 1
    return out.getvalue()


def _shown(value: float) -> float | None:
    return value if np.isfinite(value) else None
