"""``testbed replay``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from testbed.errors import UsageError


def replay(
    scenario: Annotated[Path, typer.Argument(metavar="SCENARIO.toml", help="The scenario.")],
    packets: Annotated[
        Path, typer.Argument(metavar="PACKETS", help="PACKETS.jsonl, or the recording.mcap of a run; - for stdin.")
    ],
    estimator: Annotated[str, typer.Option(metavar="NAME", help="An estimator of the scenario, or a kind.")],
    out: Annotated[Path | None, typer.Option(metavar="OUT.jsonl", help="Estimates; default stdout.")] = None,
    lane: Annotated[int, typer.Option(min=0, help="Lane of the recording.")] = 0,
    buffer: Annotated[
        int, typer.Option(metavar="STEPS", help="Use observations and ACKs that are late by up to so many steps.")
    ] = 0,
) -> None:
    """Run an estimator over recorded packets, without a network: a line {"k", "x_hat", "P"} a step.

    The estimator gets the ACKs that the packets hold, unless its table says acks = "none". Without --buffer, late
    observations are counted and not used.
    """
    from testbed.estimator.packets import read_packets
    from testbed.estimator.packets import replay as replay_packets
    from testbed.estimator.refilter import Refilter
    from testbed.estimator.registry import create, model_of
    from testbed.scenario import EstimatorSpec, load_scenario

    loaded = load_scenario(scenario)
    spec = next((s for s in loaded.estimators if s.name == estimator), None) or EstimatorSpec(name=estimator)
    model = model_of(loaded)
    made = Refilter(create(spec.kind, model, lanes=1, options=spec.options, lane=lane), buffer)
    lines = _lines(packets, lane, perfect=spec.acks == "perfect")
    written = []
    try:
        for line in replay_packets(
            made, model, read_packets(lines, model), use_acks=spec.acks != "none", until=spec.until
        ):
            if out is None:
                sys.stdout.write(line + "\n")
            else:
                written.append(line)
    except UsageError as error:
        raise UsageError(f"{packets}: {error}") from None
    if out is not None:
        _write(out, written)
    for name, count in sorted(made.counters.items()):
        if count:
            typer.echo(f"testbed: {estimator}: {name} {count}", err=True)


def _lines(packets: Path, lane: int, *, perfect: bool) -> list[str]:
    from testbed.orchestrator.recording import packets_of_recording

    try:
        if packets.suffix == ".mcap":
            return packets_of_recording(
                packets, lane, perfect_acks=perfect, say=lambda line: typer.echo(f"testbed: {line}", err=True)
            )
        return (sys.stdin.read() if str(packets) == "-" else packets.read_text()).splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a text file"
        raise UsageError(f"cannot read {packets}: {(reason or str(error)).lower()}") from None


def _write(out: Path, lines: list[str]) -> None:
    try:
        out.write_text("".join(line + "\n" for line in lines))
    except OSError as error:
        raise UsageError(f"cannot write {out}: {(error.strerror or str(error)).lower()}") from None
