"""``testbed run``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn, cast, get_args

import typer

if TYPE_CHECKING:
    from rich.console import Console

    from testbed.orchestrator.summary import Summary
    from testbed.scenario.links import Backend

EXIT_CODES = {"complete": 0, "failed": 1, "interrupted": 130}


def run(
    scenario: Annotated[Path, typer.Argument(metavar="SCENARIO.toml", help="The scenario.")],
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder for the results; default runs/NAME-TIME.")
    ] = None,
    in_process: Annotated[
        bool, typer.Option("--in-process", help="Everything in this process, without zenoh; the same figures.")
    ] = False,
    links: Annotated[
        str | None,
        typer.Option(metavar="BACKEND", help="Every link as model, relay or kernel; default: as the scenario says."),
    ] = None,
    external: Annotated[
        list[str] | None,
        typer.Option(metavar="ROLE", help="A role that you start by hand; the run prints how, and waits for it."),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print summary.json instead of tables.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress display.")] = False,
) -> None:
    """Run a scenario across real processes and report its expected error covariance.

    Exit code 0: complete; 1: failed, with what was collected kept; 2: wrong input; 130: interrupted.
    """
    from rich.console import Console

    from testbed.cli.progress import progress_display
    from testbed.errors import UsageError
    from testbed.orchestrator.preflight import default_folder
    from testbed.orchestrator.run import Run
    from testbed.scenario import load_scenario
    from testbed.scenario.backend import with_backend

    if in_process and external:
        raise UsageError("--external needs processes; allowed: without --in-process")
    loaded = load_scenario(scenario)
    if links is not None:
        loaded = with_backend(loaded, _backend(links))
    if out is None:
        out = default_folder(loaded)
    console = Console(stderr=True)
    with progress_display(console, loaded.name, loaded.steps, shown=not quiet) as display:
        work = Run(loaded, out, progress=display.update, say=display.say)
        summary = work.in_process() if in_process else work.over_zenoh(external or ())
    finish(summary, out, console, json=json)


def resume(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="The folder of a run that was not finished.")],
    in_process: Annotated[
        bool, typer.Option("--in-process", help="Everything in this process, without zenoh; the same figures.")
    ] = False,
    json: Annotated[bool, typer.Option("--json", help="Print summary.json instead of tables.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress display.")] = False,
) -> None:
    """Finish a run whose orchestrator was killed, or that was interrupted: from its journal, to the same figures.

    Exit codes as of `testbed run`.
    """
    from rich.console import Console

    from testbed.cli.progress import progress_display
    from testbed.orchestrator.run import Run

    console = Console(stderr=True)
    work, begun = Run.again(run, say=lambda line: console.print(line, markup=False, highlight=False, soft_wrap=True))
    for line in begun.lost:
        console.print(f"damaged: {line}", markup=False, highlight=False, soft_wrap=True)
    if begun.anew:
        console.print(f"beginning anew: {begun.anew}", markup=False, highlight=False, soft_wrap=True)
    else:
        console.print(f"resuming after step {begun.step} of {begun.given.steps}", highlight=False)
    with progress_display(console, begun.given.name, begun.given.steps, shown=not quiet) as display:
        work.shown_by(display.update, display.say)
        summary = work.in_process() if in_process else work.over_zenoh()
    finish(summary, run, console, json=json)


def finish(summary: Summary, out: Path, console: Console, *, json: bool) -> NoReturn:
    """Print what became of a run, and leave with its exit code."""
    from rich.console import Console

    from testbed.orchestrator.resuming import FOLDER
    from testbed.orchestrator.table import end_table

    if json:
        sys.stdout.write((out / "summary.json").read_text())
    else:
        Console().print(end_table(summary, out))
    if summary.status != "complete" and (out / FOLDER).exists():
        console.print(f"to finish it: testbed resume {out}", markup=False, highlight=False, soft_wrap=True)
    if summary.status == "failed":
        console.print(f"testbed: run {summary.status}: {summary.reason}", markup=False, highlight=False, soft_wrap=True)
    raise typer.Exit(EXIT_CODES[summary.status])


def _backend(name: str) -> Backend:
    from testbed.errors import UsageError, did_you_mean
    from testbed.scenario.links import Backend

    names = get_args(Backend)
    if name not in names:
        raise UsageError(f"--links {name}: no such backend; allowed: {', '.join(names)}{did_you_mean(name, names)}")
    return cast("Backend", name)
