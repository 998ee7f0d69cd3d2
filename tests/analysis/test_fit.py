"""Fits of all models: known parameters come back, tests reject as often as they say, and limits are named."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import minimize

from analysis import fates as draw
from testbed.analysis.fit import Fit, Parameter, fit_losses
from testbed.analysis.fit_chains import chain_log_likelihood, fit_bernoulli, fit_markov
from testbed.analysis.fit_gilbert_elliott import fit_gilbert_elliott, parameters, score
from testbed.analysis.fit_goodness import goodness, runs
from testbed.analysis.fit_states import Fates
from testbed.channel.gilbert_elliott import GilbertElliott
from testbed.channel.loss import Chain
from testbed.errors import UsageError
from testbed.scenario import parse_scenario

LEVEL = 1e-3
TRUTH = GilbertElliott.of(0.02, 0.2, 0.01, 0.6)


def wide(parameter: Parameter) -> tuple[float, float]:
    """An interval of twice the width."""
    assert parameter.interval is not None
    half = parameter.interval.high - parameter.interval.low
    return parameter.value - half, parameter.value + half


def kind(fit: Fit, name: str) -> dict[str, Parameter]:
    model = next(model for model in fit.models if model.kind == name)
    return {p.name: p for p in (model.loss, *model.parameters)}


def holds(found: dict[str, Parameter], **truth: float) -> None:
    for name, value in truth.items():
        low, high = wide(found[name])
        assert low < value < high, name


def test_bernoulli_comes_back() -> None:
    fit = fit_losses(draw.bernoulli(3000, 0.1, 1))
    assert fit.chosen == "bernoulli"
    holds(kind(fit, "bernoulli"), loss=0.1)
    p_value = fit.models[0].goodness.p_value
    assert p_value is not None
    assert p_value > LEVEL


def test_markov_comes_back() -> None:
    fit = fit_losses(draw.markov(3000, Chain.markov(0.3, 0.05), 1))
    assert fit.chosen == "markov"
    holds(kind(fit, "markov"), recovery=0.3, failure=0.05, loss=0.05 / 0.35)
    independent, bursty, *_ = fit.models
    assert independent.goodness.p_value is not None
    assert bursty.goodness.p_value is not None
    assert independent.goodness.p_value < LEVEL < bursty.goodness.p_value


def test_gilbert_elliott_comes_back() -> None:
    fates = draw.gilbert_elliott(10_000, TRUTH, 1)
    fit = fit_losses(fates)
    assert fit.chosen == "gilbert-elliott"
    found = kind(fit, "gilbert-elliott")
    holds(found, to_bad=0.02, to_good=0.2, loss_good=0.01, loss_bad=0.6, loss=1.0 - TRUTH.arrival)
    model = fit.models[2]
    assert model.log_likelihood >= Fates(fates).log_likelihood(TRUTH)
    assert model.goodness.p_value is not None
    assert model.goodness.p_value > LEVEL
    assert model.bic == pytest.approx(4 * np.log(10_000) - 2 * model.log_likelihood)
    assert model.aic == pytest.approx(8 - 2 * model.log_likelihood)
    assert all(ratio.p_value is None or ratio.p_value < LEVEL for ratio in fit.ratios)


def test_the_information_is_the_curvature_of_the_likelihood() -> None:
    """Along the profile of one logit the likelihood falls by z²/2 where the interval ends, for many packets."""
    fates = draw.gilbert_elliott(10_000, TRUTH, 3)
    found, seen = fit_gilbert_elliott(fates), Fates(fates)
    np.testing.assert_allclose(score(found.losses, seen.expected(found.losses)), 0.0, atol=0.01)
    assert found.intervals[3] is not None
    values = parameters(found.losses)
    held, rest = found.intervals[3].high, np.delete(values, 3)

    def profile(x: np.ndarray) -> float:
        if not np.all((x > 0.0) & (x < 1.0)):
            return np.inf
        return -seen.log_likelihood(GilbertElliott.of(*x.tolist(), held))

    fallen = minimize(profile, rest, method="Nelder-Mead", options={"xatol": 1e-5, "fatol": 1e-3}).fun
    assert fallen + found.log_likelihood == pytest.approx(stats.norm.ppf(0.975) ** 2 / 2, rel=0.1)


@pytest.mark.parametrize("seed", range(3))
def test_larger_models_are_never_less_likely(seed: int) -> None:
    for fates in (draw.bernoulli(80, 0.3, seed), draw.markov(80, Chain.markov(0.7, 0.6), seed)):
        found = fit_gilbert_elliott(fates)
        markov = chain_log_likelihood(fates, fit_markov(fates))
        assert found.losses.loss_good <= found.losses.loss_bad
        assert found.log_likelihood >= markov - 1e-9
        assert markov >= chain_log_likelihood(fates, fit_bernoulli(fates)) - 1e-9


@pytest.mark.parametrize("seed", range(2))
def test_no_channel_of_a_grid_is_likelier(seed: int) -> None:
    fates = draw.gilbert_elliott(120, GilbertElliott.of(0.1, 0.2, 0.05, 0.8), seed)
    found, seen = fit_gilbert_elliott(fates), Fates(fates)
    rates, losses = (0.02, 0.1, 0.3, 0.7, 0.98), (0.0, 0.05, 0.3, 0.8, 1.0)
    grid = [GilbertElliott.of(p, r, low, high) for p in rates for r in rates for low in losses for high in losses]
    reached = max(seen.log_likelihood(at) for at in grid if at.loss_good < at.loss_bad)
    assert found.log_likelihood >= reached


def test_a_parameter_at_the_boundary_has_no_interval() -> None:
    fates = draw.gilbert_elliott(3000, GilbertElliott.of(0.03, 0.3), 1)
    found = kind(fit_losses(fates), "gilbert-elliott")
    assert (found["loss_good"].value, found["loss_good"].interval) == (0.0, None)
    assert found["loss_good"].note.startswith("at the boundary")
    assert found["to_good"].interval is not None
    to_bad, to_good, _, loss_bad = (found[name].value for name in ("to_bad", "to_good", "loss_good", "loss_bad"))
    reached = [Fates(fates).log_likelihood(GilbertElliott.of(to_bad, to_good, g, loss_bad)) for g in (0.0, 1e-4, 1e-3)]
    assert reached[0] > reached[1] > reached[2]


def test_the_states_of_independent_losses_can_seldom_be_told() -> None:
    notes = []
    for seed in range(10):
        found = fit_gilbert_elliott(draw.bernoulli(150, 0.3, seed))
        notes.append(found.obstacle.partition(":")[0])
        assert not found.obstacle or {*found.intervals, found.loss_interval} == {None}
    assert notes.count("not identifiable") >= stats.binom.ppf(LEVEL, 10, 0.95)


def test_alternating_fates_are_at_every_boundary() -> None:
    fit = fit_losses(np.tile([True, False], 20))
    assert fit.chosen == "markov"
    found = kind(fit, "gilbert-elliott")
    assert [found[name].value for name in ("to_bad", "to_good", "loss_good", "loss_bad")] == [1.0, 1.0, 0.0, 1.0]
    assert {p.interval for p in found.values()} == {None}


def uniform(p_values: list[float]) -> bool:
    return bool(stats.kstest(p_values, "uniform").pvalue > LEVEL)


def test_p_values_of_runs_are_uniform_under_the_model() -> None:
    of_bernoulli, of_markov = [], []
    for seed in range(120):
        fates = draw.bernoulli(1500, 0.25, seed)
        of_bernoulli.append(goodness(fates, fit_bernoulli(fates), 1).p_value)
        fates = draw.markov(1500, Chain.markov(0.3, 0.1), seed)
        of_markov.append(goodness(fates, fit_markov(fates), 2).p_value)
    assert uniform([p for p in of_bernoulli if p is not None])
    assert uniform([p for p in of_markov if p is not None])
    assert None not in of_bernoulli + of_markov


def test_p_values_of_the_ratio_are_uniform_for_independent_losses() -> None:
    p_values = []
    for seed in range(200):
        fates = draw.bernoulli(500, 0.3, seed)
        larger = chain_log_likelihood(fates, fit_markov(fates))
        smaller = chain_log_likelihood(fates, fit_bernoulli(fates))
        p_values.append(float(stats.chi2.sf(2.0 * (larger - smaller), 1)))
    assert uniform(p_values)


def test_cells_hold_all_runs() -> None:
    fates = draw.markov(2000, Chain.markov(0.3, 0.1), 5)
    text = "".join("1" if fate else "0" for fate in fates)
    inner = text.strip(text[0]).rstrip(text[-1])
    bursts = sorted(len(run) for run in inner.split("1") if run)
    assert sorted(runs(fates, False).tolist()) == bursts
    chain = fit_markov(fates)
    cells = goodness(fates, chain, 2).bursts
    low = 0
    for upto, observed, expected in zip(cells.upto, cells.observed, cells.expected, strict=True):
        assert observed == sum(low < length and (upto is None or length <= upto) for length in bursts)
        end = 0.0 if upto is None else (1.0 - chain.recovery) ** upto
        assert expected == pytest.approx(len(bursts) * ((1.0 - chain.recovery) ** low - end), rel=1e-9)
        assert expected >= 5.0 * (1 - 1e-9)
        low = upto or 0
    assert (cells.runs, sum(cells.observed)) == (len(bursts), len(bursts))
    assert cells.upto[-1] is None
    assert cells.chi2 == pytest.approx(stats.chisquare(cells.observed, cells.expected).statistic)


def test_too_few_runs_have_no_p_value() -> None:
    fates = np.ones(60, dtype=bool)
    fates[[10, 30]] = False
    assert [model.goodness.p_value for model in fit_losses(fates).models] == [None] * 4


def test_the_line_is_one_of_a_scenario() -> None:
    system = "[system]\nA = [[1.0]]\nC = [[1.0]]\nQ = [[1.0]]\nR = [[1.0]]\n[links.observation]\n"
    fit = fit_losses(draw.gilbert_elliott(400, GilbertElliott.of(0.1, 0.3, 0.05, 0.9), 1))
    for model in fit.models:
        loss = parse_scenario(system + model.toml, source="fit").links.observation.loss.model_dump()
        assert loss["kind"] == model.kind
        for parameter in model.parameters:
            name, value = parameter.name, parameter.value
            given = 1.0 - loss["arrival"] if (model.kind, name) == ("bernoulli", "loss") else loss[name]
            assert given == pytest.approx(value, rel=1e-5)


@pytest.mark.parametrize(
    ("fates", "text"),
    [
        (np.ones(0, dtype=bool), "got 0 packets; allowed: 20 or more"),
        (np.array([True]), "got 1 packet; allowed: 20 or more"),
        (np.ones(2000, dtype=bool), "none of 2000 packets lost.*the loss rate is at most 0.0015 with 95 %"),
        (np.zeros(300, dtype=bool), "all of 300 packets lost.*the arrival rate is at most 0.01 with 95 %"),
    ],
)
def test_what_cannot_be_fitted_is_refused(fates: np.ndarray, text: str) -> None:
    with pytest.raises(UsageError, match=text):
        fit_losses(fates)
