"""`report.html`: one page with the figures and tables of a run."""

from __future__ import annotations

from pathlib import Path

from testbed.orchestrator.summary import Summary

__all__ = ["write_report"]


def write_report(path: Path, summary: Summary, scenario_toml: str) -> None:
    """Write the report of a run: one HTML file that needs nothing else.

    Args:
        path: the file to write.
        summary: the figures of the run.
        scenario_toml: the scenario as resolved; shown as it is, and read for what the links should do.

    Raises:
        OSError: the file cannot be written.
    """
    from testbed.orchestrator.report.page import report_html  # matplotlib is slow to import: only when a page is made

    path.write_text(report_html(summary, scenario_toml), encoding="utf-8")
