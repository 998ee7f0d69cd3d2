"""``testbed link hosts``."""

from __future__ import annotations

import json as json_format
import shlex
import signal
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from testbed.cli.link_names import link_name
from testbed.errors import UsageError, did_you_mean

if TYPE_CHECKING:
    from testbed.channel.kernel.hosts import Backend, Hosts, Way
    from testbed.scenario import Scenario
    from testbed.scenario.links import SteppedImpairments

_INTERRUPTED = 130
_BACKENDS: tuple[Backend, ...] = ("tun", "netem")


def hosts(
    scenario: Annotated[Path, typer.Argument(metavar="SCENARIO.toml", help="The scenario.")],
    command: Annotated[
        list[str], typer.Argument(metavar="COMMAND...", help="What runs in host a; after the options and --.")
    ],
    name: Annotated[str, typer.Option("--link", metavar="LINK", help="Its link that impairs the way from a to b.")],
    back: Annotated[
        str | None,
        typer.Option(
            metavar="LINK", help="The link that impairs the way back; default: the table `back` of --link, or nothing."
        ),
    ] = None,
    b: Annotated[
        str | None, typer.Option("--b", metavar="COMMAND", help="What runs in host b, until that in a has ended.")
    ] = None,
    head_start: Annotated[
        str, typer.Option(metavar="DURATION", help="How long that in b runs before that in a starts.")
    ] = "500 ms",
    seed: Annotated[int | None, typer.Option(min=0, help="Seed; default that of the scenario.")] = None,
    congestion: Annotated[
        str | None, typer.Option(metavar="NAME", help="TCP congestion control, such as cubic; default the kernel's.")
    ] = None,
    mtu: Annotated[int, typer.Option(metavar="BYTES", help="Largest IP packet.")] = 1500,
    backend: Annotated[str, typer.Option(metavar="BACKEND", help="tun, or netem where the kernel has it.")] = "tun",
    trace: Annotated[Path | None, typer.Option(metavar="TRACE.csv", help="Trace of the way from a to b.")] = None,
    trace_back: Annotated[Path | None, typer.Option(metavar="TRACE.csv", help="Trace of the way back.")] = None,
    json: Annotated[bool, typer.Option("--json", help="Print the books as JSON, in the last line.")] = False,
) -> None:
    """Run commands in two hosts with a link of a scenario between them: real IP packets, the kernel's own TCP.

    Host a is 10.0.0.1 and b 10.0.0.2; they reach each other and nothing else. Files, users and devices are those of
    this machine. When COMMAND has ended, all that runs in the hosts is ended, and the books of the link are printed.
    The exit code is that of COMMAND, or 130 after Ctrl-C.
    """
    from testbed.channel.kernel.hosts import Hosts
    from testbed.scenario import load_scenario, parse_duration

    loaded = load_scenario(scenario)
    forward, backward = _ways(loaded, name, back, trace, trace_back)
    try:
        wait_s = parse_duration(head_start) * 1e-9
    except ValueError:
        raise UsageError(f"--head-start {head_start}: allowed: a duration such as '500 ms'") from None
    if backend not in _BACKENDS:
        allowed = f"{', '.join(_BACKENDS)}{did_you_mean(backend, _BACKENDS)}"
        raise UsageError(f"--backend {backend}: no such backend; allowed: {allowed}")
    seed = loaded.seed if seed is None else seed
    codes: dict[str, int | None] = {"a": None}
    with Hosts(forward, backward, seed=seed, congestion=congestion, mtu=mtu, backend=_backend(backend)) as pair:
        _report_removed(pair)
        server = None
        if b is not None:
            server = pair.b.popen(_words(b))
            time.sleep(wait_s)
        client = pair.a.popen(command)
        with suppress(KeyboardInterrupt):  # Ctrl-C reaches the commands too
            codes["a"] = client.wait()
        if server is not None:
            codes["b"] = server.poll()
    _show(pair, name, back, codes, json)
    raise typer.Exit(_INTERRUPTED if codes["a"] is None else _exit_code(codes["a"]))


def _ways(
    scenario: Scenario, name: str, back: str | None, trace: Path | None, trace_back: Path | None
) -> tuple[Way, Way]:
    from testbed.channel.kernel.hosts import Way
    from testbed.channel.service import role_of
    from testbed.scenario.links import Impairments

    forward = _link(scenario, name, "--link")
    backward = forward.back if back is None else _link(scenario, back, "--back")
    role = role_of(link_name(name))
    return Way(forward, role, trace), Way(backward or Impairments(), f"{role}.backward", trace_back)


def _link(scenario: Scenario, name: str, option: str) -> SteppedImpairments:
    link = link_name(name, option)
    if link == "ack" and scenario.links.ack.mode == "none":
        raise UsageError(f'{option} ack: the scenario has none; allowed: with [links.ack] mode = "perfect" or "link"')
    settings: SteppedImpairments = getattr(scenario.links, link)
    return settings


def _backend(name: str) -> Backend:
    return "netem" if name == "netem" else "tun"


def _words(text: str) -> list[str]:
    try:
        return shlex.split(text)
    except ValueError as error:
        raise UsageError(f"--b {text}: {str(error).lower()}; allowed: a command line as for a shell") from None


def _exit_code(code: int) -> int:
    """As a shell has it: 128 + the signal that killed."""
    return 128 - code if code < 0 else code


def _report_removed(pair: Hosts) -> None:
    for one in pair.removed:
        typer.echo(f"ended what {one.hosts} had left: {one.pid} {one.command}", err=True)


def _ending(code: int | None) -> str:
    if code is None:
        return "ended with the hosts"
    return f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"


def _show(pair: Hosts, name: str, back: str | None, codes: dict[str, int | None], json: bool) -> None:
    books = pair.books()
    if json:
        figures: dict[str, Any] = {"link": name, "back": back, "exit_codes": codes, "killed": pair.stubborn, **books}
        typer.echo(json_format.dumps(figures))
        return
    from rich.console import Console

    from testbed.cli.tables import row, table

    columns = list(dict.fromkeys(column for counts in books.values() for column in counts))
    shown = table("", *books)
    for column in columns:
        row(shown, column.replace("_", " "), *(str(counts.get(column, 0)) for counts in books.values()))
    console = Console(highlight=False)
    console.print(shown)
    for host, code in codes.items():
        console.print(f"{host}: {_ending(code)}")
    for command in pair.stubborn:
        console.print(f"did not end when asked, killed: {command}")
