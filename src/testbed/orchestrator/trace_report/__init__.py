"""What a trace says about its link, beside a model: figures, and one page of HTML."""

from __future__ import annotations

from pathlib import Path

from testbed.analysis.trace_figures import Model, Packets, TraceFigures

__all__ = ["write_trace_report"]


def write_trace_report(
    path: Path, title: str, packets: Packets, figures: TraceFigures, model: Model | None, notes: list[str]
) -> None:
    """Write the page: one HTML file that needs nothing else. Raises OSError."""
    from testbed.orchestrator.trace_report.page import page_html  # matplotlib is slow to import

    path.write_text(page_html(title, packets, figures, model, notes), encoding="utf-8")
