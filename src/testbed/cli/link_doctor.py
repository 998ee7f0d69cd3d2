"""``testbed link doctor`` and ``testbed link clean``."""

from __future__ import annotations

import json as json_format
from dataclasses import asdict
from typing import Annotated

import typer


def doctor(json: Annotated[bool, typer.Option("--json", help="Print the findings as JSON.")] = False) -> None:
    """What this machine can do with links, why it cannot do the rest, and what would help. Changes nothing."""
    from testbed.channel.kernel.doctor import examine

    findings = examine()
    if json:
        typer.echo(json_format.dumps([asdict(finding) for finding in findings]))
        return
    from rich.console import Console

    from testbed.cli.tables import row, table

    shown = table("", "", "found, and what to do")
    for finding in findings:
        text = finding.found if not finding.advice else f"{finding.found}; {finding.advice}"
        row(shown, finding.what, "ok" if finding.ok else "not", text)
    Console(highlight=False).print(shown)


def clean(json: Annotated[bool, typer.Option("--json", help="Print what was ended as JSON.")] = False) -> None:
    """End what `testbed link hosts` or a script left behind when it was killed; never what a living one uses.

    Every start of new hosts does the same.
    """
    from testbed.channel.kernel.ending import clean as end_leftovers

    ended = end_leftovers()
    if json:
        typer.echo(json_format.dumps([asdict(one) for one in ended]))
        return
    for one in ended:
        typer.echo(f"ended: {one.pid} {one.command}, left by {one.hosts}")
    if not ended:
        typer.echo("nothing was left behind")
