"""The page of a trace: figures, tables and captions put into the template."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Sequence

from matplotlib.figure import Figure

from testbed.analysis.trace_figures import Model, Packets, TraceFigures
from testbed.orchestrator.report.html import ENVIRONMENT, PageFigure, page_figure
from testbed.orchestrator.trace_report import draw


def page_html(title: str, packets: Packets, figures: TraceFigures, model: Model | None, notes: list[str]) -> str:
    """The whole page; see `testbed.orchestrator.trace_report.write_trace_report`."""
    return ENVIRONMENT.get_template("trace.html").render(
        title=title, figures=figures, notes=notes, drawn=_figures(packets, figures, model)
    )


def _figures(packets: Packets, figures: TraceFigures, model: Model | None) -> dict[str, PageFigure]:
    available: list[tuple[str, bool, Callable[[], Figure], Callable[[], str], str]] = [
        ("losses", True, lambda: draw.losses(figures), lambda: _losses(figures), "Share lost along the trace"),
        (
            "runs",
            figures.bursts > 0,
            lambda: draw.tails(packets, model),
            lambda: _runs(packets, model),
            "Lengths of bursts and gaps",
        ),
        (
            "correlation",
            0 < figures.lost < figures.packets and len(figures.correlation) > 1,
            lambda: draw.correlation(figures),
            lambda: _correlation(figures),
            "Autocorrelation of losses",
        ),
        (
            "delays",
            bool(figures.delays),
            lambda: draw.delays(packets, model),
            lambda: _delays(packets),
            "Delays along the trace and how often they are exceeded",
        ),
    ]
    shown = [entry for entry in available if entry[1]]
    return {
        name: page_figure(number, name, drawn, numbers(), label)
        for number, (name, _, drawn, numbers, label) in enumerate(shown, start=1)
    }


def _losses(figures: TraceFigures) -> str:
    return _csv(["first", "last", "loss_rate"], ((w.first, w.last, w.loss_rate) for w in figures.windows))


def _runs(packets: Packets, model: Model | None) -> str:
    rows: list[Sequence[object]] = []
    for fate, name in ((False, "burst"), (True, "gap")):
        lengths, shares, law = draw.tail(packets, model, fate)
        theory: Iterable[object] = [None] * len(lengths) if law is None else law.tolist()
        rows += [
            (name, int(length), share, value)
            for length, share, value in zip(lengths, shares.tolist(), theory, strict=True)
        ]
    return _csv(["run", "length", "share_as_long", "model"], rows)


def _correlation(figures: TraceFigures) -> str:
    theory = [None] * len(figures.correlation) if figures.model is None else figures.model.correlation
    return _csv(["lag", "autocorrelation", "model"], zip(range(len(theory)), figures.correlation, theory, strict=True))


def _delays(packets: Packets) -> str:
    delays_ms, shares = draw.exceeded(packets)
    return _csv(["delay_ms", "share_longer"], zip(delays_ms.tolist(), shares.tolist(), strict=True))


def _csv(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return text.getvalue()
