"""To let an event happen in a run that goes, and to say what became of it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from testbed.errors import RunFailed, UsageError

At = Annotated[
    str | None,
    typer.Option("--at", metavar="STEP", help="A step, or a duration since the start; default as soon as can be."),
]
When = Annotated[
    str | None, typer.Option("--when", metavar="CONDITION", help="Instead: once this holds, as trace_P(aoe) > 500.")
]


def order(context: typer.Context, event: dict[str, Any], at: str | None = None, when: str | None = None) -> None:
    """Ask for an event. Where it comes as soon as can be, wait for it, and print from which step on it holds."""
    from testbed.orchestrator.running import asking, outcome_of

    run: Path = context.obj
    if at is not None:
        event = {**event, "at": int(at) if at.lstrip("-").isdigit() else at}
    if when is not None:
        event = {**event, "when": when}
    with asking(run) as put:
        number = put({"event": {key: value for key, value in event.items() if value is not None}})["number"]
        if event.get("at") is not None or event.get("when") is not None:
            typer.echo(f"event {number}: to come")
            return
        happened = outcome_of(run, put, number)
    for one in happened:
        if one.ok:
            typer.echo(f"{one.text}: from step {one.step} on")
    refused = [one.text for one in happened if not one.ok]
    if refused:
        raise RunFailed("; ".join(refused))


def table_of(text: str) -> dict[str, Any]:
    """The keys of an event as in a scenario: action = "plant", over = 50. Raises UsageError where they are not TOML."""
    import tomllib

    try:
        table: dict[str, Any] = tomllib.loads(f"event = {{ {text} }}")["event"]
    except ValueError as error:
        raise UsageError(
            f'got {text!r}; allowed: KEY=VALUE, …, such as action = "mark", name = "here": {error}'
        ) from None
    return table
