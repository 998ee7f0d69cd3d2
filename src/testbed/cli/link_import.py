"""``testbed link import``."""

from __future__ import annotations

import json as json_format
from pathlib import Path
from typing import Annotated, Any, cast, get_args

import typer
from pydantic_core import PydanticCustomError

from testbed.errors import UsageError, did_you_mean


def import_(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A capture (pcap, pcapng) or a log of ping.")],
    out: Annotated[Path, typer.Option(metavar="TRACE.csv", help="File for the trace.")],
    receiver: Annotated[
        Path | None, typer.Option(metavar="FILE", help="A second capture, where the packets of the first arrive.")
    ] = None,
    format: Annotated[str, typer.Option(metavar="FORMAT", help="auto, capture or ping.")] = "auto",
    protocol: Annotated[str | None, typer.Option(metavar="NAME", help="Only udp, tcp or icmp.")] = None,
    source: Annotated[str | None, typer.Option("--from", metavar="ADDRESS", help="Only packets from there.")] = None,
    to: Annotated[str | None, typer.Option(metavar="ADDRESS", help="Only packets to there.")] = None,
    from_port: Annotated[int | None, typer.Option(min=0, max=65535, help="Only packets from this port.")] = None,
    to_port: Annotated[int | None, typer.Option(min=0, max=65535, help="Only packets to this port.")] = None,
    rtp: Annotated[bool, typer.Option("--rtp", help="The packets are RTP: use its sequence numbers.")] = False,
    sequence: Annotated[
        str | None,
        typer.Option(
            metavar="OFFSET:BYTES", help="Where the payload has a number that counts the packets; `:little` after it."
        ),
    ] = None,
    match: Annotated[
        str, typer.Option(metavar="HOW", help="How packets of two captures are told: packet or payload.")
    ] = "packet",
    interval: Annotated[
        str | None, typer.Option(metavar="DURATION", help="Between pings of a log without times; default 1 s.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")] = False,
) -> None:
    """Make a trace of a capture of packets, of two, or of the log of a ping.

    A log of ping, or a capture with pings in it, gives round trips. Two captures, at the sender and with --receiver at
    the receiver, give what was lost on the way, and one-way delays on two clocks. One capture at the receiver gives
    what was lost if the packets carry numbers: --rtp, or --sequence. What was not used is counted.
    """
    from testbed.channel.capture.datagrams import PROTOCOLS
    from testbed.channel.capture.flows import Filter
    from testbed.channel.capture.numbered import RTP, Numbering
    from testbed.channel.capture.pairing import Match
    from testbed.channel.capture.read import Format, Wish, import_trace
    from testbed.scenario.trace_file import write_rows

    if rtp and sequence is not None:
        raise UsageError("--rtp, --sequence: got both; allowed: one of them")
    wish = Wish(
        format=cast(Format, _one_of("--format", format, get_args(Format))),
        receiver=receiver,
        wanted=Filter(
            None if protocol is None else _one_of("--protocol", protocol, sorted({*PROTOCOLS.values()})),
            source,
            to,
            from_port,
            to_port,
        ),
        numbering=RTP if rtp else Numbering.parse(sequence) if sequence is not None else None,
        match=cast(Match, _one_of("--match", match, get_args(Match))),
        interval_ns=None if interval is None else _duration("--interval", interval),
    )
    imported = import_trace(file, wish)
    try:
        write_rows(out, imported.rows)
    except OSError as error:
        raise UsageError(f"cannot write {out}: {(error.strerror or str(error)).lower()}") from None
    figures = imported.figures()
    if json:
        typer.echo(json_format.dumps(figures, ensure_ascii=False))
    else:
        _show(file, out, figures)


def _show(file: Path, out: Path, figures: dict[str, Any]) -> None:
    copies = figures["duplicates"]
    typer.echo(
        f"{file}: {figures['measures']}, {figures['sent']} sent, {figures['dropped']} lost, "
        f"loss rate {figures['loss_rate']:.6g}, {copies} duplicate{'s' * (copies != 1)}; {out}"
    )
    if figures["left_out"]:
        counts = "; ".join(f"{count} {reason}" for reason, count in figures["left_out"].items())
        typer.echo(f"left out: {counts}")
    for note in figures["notes"]:
        typer.echo(f"note: {note}")


def _one_of(option: str, given: str, allowed: Any) -> str:
    if given not in allowed:
        raise UsageError(f"{option}: got {given[:60]!r}; allowed: {', '.join(allowed)}{did_you_mean(given, allowed)}")
    return given


def _duration(option: str, text: str) -> int:
    from testbed.scenario.durations import parse_duration

    try:
        return parse_duration(text)
    except PydanticCustomError as error:
        raise UsageError(f"{option}: {error.message()}") from None
