"""The fit of the four-state model against sums over all paths of its states, and on traces that were drawn."""

from __future__ import annotations

import math
from itertools import pairwise, product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from scipy.optimize import minimize
from scipy.special import expit, logit

from analysis import fates as draw
from testbed.analysis.fit import fit_losses
from testbed.analysis.fit_chains import chain_log_likelihood, fit_markov
from testbed.analysis.fit_four_state import NAMES, Fates, em, fit_four_state, parameters, score
from testbed.channel.four_state import four_state
from testbed.channel.hidden import HiddenChain
from testbed.channel.loss import Chain
from testbed.scenario import FourStateLoss, parse_scenario

check = settings(deadline=None, max_examples=40, derandomize=True)
rates = st.floats(0.02, 0.98)
TRUTH = {"to_burst": 0.04, "to_good": 0.3, "to_pause": 0.3, "from_pause": 0.3, "to_isolated": 0.03}
LOSSES = four_state(**TRUTH)
BARE = [four_state(0.2, 0.5), four_state(0.2, 0.3, 0.3, 0.5), four_state(0.2, 0.5, to_isolated=0.3)]


def model(leave: float, isolated: float, ends: float, pause: float, resumes: float) -> HiddenChain:
    return four_state(leave * (1.0 - isolated), ends * (1.0 - pause), ends * pause, resumes, leave * isolated)


models = st.builds(model, rates, rates, rates, rates, rates)


def paths(fates: list[bool], losses: HiddenChain) -> dict[tuple[int, ...], float]:
    """Each path of the states that has these fates, with its probability."""
    out = {}
    for path in product(range(4), repeat=len(fates)):
        if [state < 2 for state in path] == fates:
            moves = math.prod(losses.moves[before][after] for before, after in pairwise(path))
            out[path] = losses.first[path[0]] * moves
    return out


@check
@given(models | st.sampled_from(BARE), st.lists(st.booleans(), min_size=2, max_size=6))
def test_likelihood_and_counts_are_sums_over_paths(losses: HiddenChain, fates: list[bool]) -> None:
    weights = paths(fates, losses)
    total = sum(weights.values())
    moves, first = np.zeros((4, 4)), np.zeros(4)
    for path, weight in weights.items():
        first[path[0]] += weight / total
        for before, after in pairwise(path):
            moves[before, after] += weight / total
    seen = Fates(np.array(fates))
    expected = seen.expected(losses)
    assert expected.log_likelihood == pytest.approx(math.log(total), abs=1e-11)
    assert seen.log_likelihood(losses) == expected.log_likelihood
    np.testing.assert_allclose(expected.moves[0], moves, atol=1e-11)
    np.testing.assert_allclose(expected.first, first, atol=1e-11)


@check
@given(models)
def test_probabilities_of_all_fates_sum_to_one(losses: HiddenChain) -> None:
    words = product((False, True), repeat=7)
    total = sum(math.exp(Fates(np.array(word)).log_likelihood(losses)) for word in words)
    assert total == pytest.approx(1.0, abs=1e-12)


@check
@given(models, models, st.integers(0, 99), st.integers(2, 60))
def test_em_never_falls(truth: HiddenChain, start: HiddenChain, seed: int, number: int) -> None:
    seen = Fates(draw.hidden(number, truth, seed))
    steps = list(em(seen, start, 6))
    reached = [log_likelihood for _, log_likelihood in steps]
    assert reached == sorted(reached)
    assert reached == [seen.log_likelihood(losses) for losses, _ in steps]


def test_em_climbs() -> None:
    """From a wrong model, most of the way up to the truth in eight steps."""
    seen = Fates(draw.hidden(3000, LOSSES, 1))
    reached = [log_likelihood for _, log_likelihood in em(seen, model(0.2, 0.5, 0.5, 0.5, 0.6), 8)]
    assert reached[-1] - reached[0] > 0.95 * (seen.log_likelihood(LOSSES) - reached[0])


@check
@given(st.lists(rates, min_size=5, max_size=5), st.integers(0, 99))
def test_score_is_the_slope_of_the_likelihood(values: list[float], seed: int) -> None:
    losses = model(*values)
    seen = Fates(draw.hidden(30, losses, seed))
    slopes = score(losses, seen.expected(losses))
    for index, slope in enumerate(slopes):
        ends = []
        for step in (1e-5, -1e-5):
            moved = np.array(values)
            moved[index] = expit(logit(moved[index]) + step)
            ends.append(seen.log_likelihood(model(*moved.tolist())))
        assert slope == pytest.approx((ends[0] - ends[1]) / 2e-5, abs=1e-4)


def test_known_parameters_come_back() -> None:
    fates = draw.hidden(10_000, LOSSES, 2)
    fit = fit_losses(fates)
    assert fit.chosen == "four-state"
    found = fit.models[3]
    assert found.log_likelihood >= Fates(fates).log_likelihood(LOSSES)
    assert found.goodness.p_value is not None
    assert found.goodness.p_value > 1e-3
    assert fit.models[2].goodness.p_value is not None
    assert fit.models[2].goodness.p_value < 0.01
    for parameter, truth in [(p, TRUTH[p.name]) for p in found.parameters] + [(found.loss, 1.0 - LOSSES.arrival)]:
        assert parameter.interval is not None
        half = parameter.interval.high - parameter.interval.low
        assert abs(parameter.value - truth) < half  # an interval of twice the width
    assert found.bic == pytest.approx(5 * np.log(10_000) - 2 * found.log_likelihood)


