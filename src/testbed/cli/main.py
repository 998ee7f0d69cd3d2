"""``testbed``: the commands, and how errors leave them: one line on standard error and an exit code."""

from __future__ import annotations

import os
import signal
import sys
import threading
from typing import Annotated

import typer

from testbed import __version__
from testbed.cli import analyze, compare, conformance, ctl, link, replay, run, schema
from testbed.errors import TestbedError

app = typer.Typer(
    help="A distributed testbed for state estimation over lossy networks.",
    invoke_without_command=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
app.command("run")(run.run)
app.command("resume")(run.resume)
app.command("analyze")(analyze.analyze)
app.command("compare")(compare.compare)
app.command("conformance")(conformance.conformance)
app.command("replay")(replay.replay)
app.command("schema")(schema.schema)
app.add_typer(link.app, name="link")
app.add_typer(ctl.app, name="ctl")

_CommandLineError: type[Exception] = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "ClickException")
"""The base of what typer raises for a wrong command line; some versions of it carry their own copy of click."""


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"testbed {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version and leave.")
    ] = False,
) -> None:
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; ends the process with the exit code."""
    sys.exit(run_command(arguments))


def run_command(arguments: list[str] | None = None) -> int:
    """The command line as a function: 0 on success, 2 on wrong input, 130 when interrupted, else 1."""
    _interruptible()
    try:
        code = app(args=arguments, prog_name="testbed", standalone_mode=False)
    except TestbedError as error:
        return _refuse(str(error), error.exit_code)
    except _CommandLineError as error:
        text = str(error.format_message())  # type: ignore[attr-defined]
        return _refuse(" ".join(text.split()), 2)
    except (KeyboardInterrupt, typer.Abort):
        code = 130
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    if code == 130:
        return _refuse("interrupted", 130)
    return code if isinstance(code, int) else 0


def _interruptible() -> None:
    """Ctrl-C and a polite kill both interrupt, also where the shell started us with SIGINT ignored."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGTERM, signal.default_int_handler)


def _refuse(text: str, code: int) -> int:
    typer.echo(f"testbed: {text}", err=True)
    return code
