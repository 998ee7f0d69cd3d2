"""``testbed ctl``: what can be asked of a run that goes."""

from __future__ import annotations

import json as json_format
from pathlib import Path
from typing import Annotated, Any

import typer

from testbed.cli import ctl_events
from testbed.cli.ordering import At, When, order
from testbed.errors import UsageError

app = typer.Typer(help="Look at a run that goes, and let events happen in it.", rich_markup_mode=None)

_Estimator = Annotated[str, typer.Argument(metavar="ESTIMATOR", help="Name of an estimator of the run.")]
_Own = Annotated[str, typer.Argument(metavar="NAME", help="Name of the new estimator in the results; one of its own.")]
_Kind = Annotated[str, typer.Option("--to", metavar="KIND", help="Which estimator the new service is.")]
_Options = Annotated[
    list[str] | None,
    typer.Option("--option", metavar="KEY=VALUE", help="A key of its table, such as order=3 or acks=perfect."),
]
_HandOver = Annotated[
    str | None, typer.Option("--handover", metavar="FORM", help="cold, moments or full; default moments.")
]


@app.callback()
def _of_run(
    context: typer.Context,
    run: Annotated[Path, typer.Argument(metavar="RUN", help="The folder of a run that goes.")],
) -> None:
    context.obj = run


@app.command()
def swap(
    context: typer.Context,
    estimator: _Estimator,
    to: Annotated[str | None, typer.Option("--to", metavar="KIND", help="Which estimator the new service is.")] = None,
    promote: Annotated[
        str | None, typer.Option(metavar="NAME", help="Instead: an estimator that runs, such as a shadow.")
    ] = None,
    option: _Options = None,
    handover: _HandOver = None,
    at: At = None,
    when: When = None,
) -> None:
    """Let another service take over an estimator, from the first step on that is not granted when it is there.

    Prints that step. Where the new service fails to start or refuses, the old one stays in charge: exit code 1.
    """
    if (to is None) == (promote is None):
        raise UsageError(f"got {'both' if to else 'neither'} of --to and --promote; allowed: exactly one of them")
    if promote is not None and (option or handover):
        raise UsageError("--promote: allowed without --option and --handover; it has a state of its own")
    target: Any = promote if to is None else _service(to, option)
    order(context, {"action": "swap", "estimator": estimator, "to": target, "handover": handover}, at, when)


@app.command()
def shadow(
    context: typer.Context,
    estimator: _Estimator,
    name: _Own,
    to: _Kind,
    option: _Options = None,
    handover: _HandOver = None,
    at: At = None,
    when: When = None,
) -> None:
    """Let an estimator run beside another one, from its state, under a name of its own."""
    event = {"action": "shadow", "estimator": estimator, "name": name, "to": _service(to, option)}
    order(context, {**event, "handover": handover}, at, when)


@app.command()
def add(
    context: typer.Context, name: _Own, to: _Kind, option: _Options = None, at: At = None, when: When = None
) -> None:
    """Add an estimator; it knows the prior of the scenario and no more."""
    order(context, {"action": "add", "estimator": name, "to": _service(to, option)}, at, when)


@app.command()
def remove(context: typer.Context, estimator: _Estimator, at: At = None, when: When = None) -> None:
    """Let an estimator leave."""
    order(context, {"action": "remove", "estimator": estimator}, at, when)


@app.command()
def status(
    context: typer.Context, json: Annotated[bool, typer.Option("--json", help="Print the status as JSON.")] = False
) -> None:
    """How far a run is, who estimates, and what has happened."""
    from testbed.orchestrator.running import ask
    from testbed.orchestrator.summary import Happened

    found = ask(context.obj, {"do": "status"})
    if json:
        typer.echo(json_format.dumps(found))
        return
    held = "" if found["held"] is None else f", held at step {found['held']}"
    typer.echo(f"{found['completed']} of {found['steps']} steps{held}")
    for name, service in found["estimators"].items():
        typer.echo(f"{name}: {service['kind']}, {service['role']}")
    for event in found["events"]:
        typer.echo(f"step {event['step']}: {Happened.model_validate(event).text}")


@app.command()
def stop(context: typer.Context) -> None:
    """Let a run end now; what was collected is kept, and it counts as interrupted."""
    from testbed.orchestrator.running import ask

    found = ask(context.obj, {"do": "stop"})
    typer.echo(f"stopping after {found['completed']} of {found['steps']} steps")


@app.command()
def hold(
    context: typer.Context,
    step: Annotated[int | None, typer.Argument(min=0, metavar="[STEP]", help="Default: where the run is now.")] = None,
) -> None:
    """Let the clock of a run in virtual time not go beyond a step, until it is released."""
    from testbed.orchestrator.running import ask

    found = ask(context.obj, {"do": "hold"} if step is None else {"do": "hold", "step": step})
    typer.echo(f"held at step {max(found['held'], found['granted'])}")


@app.command()
def release(context: typer.Context) -> None:
    """Let the clock go on."""
    from testbed.orchestrator.running import ask

    found = ask(context.obj, {"do": "release"})
    typer.echo(f"goes on after {found['completed']} of {found['steps']} steps")


def _service(kind: str, options: list[str] | None) -> dict[str, Any]:
    from testbed.scenario.changes import parse_setting, together

    return {"kind": kind, **together([parse_setting(text) for text in options or []])}


for name, command in ctl_events.COMMANDS.items():
    app.command(name)(command)
