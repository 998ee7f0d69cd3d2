"""The page of the report: figures, tables and captions put into the template."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from matplotlib.figure import Figure

from testbed.orchestrator.report import csv_data, svg
from testbed.orchestrator.report.derived import common_band, settled
from testbed.orchestrator.report.figures import axes, cost, covariance, excess, lateness, links, nees
from testbed.orchestrator.report.figures.events import mark_events, shown
from testbed.orchestrator.report.figures.ratio import ratios
from testbed.orchestrator.report.html import ENVIRONMENT, PageFigure, page_figure
from testbed.orchestrator.report.link_model import Expected, expected_links
from testbed.orchestrator.summary import Summary

Part = TypeVar("Part")


def report_html(summary: Summary, scenario_toml: str) -> str:
    """The whole page; see `testbed.orchestrator.report.write_report`."""
    expected = expected_links(summary, scenario_toml)
    return ENVIRONMENT.get_template("report.html").render(
        summary=summary,
        scenario_toml=scenario_toml,
        drawn=_figures(summary, expected),
        expected=expected,
        settled={name: settled(figures, summary.completed_steps) for name, figures in summary.estimators.items()},
        colours={name: svg.colour(index) for index, name in enumerate(summary.estimators)},
        band=common_band(summary),
        stride=axes.stride(summary.completed_steps),
        dots=summary.completed_steps <= axes.DOTS_STEPS_MAX,
        upper_leaves=summary.completed_steps > 0 and covariance.choose_scale(summary).upper_leaves,
        below=bool(ratios(summary)),
        marked=bool(shown(summary)),
        robust=[name for name, figures in summary.estimators.items() if figures.kind.startswith("rse")],
    )


def _figures(summary: Summary, expected: dict[str, Expected]) -> dict[str, PageFigure]:
    """The figures that this run has something to show in, numbered in their order."""
    ran = summary.completed_steps > 0
    realtime = summary.realtime
    has_estimators = ran and bool(summary.estimators)
    available: list[tuple[str, bool, Callable[[], Figure], Callable[[], str], str]] = [
        (
            "covariance",
            has_estimators or (ran and summary.bounds is not None),
            lambda: covariance.draw(summary),
            lambda: csv_data.covariance_csv(summary),
            "Expected error covariance along the steps",
        ),
        (
            "nees",
            has_estimators,
            lambda: nees.draw(summary),
            lambda: csv_data.nees_csv(summary),
            "Normalised estimation error squared along the steps",
        ),
        (
            "excess",
            has_estimators,
            lambda: excess.draw(summary),
            lambda: csv_data.excess_csv(summary),
            "Squared error less claimed covariance along the steps",
        ),
        (
            "lateness",
            ran and realtime is not None,
            lambda: lateness.draw(summary, _given(realtime)),
            lambda: csv_data.lateness_csv(summary.completed_steps, _given(realtime)),
            "When the parts of each step were published, on the wall clock",
        ),
        (
            "cost",
            ran and summary.cost is not None,
            lambda: cost.draw(_given(summary.cost), summary.completed_steps),
            lambda: csv_data.cost_csv(_given(summary.cost), summary.completed_steps),
            "Quadratic cost along the steps",
        ),
        (
            "links",
            any(link.sent for link in summary.links.values()),
            lambda: links.draw(summary, expected),
            lambda: csv_data.links_csv(summary, expected),
            "Loss rate and mean burst of the links",
        ),
    ]
    shown = [entry for entry in available if entry[1]]
    return {
        name: page_figure(number, name, _marked(name, draw, summary), numbers(), label)
        for number, (name, _, draw, numbers, label) in enumerate(shown, start=1)
    }


def _marked(name: str, draw: Callable[[], Figure], summary: Summary) -> Callable[[], Figure]:
    """The figure with its events, if it goes along the steps."""

    def drawn() -> Figure:
        figure = draw()
        if name != "links":
            mark_events(figure, summary)
        return figure

    return drawn


def _given(part: Part | None) -> Part:
    assert part is not None
    return part