@pytest.mark.slow
def test_intervals_hold_as_often_as_they_say() -> None:
    held = np.zeros((40, 6))
    for seed in range(40):
        found = fit_four_state(draw.hidden(4000, LOSSES, seed))
        truths = [*TRUTH.values(), 1.0 - LOSSES.arrival]
        assert list(TRUTH) == list(NAMES)
        for i, (interval, truth) in enumerate(zip([*found.intervals, found.loss_interval], truths, strict=True)):
            assert interval is not None
            held[seed, i] = interval.low <= truth <= interval.high
    for column in held.T:
        assert stats.binomtest(int(column.sum()), 40, 0.95).pvalue > 1e-3


def test_the_information_is_the_curvature_of_the_likelihood() -> None:
    """Along the profile of one logit the likelihood falls by z²/2 where the interval ends, for many packets."""
    fates = draw.hidden(10_000, LOSSES, 3)
    found, seen = fit_four_state(fates), Fates(fates)
    np.testing.assert_allclose(score(found.losses, seen.expected(found.losses)), 0.0, atol=0.02)
    assert found.intervals[3] is not None
    values = parameters(found.losses)
    held, rest = found.intervals[3].high, np.delete(values, 3)

    def profile(x: np.ndarray) -> float:
        to_burst, to_good, to_pause, to_isolated = x.tolist()
        if min(x) <= 0.0 or to_burst + to_isolated >= 1.0 or to_good + to_pause >= 1.0:
            return np.inf
        return -seen.log_likelihood(four_state(to_burst, to_good, to_pause, held, to_isolated))

    fallen = minimize(profile, rest, method="Nelder-Mead", options={"xatol": 1e-4, "fatol": 1e-2}).fun
    assert fallen + found.log_likelihood == pytest.approx(stats.norm.ppf(0.975) ** 2 / 2, rel=0.15)


@pytest.mark.parametrize("seed", range(3))
def test_it_is_never_less_likely_than_the_chain_within_it(seed: int) -> None:
    for fates in (draw.bernoulli(80, 0.3, seed), draw.markov(80, Chain.markov(0.7, 0.6), seed)):
        assert fit_four_state(fates).log_likelihood >= chain_log_likelihood(fates, fit_markov(fates)) - 1e-9


@pytest.mark.parametrize("seed", range(2))
def test_no_model_of_a_grid_is_likelier(seed: int) -> None:
    fates = draw.hidden(150, LOSSES, seed)
    seen, shares = Fates(fates), (0.02, 0.1, 0.4, 0.8)
    reached = max(seen.log_likelihood(model(*values)) for values in product(shares, repeat=5))
    assert fit_four_state(fates).log_likelihood >= reached


def test_a_chain_of_arrivals_tells_nothing_of_pauses() -> None:
    notes = [fit_four_state(draw.markov(400, Chain.markov(0.4, 0.1), seed)).obstacle for seed in range(8)]
    assert sum(note.startswith("not identifiable: hardly likelier than a Markov chain") for note in notes) >= 6


def test_without_isolated_losses_pauses_are_what_ends_sooner() -> None:
    """The good state and the pauses may change names there: both are the same process."""
    named, renamed = four_state(0.03, 0.3, 0.2, 0.4), four_state(0.4, 0.2, 0.3, 0.03)
    fates = draw.hidden(4000, named, 1)
    assert Fates(fates).log_likelihood(named) == pytest.approx(Fates(fates).log_likelihood(renamed), abs=1e-9)
    found = fit_four_state(fates)
    to_burst, _, _, from_pause, to_isolated = parameters(found.losses)
    assert to_isolated < 0.01
    assert to_burst < from_pause


def test_a_parameter_at_the_boundary_has_no_interval() -> None:
    """Bursts without pause, so that from_pause means nothing and is left at its default."""
    fates = draw.hidden(3000, four_state(0.02, 0.2, to_isolated=0.06), 0)
    found = fit_four_state(fates)
    to_pause, from_pause = parameters(found.losses)[2:4]
    assert (to_pause, from_pause) == (0.0, 1.0)
    assert [interval is None for interval in found.intervals] == [False, False, True, True, False]
    reached = [
        Fates(fates).log_likelihood(four_state(p[0], p[1], pause, 0.3, p[4]))
        for p in [parameters(found.losses)]
        for pause in (0.0, 1e-3, 1e-2)
    ]
    assert reached[0] > reached[1] > reached[2]


def test_the_line_is_one_of_a_scenario_where_every_burst_is_one_loss() -> None:
    """Then to_good and to_pause add up to 1, rounded or not."""
    system = "[system]\nA = [[1.0]]\nC = [[1.0]]\nQ = [[1.0]]\nR = [[1.0]]\n[links.observation]\n"
    for seed in range(4):
        fit = fit_losses(draw.hidden(300, four_state(0.05, 1.0 / 3.0, 2.0 / 3.0, 0.6), seed))
        loss = parse_scenario(system + fit.models[3].toml, source="fit").links.observation.loss
        assert isinstance(loss, FourStateLoss)
        for parameter in fit.models[3].parameters:
            assert getattr(loss, parameter.name) == pytest.approx(parameter.value, rel=1e-5, abs=1e-9)
