"""``testbed ctl RUN …``: events of links, processes and the rest, one command each."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

import typer

from testbed.cli.ordering import At, When, order, table_of

_Links = Annotated[list[str] | None, typer.Argument(metavar="[LINK]…", help="control, observation, ack; default all.")]
_Role = Annotated[str, typer.Argument(metavar="ROLE", help="Such as plant, link.control or estimator.aoe.")]


def event(
    context: typer.Context,
    keys: Annotated[str, typer.Argument(metavar="KEYS", help="As in [[events]]: 'action = \"plant\", R = [[2.0]]'.")],
    at: At = None,
    when: When = None,
) -> None:
    """Let any event happen, given as in a scenario, in one line of TOML."""
    order(context, table_of(keys), at, when)


def set_(
    context: typer.Context,
    link: Annotated[str, typer.Argument(metavar="LINK", help="control, observation or ack.")],
    settings: Annotated[list[str], typer.Argument(metavar="KEY=VALUE…", help="Such as loss.failure=0.4.")],
    at: At = None,
    when: When = None,
) -> None:
    """Change a link: other values for keys of its table."""
    from testbed.scenario.changes import parse_setting, together

    table = together([parse_setting(text) for text in settings])
    order(context, {"action": "set", "link": link, "set": table}, at, when)


def mark(
    context: typer.Context,
    name: Annotated[str, typer.Argument(metavar="NAME", help="What it says.")],
    at: At = None,
    when: When = None,
) -> None:
    """Leave a mark in the results."""
    order(context, {"action": "mark", "name": name}, at, when)


def snapshot(
    context: typer.Context,
    estimator: Annotated[str, typer.Argument(metavar="ESTIMATOR", help="Name of an estimator of the run.")],
    name: Annotated[
        str | None, typer.Option(metavar="NAME", help="Of the file; default that of the estimator.")
    ] = None,
    at: At = None,
    when: When = None,
) -> None:
    """Write the whole state of an estimator into the folder of the run."""
    order(context, {"action": "snapshot", "estimator": estimator, "name": name}, at, when)


def acks(
    context: typer.Context,
    told: Annotated[str, typer.Argument(metavar="ACKS", help="none, perfect or link.")],
    estimator: Annotated[str | None, typer.Option(metavar="NAME", help="Which estimator; default all.")] = None,
    at: At = None,
    when: When = None,
) -> None:
    """Switch ACKs on or off."""
    order(context, {"action": "acks", "acks": told, "estimator": estimator}, at, when)


def partition(context: typer.Context, links: _Links = None, at: At = None, when: When = None) -> None:
    """Cut links: nothing gets through until they are healed."""
    order(context, {"action": "partition", "links": links or None}, at, when)


def heal(context: typer.Context, links: _Links = None, at: At = None, when: When = None) -> None:
    """Let links that were cut carry packets again."""
    order(context, {"action": "heal", "links": links or None}, at, when)


def kill(context: typer.Context, role: _Role, at: At = None, when: When = None) -> None:
    """Kill a process, as a crash would."""
    order(context, {"action": "kill", "role": role}, at, when)


def pause(
    context: typer.Context,
    role: _Role,
    lasts: Annotated[str, typer.Option("--for", metavar="DURATION", help="Such as '2 s'.")],
    at: At = None,
    when: When = None,
) -> None:
    """Let a process stand still for a while."""
    order(context, {"action": "pause", "role": role, "for": lasts}, at, when)


def restart(context: typer.Context, role: _Role, at: At = None, when: When = None) -> None:
    """End a process and start it anew."""
    order(context, {"action": "restart", "role": role}, at, when)


COMMANDS: dict[str, Callable[..., Any]] = {
    "event": event,
    "set": set_,
    "mark": mark,
    "snapshot": snapshot,
    "acks": acks,
    "partition": partition,
    "heal": heal,
    "kill": kill,
    "pause": pause,
    "restart": restart,
}
