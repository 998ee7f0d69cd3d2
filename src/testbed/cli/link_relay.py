"""``testbed link relay``."""

from __future__ import annotations

import json as json_format
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from testbed.cli.link_names import link_name
from testbed.errors import UsageError

if TYPE_CHECKING:
    from testbed.channel.sockets.endpoints import Endpoint
    from testbed.channel.sockets.link import Direction, Figures, SocketLink
    from testbed.scenario import Scenario
    from testbed.scenario.links import SteppedImpairments


def relay(
    scenario: Annotated[Path, typer.Argument(metavar="SCENARIO.toml", help="The scenario.")],
    name: Annotated[str, typer.Option("--link", metavar="LINK", help="Its link that impairs the way to the target.")],
    listen: Annotated[str, typer.Option(metavar="ENDPOINT", help="Where clients connect: udp/ or tcp/HOST:PORT.")],
    to: Annotated[str, typer.Option(metavar="ENDPOINT", help="The target.")],
    back: Annotated[
        str | None,
        typer.Option(metavar="LINK", help="The link that impairs the way back; default: its own back, if any."),
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed; default that of the scenario.")] = None,
    duration: Annotated[
        str | None, typer.Option(metavar="DURATION", help="How long, such as '10 s'; default: until Ctrl-C.")
    ] = None,
    stall: Annotated[
        list[str] | None,
        typer.Option(metavar="AT+FOR", help="tcp only: nothing is handed on; '5 s + 500 ms'. May be repeated."),
    ] = None,
    reset: Annotated[
        list[str] | None,
        typer.Option(metavar="AT+FOR", help="tcp only: connections are reset, and refused for so long. Repeatable."),
    ] = None,
    trace: Annotated[Path | None, typer.Option(metavar="TRACE.csv", help="Trace of the way to the target.")] = None,
    trace_back: Annotated[Path | None, typer.Option(metavar="TRACE.csv", help="Trace of the way back.")] = None,
    json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")] = False,
) -> None:
    """Put a link of a scenario between two programs that talk over UDP or TCP; no privileges needed.

    Clients connect to --listen, and what they send goes to --to, impaired in real time as the link says; answers come
    back the same way. A TCP link can delay, limit the rate, stall and reset. The books are printed at the end.
    """
    from testbed.channel.sockets.endpoints import endpoint
    from testbed.scenario import load_scenario, parse_duration

    loaded = load_scenario(scenario)
    at, target = endpoint(listen, "--listen"), endpoint(to, "--to")
    if at.scheme != target.scheme:
        raise UsageError(f"--to {to}: allowed with --listen {listen}: an endpoint of {at.scheme}/")
    try:
        lasts_ns = None if duration is None else parse_duration(duration)
    except ValueError:
        raise UsageError(f"--duration {duration}: allowed: a duration such as '10 s'") from None
    link = _made(loaded, name, back, at, target, loaded.seed if seed is None else seed, stall, reset, trace, trace_back)
    begun = time.monotonic()
    with link:
        shown = _address(at, link)
        typer.echo(f"{name}: {shown} to {target}" + ("" if duration else "; Ctrl-C ends it"), err=True)
        if not at.loopback:
            typer.echo(f"{at.host} may be reached from other machines: nothing checks who sends", err=True)
        if loaded.changes_of(link_name(name)):
            typer.echo(f"{name}: the events of the scenario are left out, as there are no steps here", err=True)
        with suppress(KeyboardInterrupt):
            link.wait(None if lasts_ns is None else lasts_ns * 1e-9)
    figures, seconds = link.figures(), time.monotonic() - begun
    if json:
        about = {"link": name, "back": back, "listen": shown, "to": str(target), "seconds": seconds}
        typer.echo(json_format.dumps({**about, **figures.to_json()}))
        return
    _show(figures, seconds)


def _made(
    scenario: Scenario,
    name: str,
    back: str | None,
    at: Endpoint,
    target: Endpoint,
    seed: int,
    stalls: list[str] | None,
    resets: list[str] | None,
    trace: Path | None,
    trace_back: Path | None,
) -> SocketLink:
    from testbed.channel.service import role_of
    from testbed.channel.sockets.outages import outage
    from testbed.channel.sockets.tcp_proxy import TcpProxy
    from testbed.channel.sockets.udp_relay import UdpRelay
    from testbed.scenario.carriers import TcpTransport

    forward = _link(scenario, name, "--link")
    backward = forward.back if back is None else _link(scenario, back, "--back")
    if at.scheme == "udp" and isinstance(forward.transport, TcpTransport):
        raise UsageError(f"--listen {at}: the link has transport 'tcp'; allowed: an endpoint of tcp/")
    traces: dict[Direction, Path] = {}
    if trace is not None:
        traces["forward"] = trace
    if trace_back is not None:
        traces["backward"] = trace_back
    role = role_of(link_name(name))
    common: dict[str, Any] = {
        "forward": forward,
        "backward": backward,
        "seed": seed,
        "components": (role, f"{role}.backward"),
        "listen": (at.host, at.port),
        "traces": traces,
    }
    outages = [outage("stall", text) for text in stalls or ()] + [outage("reset", text) for text in resets or ()]
    if at.scheme == "tcp":
        return TcpProxy((target.host, target.port), outages=outages, **common)
    if outages:
        raise UsageError(f"--{outages[0].kind}: allowed with tcp/ endpoints only; over udp/, losses say it")
    return UdpRelay((target.host, target.port), **common)


def _link(scenario: Scenario, name: str, option: str) -> SteppedImpairments:
    link = link_name(name, option)
    if link == "ack" and scenario.links.ack.mode == "none":
        raise UsageError(f'{option} ack: the scenario has none; allowed: with [links.ack] mode = "perfect" or "link"')
    settings: SteppedImpairments = getattr(scenario.links, link)
    return settings


def _address(at: Endpoint, link: SocketLink) -> str:
    from testbed.channel.sockets.endpoints import Endpoint

    return str(Endpoint(at.scheme, *link.address))


def _show(figures: Figures, seconds: float) -> None:
    from rich.console import Console

    from testbed.cli.tables import row, table

    causes = sorted({key for books in figures.directions.values() for key in books if key.startswith("dropped_")})
    columns = ("sent", "delivered", *(causes or ("dropped",)), "duplicated", "corrupted", "in_flight")
    shown = table("", *(column.replace("_", " ") for column in columns))
    for direction, books in figures.directions.items():
        row(shown, direction, *(str(books.get(column, 0)) for column in columns))
    console = Console(highlight=False)
    console.print(shown)
    around = ", ".join(f"{key.replace('_', ' ')} {count}" for key, count in figures.around.items())
    console.print(f"{around}; {seconds:.1f} s", soft_wrap=True)
