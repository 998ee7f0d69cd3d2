"""Loss models of largest likelihood for the fates of a link, and which of them the fates ask for."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from testbed.analysis import fit_four_state as four_state
from testbed.analysis import fit_gilbert_elliott as gilbert_elliott
from testbed.analysis.fit_chains import chain_log_likelihood, fit_bernoulli, fit_markov, transitions
from testbed.analysis.fit_goodness import Goodness, goodness
from testbed.analysis.fit_intervals import Interval, chain_loss, wilson
from testbed.analysis.fit_search import Found
from testbed.channel.hidden import Hidden
from testbed.channel.law import LossModel
from testbed.errors import UsageError
from testbed.numerics.lanes import Bools, Floats

PACKETS_MIN = 20
_DIGITS = 6


@dataclass(frozen=True)
class Parameter:
    """As in the scenario. interval: 95 %; None where there is none, and ``note`` says why."""

    name: str
    value: float
    interval: Interval | None
    note: str = ""


@dataclass(frozen=True)
class Fitted:
    """A model of largest likelihood. loss: its stationary loss. toml: the line for the scenario."""

    kind: str
    parameters: tuple[Parameter, ...]
    loss: Parameter
    mean_burst: float | None
    log_likelihood: float
    aic: float
    bic: float
    goodness: Goodness
    toml: str


@dataclass(frozen=True)
class Ratio:
    """Likelihood-ratio test of a model within another one. p_value None where no law is known."""

    small: str
    large: str
    statistic: float
    degrees: int
    p_value: float | None
    note: str


@dataclass(frozen=True)
class Fit:
    """All models, the smallest first. ``chosen``: the kind with the least BIC."""

    packets: int
    lost: int
    models: tuple[Fitted, ...]
    ratios: tuple[Ratio, ...]
    chosen: str


def fit_losses(fates: Bools) -> Fit:
    """Fit Bernoulli, Markov, Gilbert–Elliott and four-state losses, each stationary at the first packet.

    fates: (n,), in the order of sending, True where a packet arrived. Raises UsageError for fewer than PACKETS_MIN
    packets, and where none or all were lost: then it says what that tells of the rate.
    """
    number, lost = len(fates), int(len(fates) - np.count_nonzero(fates))
    if number < PACKETS_MIN:
        raise UsageError(f"got {number} packet{'s' * (number != 1)}; allowed: {PACKETS_MIN} or more")
    if lost in (0, number):
        share, rate = ("none", "loss") if lost == 0 else ("all", "arrival")
        raise UsageError(
            f"{share} of {number} packets lost: nothing to fit; allowed: some lost, some not; the {rate} rate is at "
            f"most {3 / number:.3g} with 95 % confidence if losses are independent (rule of three)"
        )
    models = (_bernoulli(fates, lost), _markov(fates, lost), _gilbert_elliott(fates), _four_state(fates))
    chosen = min(models, key=lambda model: model.bic)
    return Fit(number, lost, models, _ratios(*models), chosen.kind)


def _bernoulli(fates: Bools, lost: int) -> Fitted:
    chain = fit_bernoulli(fates)
    loss = Parameter("loss", 1.0 - chain.arrival, wilson(lost, len(fates)))
    return _fitted("bernoulli", fates, chain, (loss,), loss, chain_log_likelihood(fates, chain))


def _markov(fates: Bools, lost: int) -> Fitted:
    chain, counts = fit_markov(fates), transitions(fates)
    rates = (
        Parameter("recovery", chain.recovery, wilson(int(counts[0, 1]), int(counts[0].sum()))),
        Parameter("failure", chain.failure, wilson(int(counts[1, 0]), int(counts[1].sum()))),
    )
    loss = Parameter("loss", 1.0 - chain.arrival, chain_loss(lost, len(fates), chain))
    return _fitted("markov", fates, chain, rates, loss, chain_log_likelihood(fates, chain))


def _gilbert_elliott(fates: Bools) -> Fitted:
    found = gilbert_elliott.fit_gilbert_elliott(fates)
    values = gilbert_elliott.parameters(found.losses)
    return _hidden("gilbert-elliott", fates, found, gilbert_elliott.NAMES, values)


def _four_state(fates: Bools) -> Fitted:
    found = four_state.fit_four_state(fates)
    values = four_state.parameters(found.losses)
    return _hidden("four-state", fates, found, four_state.NAMES, values)


def _hidden(kind: str, fates: Bools, found: Found[Hidden], names: tuple[str, ...], values: Floats) -> Fitted:
    why = found.obstacle or "at the boundary, held there for the others"
    given = tuple(
        Parameter(name, float(value), interval, why if interval is None else "")
        for name, value, interval in zip(names, values, found.intervals, strict=True)
    )
    loss = Parameter("loss", 1.0 - found.losses.arrival, found.loss_interval, "" if found.loss_interval else why)
    return _fitted(kind, fates, found.losses, given, loss, found.log_likelihood)


def _fitted(
    kind: str, fates: Bools, losses: LossModel, given: tuple[Parameter, ...], loss: Parameter, reached: float
) -> Fitted:
    number = len(given)
    aic, bic = 2.0 * number - 2.0 * reached, number * math.log(len(fates)) - 2.0 * reached
    fit = goodness(fates, losses, number)
    return Fitted(kind, given, loss, losses.mean_burst, reached, aic, bic, fit, _toml(kind, given))


def _toml(kind: str, given: tuple[Parameter, ...]) -> str:
    values = {p.name: float(f"{p.value:.{_DIGITS}g}") for p in given}
    if values.get("to_good", 0.0) + values.get("to_pause", 0.0) > 1.0:  # by rounding; a scenario refuses it
        values["to_pause"] = 1.0 - values["to_good"]
    listed = ", ".join(f"{name} = {value!r}" for name, value in values.items())
    return f'loss = {{ kind = "{kind}", {listed} }}'


def _ratios(bernoulli: Fitted, markov: Fitted, full: Fitted, four: Fitted) -> tuple[Ratio, ...]:
    """Of two models on the boundary of the larger one the law is a mixture of χ² with fewer degrees of freedom.

    S. G. Self, K.-Y. Liang: Asymptotic properties of maximum likelihood estimators and likelihood ratio tests under
    nonstandard conditions. JASA 82 (1987) 605–610.
    """
    return (
        _ratio(bernoulli, markov, 1, True, ""),
        _ratio(markov, full, 2, True, "at most this: loss_good = 0 and loss_bad = 1 lie on the boundary"),
        _ratio(bernoulli, full, 3, False, "no χ² law: with independent losses the states cannot be told"),
        _ratio(markov, four, 3, False, "no χ² law: without pauses from_pause means nothing"),
    )


def _ratio(small: Fitted, large: Fitted, degrees: int, lawful: bool, note: str) -> Ratio:
    statistic = max(0.0, 2.0 * (large.log_likelihood - small.log_likelihood))
    return Ratio(
        small.kind, large.kind, statistic, degrees, float(chdtrc(degrees, statistic)) if lawful else None, note
    )
