"""The numbers behind each figure, as CSV: full precision, an empty field where there is no figure."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence

from testbed.orchestrator.report.derived import relative_excess
from testbed.orchestrator.report.link_model import Expected
from testbed.orchestrator.summary import CostFigures, Series, Summary


def covariance_csv(summary: Summary) -> str:
    """Columns k; tr P, squared error and their standard errors of each estimator; the bounds."""
    columns: dict[str, Series] = {}
    for name, figures in summary.estimators.items():
        columns[f"trace_P_mean:{name}"] = figures.trace_P_mean
        columns[f"trace_P_stderr:{name}"] = figures.trace_P_stderr
        columns[f"squared_error_mean:{name}"] = figures.squared_error_mean
        columns[f"squared_error_stderr:{name}"] = figures.squared_error_stderr
    if summary.bounds is not None:
        columns["lower_mean"] = summary.bounds.lower_mean
        columns["lower_stderr"] = summary.bounds.lower_stderr
        if summary.bounds.upper_mean is not None:
            columns["upper_mean"] = summary.bounds.upper_mean
        if summary.bounds.upper_correlated_mean is not None:
            columns["upper_correlated_mean"] = summary.bounds.upper_correlated_mean
        if summary.bounds.upper_correlated_stderr is not None:
            columns["upper_correlated_stderr"] = summary.bounds.upper_correlated_stderr
        if summary.bounds.upper_stderr is not None:
            columns["upper_stderr"] = summary.bounds.upper_stderr
    return _along_k(summary.completed_steps, columns)


def nees_csv(summary: Summary) -> str:
    """Columns k; mean, standard error and 95 % band of each estimator."""
    columns: dict[str, Series] = {}
    for name, figures in summary.estimators.items():
        columns[f"nees_mean:{name}"] = figures.nees_mean
        columns[f"nees_stderr:{name}"] = figures.nees_stderr
        columns[f"band_low:{name}"] = (figures.nees_band_95[0],) * summary.completed_steps
        columns[f"band_high:{name}"] = (figures.nees_band_95[1],) * summary.completed_steps
    return _along_k(summary.completed_steps, columns)


def excess_csv(summary: Summary) -> str:
    """Columns k; excess, its standard error and both relative to tr P of each estimator."""
    columns: dict[str, Series] = {}
    for name, figures in summary.estimators.items():
        mean, stderr = relative_excess(figures)
        columns[f"excess_mean:{name}"] = figures.excess_mean
        columns[f"excess_stderr:{name}"] = figures.excess_stderr
        columns[f"relative_excess_mean:{name}"] = tuple(_finite(mean.tolist()))
        columns[f"relative_excess_stderr:{name}"] = tuple(_finite(stderr.tolist()))
    return _along_k(summary.completed_steps, columns)


def cost_csv(cost: CostFigures, completed_steps: int) -> str:
    """Columns k; the cost of a step, its two terms, and their standard errors."""
    names = [f"{figure}_{kind}" for figure in ("step", "state", "input") for kind in ("mean", "stderr")]
    return _along_k(completed_steps, {name: getattr(cost, name) for name in names})


def links_csv(summary: Summary, expected: Mapping[str, Expected]) -> str:
    """One row a link: counts, counted figures and those of the model."""
    counts = ("sent", "delivered", "dropped", "duplicated", "late", "in_flight", "loss_rate", "mean_burst")
    models = ("loss_rate", "loss_rate_deviation", "mean_burst", "mean_burst_deviation")
    rows = [
        [
            f"link:{name}",
            *(getattr(link, key) for key in counts),
            *(getattr(expected.get(name), key, None) for key in models),
        ]
        for name, link in summary.links.items()
    ]
    return _csv(["link", *counts, *(f"model_{key}" for key in models)], rows)


def _along_k(steps: int, columns: Mapping[str, Series]) -> str:
    return _csv(["k", *columns], zip(range(1, steps + 1), *columns.values(), strict=True))


def _csv(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return text.getvalue()


def _finite(values: list[float]) -> list[float | None]:
    return [value if abs(value) < float("inf") else None for value in values]
