"""What ``testbed link fit`` prints for a person."""

from __future__ import annotations

from typing import TYPE_CHECKING

from testbed.cli.tables import row, table

if TYPE_CHECKING:
    from rich.table import Table

    from testbed.analysis.fit import Fit, Fitted, Parameter

_SURE = 0.05  # below this p-value a model does not fit


def show(name: str, fit: Fit, duplicates: int) -> None:
    """Print the tables, the choice, and the line for the scenario."""
    from rich.console import Console

    console = Console(highlight=False, markup=False)
    again = f", {duplicates} duplicate{'s' * (duplicates != 1)}" if duplicates else ""
    console.print(f"{name}: {fit.packets} packets, {fit.lost} lost{again}\n")
    for part in (_parameters(fit), _models(fit), _ratios(fit)):
        console.print(part)
        console.print()
    console.print(chosen(fit))
    console.print(_best(fit).toml, soft_wrap=True)


def chosen(fit: Fit) -> str:
    """Which model, why, and whether it fits."""
    best, *others = sorted(fit.models, key=lambda model: model.bic)
    why = "; ".join(f"{other.bic - best.bic:.4g} less than {other.kind}" for other in others)
    p_value = best.goodness.p_value
    if p_value is None:
        fits = "too few runs to say whether it fits"
    elif p_value < _SURE:
        fits = f"but the lengths of its runs do not fit, p = {p_value:.2g}: none of these models may be right"
    else:
        fits = f"and the lengths of its runs fit, p = {p_value:.2g}"
    return f"{best.kind} has the least BIC: {why}; {fits}."


def _best(fit: Fit) -> Fitted:
    return next(model for model in fit.models if model.kind == fit.chosen)


def _parameters(fit: Fit) -> Table:
    made = table("model", "parameter", "value", "95 % interval")
    for model in fit.models:
        parameters = [*model.parameters]
        if "loss" not in {parameter.name for parameter in parameters}:
            parameters.append(model.loss)
        for index, parameter in enumerate(parameters):
            row(made, "" if index else model.kind, parameter.name, f"{parameter.value:.4g}", _interval(parameter))
    return made


def _models(fit: Fit) -> Table:
    made = table("model", "log-likelihood", "AIC", "BIC", "χ² of runs", "degrees", "p-value")
    for model in fit.models:
        runs = model.goodness
        figures = [f"{value:.2f}" for value in (model.log_likelihood, model.aic, model.bic, runs.chi2)]
        row(made, model.kind, *figures, str(runs.degrees), _p(runs.p_value))
    return made


def _ratios(fit: Fit) -> Table:
    made = table("likelihood ratio of", "2 log", "degrees", "p-value", "")
    for ratio in fit.ratios:
        pair = f"{ratio.small}, {ratio.large}"
        row(made, pair, f"{ratio.statistic:.2f}", str(ratio.degrees), _p(ratio.p_value), ratio.note)
    return made


def _interval(parameter: Parameter) -> str:
    if parameter.interval is None:
        return f"–; {parameter.note}"
    return f"{parameter.interval.low:.4g} … {parameter.interval.high:.4g}"


def _p(value: float | None) -> str:
    return "–" if value is None else f"{value:.2g}"
