"""``testbed analyze``."""

from __future__ import annotations

import json as json_format
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from testbed.cli.tables import row as _row
from testbed.cli.tables import table as _table

if TYPE_CHECKING:
    from rich.table import Table

_WORDS = {True: "yes", False: "no", None: "not decided"}
_STABLE = {True: "stable", False: "unstable", None: "not decided"}


def analyze(
    scenario: Annotated[Path, typer.Argument(metavar="SCENARIO.toml", help="The scenario.")],
    json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")] = False,
) -> None:
    """Say without a run what theory says of a scenario: structure, critical rates, stability, moments, convergence.

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
    for robust in figures["robust"] or ():
        console.print()
        console.print(_robust(robust))


def _facts(figures: dict[str, Any]) -> Table:
    """Name and value of each figure."""
    critical, peak, moments = figures["critical_arrival"], figures["peak"], figures["moments"]
    strong, limit = figures["strongly_observable"], figures["convergence"]
    rows = [
        ("spectral radius", _number(figures["spectral_radius"])),
        ("unstable eigenvalues", _eigenvalues(figures["unstable_eigenvalues"])),
        ("controllable", _holds(figures["controllable"], figures["uncontrollable_eigenvalues"])),
        ("observable", _holds(figures["observable"], figures["unobservable_eigenvalues"])),
        ("observability index I0", _number(figures["observability_index"])),
        ("strongly observable", "yes" if strong["holds"] else f"no: {strong['reason']}"),
        ("critical arrival rate", f"{_rate(critical)}; {critical['reason']}"),
        ("its bounds", f"{_number(critical['lower'])} … {_number(critical['upper'])}"),
        ("critical recovery rate", _number(figures["critical_recovery"])),
        *_link(figures["observation"], "observation"),
        *_link(figures["control"], "control"),
        ("peak, condition (i)", _WORDS[peak["condition_i"]]),
        ("peak, condition (ii)", f"{_WORDS[peak['condition_ii']]}; left side {_number(peak['left_side'])}"),
        ("peak, d_1, d_2, …", ", ".join(_number(d) for d in peak["d"] or []) or "–"),
        ("peak, series", _number(peak["series"])),
        ("peak, largest failure rate", _number(peak["failure_max"])),
        ("order of finite moments", _number(moments["order"]) if moments["order"] is not None else "all"),
        ("mean finite", _WORDS[moments["finite_mean"]]),
        ("variance finite", _WORDS[moments["finite_variance"]]),
    ]
    if limit["limit_trace"] is not None:
        traces = f"{_number(limit['limit_trace'])} predicted, {_number(limit['updated_trace'])} updated"
        rows.append(("trace without losses", traces))
    if limit["rate"] is not None:
        rows.append(("approached as", f"{_number(limit['rate'])}^k"))
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
    _row(table, "convergence", _WORDS[limit["holds"]], limit["theorem"], limit["reason"])
    for robust in figures["robust"] or ():
        name, forgets = f"{robust['name']} forgets P_0", _WORDS[robust["converges"]]
        _row(table, name, forgets, robust["theorem"], robust["reason"])
    return table


def _robust(figures: dict[str, Any]) -> Table:
    """Name and value of each figure of one RSEIO."""
    table = _table(f"{figures['name']}, mu = {_number(figures['mu'])}", "value")
    pattern, window = figures["pattern"], figures["window"]
    for of in ("observable", "controllable"):
        tests = [test for test in figures["pairs"] if test["of"] == of]
        if tests:
            passed = sum(test["full"] for test in tests)
            best = max(test["smallest"] for test in tests)
            text = f"{passed} of {len(tests)}; best smallest singular value {_number(best)}"
            _row(table, f"pairs {of}", f"{text}, tolerance {_number(figures['tolerance'])}")
    if pattern is not None:
        kind = "shortest that contracts" if pattern["contracts"] else "none of them contracts"
        _row(table, "arrivals", f"{pattern['arrivals']}; {kind}, {pattern['checked']} looked at")
        for name in ("O_b", "C_n"):
            rank = pattern[name]
            _row(table, f"rank of {name}", f"{rank['rank']}; smallest singular value {_number(rank['smallest'])}")
        _row(table, "contraction of δ", _number(pattern["contraction"]))
    if window is not None:
        text = f"{window['patterns']} patterns; least {_number(window['best'])}"
        _row(table, f"over {window['steps']} steps", f"{text}, in the long run {_number(window['rate'])} a step")
    _row(table, "δ from P_0", _number(figures["distance"]))
    return table


def _link(link: dict[str, Any], name: str) -> list[tuple[str, str]]:
    """The stationary loss, and the laws of the lengths l of runs: geometric ones for a chain of arrivals."""
    if link["mean_burst"] is None and not link["stationary_loss"]:
        return [(f"{name} link", "no losses")]
    lost = f"{_number(link['stationary_loss'])} lost in the long run"
    if link["recovery"] is None:
        longest = "" if link["burst_99"] is None else f", 99 % at most {link['burst_99']}"
        near, further = _number(link["correlation"]), _number(link["memory"])
        return [
            (f"{name} link", lost),
            ("its bursts of losses", f"mean {_number(link['mean_burst'])}{longest}"),
            ("its runs of deliveries", f"mean {_number(link['mean_good_run'])}"),
            ("its θ", f"{_number(link['burst_decay'])}: P(m losses in a row) falls like θ^m"),
            ("its correlation", f"{near} between neighbours, in the long run times {further} a packet"),
        ]
    return [
        (f"{name} link", lost),
        ("its bursts of losses", _law(link["recovery"], link["burst_99"])),
        ("its runs of deliveries", _law(link["failure"], None)),
    ]


def _law(end: float, quantile: int | None) -> str:
    if end in (0.0, 1.0):
        return "of length 1" if end else "never end"
    text = f"{_number(end)} · {_number(1.0 - end)}^(l−1), mean {_number(1.0 / end)}"
    return text if quantile is None else f"{text}, 99 % at most {quantile}"


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
