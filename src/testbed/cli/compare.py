"""``testbed compare``."""

from __future__ import annotations

import json as json_format
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from testbed.cli.tables import row, table
from testbed.errors import UsageError

if TYPE_CHECKING:
    from testbed.orchestrator.comparison import Comparison, Pair


def compare(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN…", help="Folders of runs; of one, its estimators.")],
    figure: Annotated[
        str,
        typer.Option(
            metavar="FIGURE", help="trace_P, squared_error, nees or another of lanes.npz: its mean over steps."
        ),
    ] = "trace_P",
    against: Annotated[
        str | None, typer.Option(metavar="NAME", help="Compare with this ESTIMATOR or RUN/ESTIMATOR only.")
    ] = None,
    every: Annotated[
        bool, typer.Option("--all", help="All pairs; default with several runs: each estimator with itself.")
    ] = False,
    whole: Annotated[
        bool, typer.Option("--whole", help="Over all the steps that both ran; default the last quarter of them.")
    ] = False,
    unpaired: Annotated[
        bool, typer.Option("--unpaired", help="Take the lanes of different runs as independent of each other.")
    ] = False,
    report: Annotated[
        Path | None, typer.Option(metavar="FILE.html", help="Write a page with the differences along the steps.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")] = False,
) -> None:
    """Compare the estimators of runs lane by lane: differences with 95 % intervals, ratios, p-values.

    Lanes are paired where seed, lanes, steps and plant agree: the noises of a lane are then the same in every run.
    """
    from testbed.orchestrator.comparison import compare as compare_runs
    from testbed.orchestrator.comparison import load_runs

    found = compare_runs(load_runs(runs), figure=figure, against=against, every=every, whole=whole, unpaired=unpaired)
    if report is not None:
        from testbed.orchestrator.report.comparison_page import comparison_html

        try:
            report.write_text(comparison_html(found), encoding="utf-8")
        except OSError as error:
            raise UsageError(f"cannot write {report}: {(error.strerror or str(error)).lower()}") from None
    if json:
        typer.echo(json_format.dumps(_plain(found), allow_nan=False, ensure_ascii=False))
    else:
        _show(found)


def _plain(found: Comparison) -> dict[str, Any]:
    return {
        "figure": found.figure,
        "level": 0.95,
        "lanes": found.lanes,
        "pairs": [_plain_pair(pair) for pair in found.pairs],
        "notes": list(found.notes),
    }


def _plain_pair(pair: Pair) -> dict[str, Any]:
    from dataclasses import asdict

    return {
        "a": asdict(pair.a),
        "b": asdict(pair.b),
        "steps": [pair.first, pair.last],
        **asdict(pair.found),
        "p_holm": pair.p_holm,
    }


def _show(found: Comparison) -> None:
    from rich.console import Console

    from testbed.orchestrator.report import text
    from testbed.orchestrator.report.comparison_text import explanations, headline

    console = Console(highlight=False, markup=False)
    console.print(headline(found))
    shared = any(pair.found.a_smaller is not None for pair in found.pairs)
    made = table("a", "b", "steps", "a − b", "95 % interval", "a / b", *(["a < b"] if shared else []), "p")
    for column in made.columns:
        column.no_wrap, column.overflow = False, "fold"
    for column in made.columns[2:]:
        column.justify = "right"
    for pair in found.pairs:
        one, p = pair.found, pair.p_holm
        cells = [text.steps(pair.first, pair.last), text.number(one.difference), text.band(one.interval)]
        last = [text.number(one.ratio), *([text.share(one.a_smaller)] if shared else [])]
        row(made, found.name(pair.a), found.name(pair.b), *cells, *last, text.ABSENT if p is None else f"{p:.2g}")
        if one.bootstrap is not None:
            row(made, "", "", "", "BCa", text.band(one.bootstrap))
    console.print(made)
    for line in explanations(found):
        console.print(line, style="dim")
    for note in found.notes:
        console.print(f"note: {note}")
