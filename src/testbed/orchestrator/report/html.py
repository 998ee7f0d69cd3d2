"""What the pages of reports share: the templates and their filters, and figures as they stand in a page."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jinja2
from markupsafe import Markup
from matplotlib.figure import Figure

from testbed.orchestrator.report import svg, text

ENVIRONMENT = jinja2.Environment(
    loader=jinja2.PackageLoader("testbed.orchestrator.report"),
    autoescape=True,
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
ENVIRONMENT.filters.update(number=text.number, count=text.count, share=text.share, band=text.band, micros=text.micros)
ENVIRONMENT.globals.update(plus_minus=text.plus_minus, plural=text.plural, steps_range=text.steps)


@dataclass(frozen=True)
class PageFigure:
    """A figure as the template shows it: inline, and as two downloads."""

    number: int
    name: str
    svg: Markup
    svg_uri: str
    csv_uri: str


def page_figure(number: int, name: str, draw: Callable[[], Figure], numbers: str, label: str) -> PageFigure:
    """Draw it. name: an identifier; numbers: as CSV; label: for screen readers."""
    with svg.look():
        document = svg.svg_text(draw())
    return PageFigure(
        number=number,
        name=name,
        svg=Markup(svg.inline_svg(document, prefix=f"figure-{name}", label=label)),
        svg_uri=svg.data_uri(document, "image/svg+xml"),
        csv_uri=svg.data_uri(numbers, "text/csv"),
    )
