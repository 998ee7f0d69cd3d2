"""``testbed conformance``."""

from __future__ import annotations

import json as json_format
from typing import TYPE_CHECKING, Annotated, Any

import typer

from testbed.errors import UsageError

if TYPE_CHECKING:
    from testbed.conformance.result import Report

_STYLES = {"passed": "green", "failed": "bold red", "skipped": "dim", "not claimed": "yellow"}


def conformance(
    estimator: Annotated[
        str, typer.Argument(metavar="MODULE:OBJECT", help="What is called with (model, lanes), or a kind of estimator.")
    ],
    option: Annotated[
        list[str] | None, typer.Option(metavar="NAME=VALUE", help="An option of the estimator; may be repeated.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print the results as JSON.")] = False,
) -> None:
    """Check that an estimator keeps what the testbed and the theory ask of one.

    The module is searched in the working folder too. A check passes, fails, is skipped where it says nothing of this
    estimator, or is not claimed: the estimator says in not_claimed why it cannot. Exit code 1 if a check fails.
    """
    from testbed.conformance.kit import examine
    from testbed.conformance.load import subject_of

    report = examine(subject_of(estimator, _options(option or [])))
    if json:
        typer.echo(json_format.dumps(report.as_dict(), allow_nan=False))
    else:
        _show(report)
    if not report.conforms:
        raise typer.Exit(1)


def _options(given: list[str]) -> dict[str, Any]:
    """Values are JSON, or texts where they are not."""
    options: dict[str, Any] = {}
    for text in given:
        name, equals, value = text.partition("=")
        if not equals or not name:
            raise UsageError(f"--option {text}: allowed: NAME=VALUE")
        try:
            options[name] = json_format.loads(value)
        except ValueError:
            options[name] = value
    return options


def _show(report: Report) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console(highlight=False)
    table = Table("check", "result", "because", box=None, pad_edge=False, header_style="dim", padding=(0, 2, 0, 0))
    for column in table.columns[:-1]:
        column.no_wrap = True
    for result in report.results:
        because = result.text if result.status != "failed" else f"{result.text}; wanted: {result.what}"
        table.add_row(Text(result.name), Text(result.status, style=_STYLES[result.status]), Text(because))
    console.print(table)
    counts = report.as_dict()
    told = ", ".join(f"{counts[key]} {key.replace('_', ' ')}" for key in ("passed", "failed", "skipped", "not_claimed"))
    console.print(f"{report.estimator}: {told}", markup=False)
