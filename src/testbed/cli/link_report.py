"""``testbed link report``."""

from __future__ import annotations

import json as json_format
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from testbed.cli.link_names import link_name
from testbed.cli.tables import row, table
from testbed.errors import UsageError

if TYPE_CHECKING:
    from rich.table import Table

    from testbed.analysis.fit_intervals import Interval
    from testbed.analysis.trace_delays import Quantile
    from testbed.analysis.trace_figures import TraceFigures


def report(
    trace: Annotated[Path, typer.Argument(metavar="TRACE.csv", help="A trace, sampled or imported.")],
    scenario: Annotated[
        Path | None, typer.Option(metavar="SCENARIO.toml", help="Compare with a link of this scenario.")
    ] = None,
    name: Annotated[
        str | None, typer.Option("--link", metavar="LINK", help="Which link of it: control, observation or ack.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="REPORT.html", help="Write a page with pictures that needs nothing else.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")] = False,
) -> None:
    """Say what a trace shows of its link: losses, bursts, delays, order and copies, beside a model.

    The model is that of a link of a scenario; without --scenario the loss model that fits the trace best. Intervals
    are at 95 % and allow for the correlation of what they are of.
    """
    from testbed.analysis.trace_figures import Packets, trace_figures
    from testbed.orchestrator.trace_report import write_trace_report
    from testbed.orchestrator.trace_report.compare import fitted_model, model_of_link
    from testbed.scenario import load_scenario
    from testbed.scenario.trace_file import read_rows

    if (scenario is None) != (name is None):
        raise UsageError("--scenario, --link: got one of them; allowed: both, or neither")
    rows = read_rows(trace)
    try:
        packets = Packets.of(rows)
        if scenario is None or name is None:
            model, notes = fitted_model(packets)
        else:
            model, notes = model_of_link(load_scenario(scenario), link_name(name))
        figures = trace_figures(packets, model)
    except UsageError as error:
        raise error if scenario is not None else UsageError(f"{trace}: {error}") from None
    if out is not None:
        try:
            write_trace_report(out, str(trace), packets, figures, model, notes)
        except OSError as error:
            raise UsageError(f"cannot write {out}: {(error.strerror or str(error)).lower()}") from None
    if json:
        typer.echo(json_format.dumps({**asdict(figures), "notes": notes}, allow_nan=False, ensure_ascii=False))
        return
    _show(str(trace), figures, notes)
    if out is not None:
        typer.echo(f"page: {out}")


def _show(name: str, figures: TraceFigures, notes: list[str]) -> None:
    from rich.console import Console

    console = Console(highlight=False, markup=False)
    copies = f", {figures.copies} {'copy' if figures.copies == 1 else 'copies'}" if figures.copies else ""
    console.print(f"{name}: {figures.packets} packets, {figures.lost} lost{copies}\n", soft_wrap=True)
    parts = [_losses(figures), _delays(figures.delays) if figures.delays else f"no delays: {figures.why_no_delays}"]
    for part in (*parts, _order(figures)):
        console.print(part)
        console.print()
    if figures.model is not None:
        goodness = figures.model.goodness
        p_value = "–" if goodness.p_value is None else f"{goodness.p_value:.2g}"
        console.print(f"model: {figures.model.name}")
        console.print(f"bursts and gaps against it: χ² {goodness.chi2:.2f}, {goodness.degrees} degrees, p = {p_value}")
    for note in notes:
        console.print(note, soft_wrap=True)


def _losses(figures: TraceFigures) -> Table:
    model = figures.model
    made = table("losses", "trace", "95 % interval", *(("model", "95 % of traces") if model else ()))
    expected = [] if model is None else [f"{model.loss_rate:.4g}", _interval(model.expected)]
    row(made, "share lost", f"{figures.loss_rate:.4g}", _interval(figures.interval), *expected)
    row(made, "  were they independent", "", _interval(figures.independent_interval), *[""] * len(expected))
    burst = [] if model is None else [_number(model.mean_burst), ""]
    row(made, "mean burst", _number(figures.mean_burst), "", *burst)
    row(made, "longest burst", str(figures.longest_burst), "", *[""] * len(expected))
    row(made, "mean gap", _number(figures.mean_gap), "", *[""] * len(expected))
    row(made, "correlation time", f"{figures.correlation_time:.3g}", "", *[""] * len(expected))
    return made


def _delays(quantiles: tuple[Quantile, ...]) -> Table:
    theory = quantiles[0].theory is not None
    made = table("delay", "ms", "95 % interval", *(("law",) if theory else ()))
    for quantile in quantiles:
        cells = [f"{100 * quantile.level:g} %", _ms(quantile.value), f"{_ms(quantile.low)} … {_ms(quantile.high)}"]
        row(made, *cells, *((_ms(quantile.theory),) if theory else ()))
    return made


def _order(figures: TraceFigures) -> Table:
    order = figures.reordering
    made = table("order", "")
    row(made, "reordered packets", f"{order.reordered} of {order.arrived}, share {order.ratio:.4g}")
    row(made, "  after three sent later", str(order.three_reordered))
    if order.reordered:
        late = [None if value is None else round(value) for value in (order.late_mean_ns, order.late_max_ns)]
        row(made, "extent", f"{_number(order.extent_mean)} packets on average, {order.extent_max} at most")
        row(made, "late by", f"{_ms(late[0])} ms on average, {_ms(late[1])} ms at most")
    return made


def _interval(interval: Interval | None) -> str:
    return "–" if interval is None else f"{interval.low:.4g} … {interval.high:.4g}"


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.4g}"


def _ms(ns: int | None) -> str:
    return "–" if ns is None else f"{ns / 1e6:.4g}"
