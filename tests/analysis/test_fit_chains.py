"""Bernoulli and Markov fits against a search over their likelihoods; how often the intervals hold the truth."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy import stats
from scipy.optimize import minimize, minimize_scalar
from scipy.special import expit

from analysis import fates as draw
from testbed.analysis.fit_chains import (
    chain_log_likelihood,
    closed_form,
    fit_bernoulli,
    fit_markov,
    stationary_rates,
    transitions,
)
from testbed.analysis.fit_intervals import Interval, chain_loss, wilson
from testbed.channel.gilbert_elliott import GilbertElliott
from testbed.channel.loss import Chain

TRACES = 100
HELD_MIN = int(stats.binom.ppf(1e-3, TRACES, 0.95))  # 95 % of the intervals, less what chance explains
rates = st.floats(0.05, 0.95)
check = settings(deadline=None, max_examples=40, derandomize=True)


@check
@given(st.lists(st.booleans(), min_size=1, max_size=10), rates, rates)
def test_likelihood_is_that_of_the_definition(fates: list[bool], recovery: float, failure: float) -> None:
    chain = Chain.markov(recovery, failure)
    direct = draw.probability(tuple(fates), GilbertElliott(chain, 0.0, 1.0))
    assert chain_log_likelihood(np.array(fates), chain) == pytest.approx(math.log(direct), abs=1e-11)


@pytest.mark.parametrize("seed", range(4))
def test_bernoulli_is_where_the_likelihood_is_largest(seed: int) -> None:
    fates = draw.bernoulli(200, 0.2, seed)
    best = minimize_scalar(
        lambda loss: -chain_log_likelihood(fates, Chain.bernoulli(1.0 - loss)),
        bounds=(1e-6, 1 - 1e-6),
        options={"xatol": 1e-10},
    )
    assert 1.0 - fit_bernoulli(fates).arrival == pytest.approx(best.x, abs=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_markov_is_where_the_likelihood_is_largest(seed: int) -> None:
    fates = draw.markov(150, Chain.markov(0.4, 0.1), seed)
    best = minimize(
        lambda x: -chain_log_likelihood(fates, Chain.markov(*expit(x).tolist())),
        [0.0, 0.0],
        method="Nelder-Mead",
        options={"xatol": 1e-9, "fatol": 1e-12, "maxiter": 2000},
    )
    found = fit_markov(fates)
    assert [found.recovery, found.failure] == pytest.approx(expit(best.x).tolist(), abs=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_closed_form_is_where_the_likelihood_given_the_first_fate_is_largest(seed: int) -> None:
    fates = draw.markov(150, Chain.markov(0.4, 0.1), seed)

    def missed(x: np.ndarray) -> float:
        recovery, failure = expit(x).tolist()
        chain = Chain(recovery, failure, 0.5)
        return math.log(0.5) - chain_log_likelihood(fates, chain)

    best = minimize(missed, [0.0, 0.0], method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-12, "maxiter": 2000})
    failure, recovery = closed_form(transitions(fates).astype(float))
    assert [recovery, failure] == pytest.approx(expit(best.x).tolist(), abs=1e-6)
    found = fit_markov(fates)
    assert [found.recovery, found.failure] == pytest.approx([recovery, failure], abs=3.0 / fates.sum() + 0.02)


@check
@given(rates, rates, rates, rates, st.integers(0, 100))
def test_each_step_climbs(recovery: float, failure: float, at_r: float, at_p: float, seed: int) -> None:
    fates = draw.markov(30, Chain.markov(recovery, failure), seed)
    assume(0 < fates.sum() < 30)
    first = np.array([not fates[0], fates[0]], dtype=float)
    to_bad, to_good = stationary_rates(transitions(fates).astype(float), first, at_r + at_p)
    before = chain_log_likelihood(fates, Chain.markov(at_r, at_p))
    assert chain_log_likelihood(fates, Chain.markov(to_good, to_bad)) >= before - 1e-10


@pytest.mark.parametrize(
    "fates", [[0, 1] * 10, [0] * 10 + [1] * 10, [1] * 19 + [0], [0] + [1] * 19, [1] * 9 + [0] + [1] * 10]
)
def test_traces_with_few_moves(fates: list[int]) -> None:
    found = fit_markov(np.array(fates, dtype=bool))
    assert 0.0 < found.recovery <= 1.0
    assert 0.0 < found.failure <= 1.0
    reached = chain_log_likelihood(np.array(fates, dtype=bool), found)
    for recovery in np.linspace(0.01, 1.0, 34):
        for failure in np.linspace(0.01, 1.0, 34):
            other = chain_log_likelihood(np.array(fates, dtype=bool), Chain.markov(float(recovery), float(failure)))
            assert reached >= other - 1e-9


@pytest.mark.parametrize(("count", "number"), [(0, 30), (3, 50), (30, 30), (17, 40)])
def test_wilson_holds_what_the_score_test_does_not_reject(count: int, number: int) -> None:
    def distance(rate: float) -> float:
        return abs(count / number - rate) / math.sqrt(rate * (1.0 - rate) / number)

    for end in wilson(count, number):
        if 0.0 < end < 1.0:
            assert distance(end) == pytest.approx(stats.norm.ppf(0.975), abs=1e-9)
    assert wilson(0, 30).low == 0.0
    assert wilson(30, 30).high == 1.0
    assert wilson(0, 0) == Interval(0.0, 1.0)


def test_the_loss_of_a_chain_is_less_certain_by_its_correlation() -> None:
    chain = Chain.markov(0.25, 0.02)
    narrow, wide = wilson(74_074, 1_000_000), chain_loss(74_074, 1_000_000, chain)
    widened = (wide.high - wide.low) / (narrow.high - narrow.low)
    assert widened == pytest.approx(math.sqrt((2 - 0.27) / 0.27), rel=1e-3)


def held(truth: float, interval: Callable[[int], Interval]) -> int:
    return sum(low <= truth <= high for low, high in map(interval, range(TRACES)))


def test_intervals_of_bernoulli_hold_the_truth() -> None:
    def interval(seed: int) -> Interval:
        fates = draw.bernoulli(300, 0.1, seed)
        return wilson(300 - int(fates.sum()), 300)

    assert held(0.1, interval) >= HELD_MIN


def test_intervals_of_markov_hold_the_truth() -> None:
    chain = Chain.markov(0.3, 0.06)

    def of_loss(seed: int) -> Interval:
        fates = draw.markov(600, chain, seed)
        return chain_loss(600 - int(fates.sum()), 600, fit_markov(fates))

    def of_rate(fate: int) -> Callable[[int], Interval]:
        def interval(seed: int) -> Interval:
            counts = transitions(draw.markov(600, chain, seed))[fate]
            return wilson(int(counts[1 - fate]), int(counts.sum()))

        return interval

    assert held(0.06 / 0.36, of_loss) >= HELD_MIN
    assert held(0.3, of_rate(0)) >= HELD_MIN
    assert held(0.06, of_rate(1)) >= HELD_MIN

    def too_narrow(seed: int) -> Interval:
        return wilson(600 - int(draw.markov(600, chain, seed).sum()), 600)

    assert held(0.06 / 0.36, too_narrow) < HELD_MIN
