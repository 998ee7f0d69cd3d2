"""``testbed link …``."""

from __future__ import annotations

import json as json_format
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from testbed.cli import link_doctor, link_hosts, link_relay
from testbed.cli.link_import import import_
from testbed.cli.link_names import link_name
from testbed.cli.link_presets import presets
from testbed.cli.link_report import report
from testbed.errors import UsageError

app = typer.Typer(help="Look at one link: of a scenario, or of a trace.", rich_markup_mode=None)

app.command("import")(import_)
app.command()(presets)
app.command()(report)

_LANE_MAX = 2**31 - 2  # the last lane of the largest scenario


@app.callback()
def _group() -> None:
    pass


@app.command()
def sample(
    scenario: Annotated[Path, typer.Argument(metavar="SCENARIO.toml", help="The scenario.")],
    name: Annotated[str, typer.Option("--link", metavar="LINK", help="control, observation or ack.")],
    number: Annotated[int, typer.Option("-n", min=1, metavar="N", help="Number of packets.")],
    out: Annotated[Path, typer.Option(metavar="TRACE.csv", help="File for the trace.")],
    seed: Annotated[int | None, typer.Option(min=0, help="Seed; default that of the scenario.")] = None,
    lane: Annotated[int, typer.Option(min=0, help="Lane whose packets are sampled.")] = 0,
    json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")] = False,
) -> None:
    """Send N packets over a link in simulated time and write what became of each.

    TRACE.csv has the columns seq, sent_ns, delivered_ns, the last empty for a lost packet. With the seed of a run the
    packets meet the same fate as in that run.
    """
    from testbed.channel.trace import sample_trace, write_trace
    from testbed.scenario import load_scenario

    loaded = load_scenario(scenario)
    link = link_name(name)
    if lane > _LANE_MAX:
        raise UsageError(f"--lane {lane}: allowed: 0 … {_LANE_MAX}")
    if link == "ack" and loaded.links.ack.mode == "none":
        raise UsageError('--link ack: the scenario has none; allowed: with [links.ack] mode = "perfect" or "link"')
    trace = sample_trace(loaded, link, number, seed=loaded.seed if seed is None else seed, lane=lane)
    try:
        write_trace(out, trace)
    except OSError as error:
        raise UsageError(f"cannot write {out}: {(error.strerror or str(error)).lower()}") from None
    figures = trace.figures()
    if json:
        typer.echo(json_format.dumps(figures))
        return
    expected = figures["expected_loss_rate"]
    typer.echo(
        f"{link}: {figures['sent']} sent, {figures['dropped']} lost, loss rate {figures['loss_rate']:.6g} "
        f"(expected {'–' if expected is None else f'{expected:.6g}'}), mean burst {_shown(figures['mean_burst'])} "
        f"(expected {_shown(figures['expected_mean_burst'])}); {out}"
    )


@app.command()
def fit(
    trace: Annotated[Path, typer.Argument(metavar="TRACE.csv", help="A trace, as `testbed link sample` writes it.")],
    json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")] = False,
) -> None:
    """Fit Bernoulli, Markov, Gilbert-Elliott and four-state losses to a trace by maximum likelihood, and choose by BIC.

    Shows the parameters with 95 % intervals, whether the lengths of bursts and gaps fit, and the line for the
    scenario. A packet with several rows is one packet, which arrived if one of them has delivered_ns.
    """
    from testbed.analysis.fit import fit_losses
    from testbed.scenario.trace_file import read_fates

    fates = read_fates(trace)
    try:
        fitted = fit_losses(fates.arrived)
    except UsageError as error:
        raise UsageError(f"{trace}: {error}") from None
    if json:
        figures = {"duplicates": fates.duplicates, **asdict(fitted)}
        typer.echo(json_format.dumps(figures, allow_nan=False))
        return
    from testbed.cli.fit_tables import show

    show(str(trace), fitted, fates.duplicates)


@app.command(name="set")
def set_(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="The folder of a run that goes.")],
    name: Annotated[str, typer.Argument(metavar="LINK", help="control, observation or ack.")],
    settings: Annotated[
        list[str], typer.Argument(metavar="KEY=VALUE…", help="Keys of the link's table, such as loss.failure=0.4.")
    ],
) -> None:
    """Change a link of a run that goes: other values for keys of its table, from the next step on.

    The random streams go on, and nothing in flight is lost. A value "none" removes a stage. The step from which the
    change holds is printed, and is in the results of the run.
    """
    from testbed.orchestrator.running import ask
    from testbed.scenario.changes import parse_setting, together

    change = together([parse_setting(text) for text in settings])
    answer = ask(run, {"link": link_name(name), "set": change})
    typer.echo(f"{name}: from step {answer['step']} on")


def _shown(value: float | None) -> str:
    return "–" if value is None else f"{value:.4g}"


app.command("relay")(link_relay.relay)
app.command("hosts")(link_hosts.hosts)
app.command("doctor")(link_doctor.doctor)
app.command("clean")(link_doctor.clean)
