"""``testbed analyze``."""

from __future__ import annotations

import json as json_format
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from rich.table import Table

_WORDS = {True: "yes", False: "no", None: "not decided"}
_STABLE = {True: "stable", False: "unstable", None: "not decided"}


def analyze(
    scenario: Annotated[Path, typer.Argument(metavar="SCENARIO.toml", help="The scenario.")],
    json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")] = False,
) -> None:
    """Say without a run what theory says of a scenario: structure, critical rates, stability, finite moments.

    A verdict is stable, unstable or not decided, and comes with the theorem that gives it. The letters are those of
    the papers in the page on theory.
    """
    from testbed.analysis.verdicts import analyze as figures_of
    from testbed.scenario import load_scenario

    figures = figures_of(load_scenario(scenario))
    if json:
        typer.echo(json_format.dumps(figures, allow_nan=False))
        return
    from rich.console import Console

    console = Console(highlight=False)
    console.print(figures["name"], style="bold", markup=False)
    console.print(_facts(figures))
    console.print()
    console.print(_verdicts(figures))


def _facts(figures: dict[str, Any]) -> Table:
    """Name and value of each figure."""
    critical, peak, moments = figures["critical_arrival"], figures["peak"], figures["moments"]
    strong, observation = figures["strongly_observable"], figures["observation"]
    rows = [
        ("spectral radius", _number(figures["spectral_radius"])),
        ("unstable eigenvalues", _eigenvalues(figures["unstable_eigenvalues"])),
        ("controllable", _holds(figures["controllable"], figures["uncontrollable_eigenvalues"])),
        ("observable", _holds(figures["observable"], figures["unobservable_eigenvalues"])),
        ("observability index", _number(figures["observability_index"])),
        ("strongly observable", "yes" if strong["holds"] else f"no: {strong['reason']}"),
        ("critical arrival rate", f"{_rate(critical)}; {critical['reason']}"),
        ("critical recovery rate", _number(figures["critical_recovery"])),
    ]
    for name in ("observation", "control"):
        link = figures[name]
        text = f"{_number(link['stationary_loss'])} lost, bursts of {_number(link['mean_burst'])} on average"
        rows.append((f"{name} link", text if link["mean_burst"] or link["stationary_loss"] else "no losses"))
    for name in ("observation", "control"):
        link = figures[name]
        if link["recovery"] is None:
            near, further = _number(link["correlation"]), _number(link["memory"])
            rows.append((f"{name} link, θ", f"{_number(link['burst_decay'])}: P(m losses in a row) falls like θ^m"))
            rows.append((f"{name} link, correlation", f"{near} between neighbours, times {further} a packet"))
    if observation["burst_99"] is not None:
        rows.append(("bursts, 99 %", f"at most {observation['burst_99']} on the observation link"))
    rows += [
        ("peak, condition (i)", _WORDS[peak["condition_i"]]),
        ("peak, condition (ii)", f"{_WORDS[peak['condition_ii']]}; left side {_number(peak['left_side'])}"),
        ("peak, largest failure rate", _number(peak["failure_max"])),
        ("order of finite moments", _number(moments["order"]) if moments["order"] is not None else "all"),
        ("mean finite", _WORDS[moments["finite_mean"]]),
        ("variance finite", _WORDS[moments["finite_variance"]]),
    ]
    table = _table("figure", "value")
    for name, value in rows:
        _row(table, name, value)
    return table


def _verdicts(figures: dict[str, Any]) -> Table:
    table = _table("of", "verdict", "theorem", "because")
    for name, verdict in (
        ("observation losses", figures["observation"]),
        ("control losses", figures["control"]),
        ("lower bound", figures["bounds"]["lower"]),
        ("upper bound", figures["bounds"]["upper"]),
        ("peak covariance", figures["peak"]),
    ):
        _row(table, name, _STABLE[verdict["stable"]], verdict["theorem"], verdict["reason"])
    limit = figures["convergence"]
    _row(table, "convergence", "yes" if limit["holds"] else "not decided", limit["theorem"], limit["reason"])
    return table


def _table(*heads: str) -> Table:
    from rich.table import Table

    table = Table(*heads, box=None, pad_edge=False, header_style="dim", padding=(0, 2, 0, 0))
    for column in table.columns[:-1]:
        column.no_wrap = True
    return table


def _row(table: Table, *cells: str) -> None:
    from rich.text import Text

    table.add_row(*(Text(cell) for cell in cells))


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.6g}"


def _eigenvalues(pairs: list[list[float | None]]) -> str:
    from testbed.analysis.strong import shown

    return ", ".join(shown(complex(*(math.inf if part is None else part for part in pair))) for pair in pairs) or "none"


def _holds(holds: bool, failing: list[list[float | None]]) -> str:
    return "yes" if holds else f"no: fails at {_eigenvalues(failing)}"


def _rate(critical: dict[str, Any]) -> str:
    if critical["exact"] is not None:
        return _number(critical["exact"])
    return f"{_number(critical['lower'])} … {_number(critical['upper'])}"
