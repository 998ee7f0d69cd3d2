"""Forwards and backwards against sums over all hidden paths; EM and the score against the likelihood itself."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import expit, logit

from analysis import fates as draw
from testbed.analysis.fit_gilbert_elliott import em, parameters, score
from testbed.analysis.fit_states import Fates
from testbed.channel.gilbert_elliott import GilbertElliott

check = settings(deadline=None, max_examples=50, derandomize=True)
rates = st.floats(0.01, 0.99)
channels = st.builds(GilbertElliott.of, rates, rates, rates, rates)
CORNERS = [
    GilbertElliott.of(0.2, 0.3, 0.0, 1.0),
    GilbertElliott.of(0.9, 1.0, 0.0, 0.5),
    GilbertElliott.of(1, 1, 0.3, 1),
]


@check
@given(channels | st.sampled_from(CORNERS[:1]), st.lists(st.booleans(), min_size=1, max_size=8))
def test_likelihood_and_counts_are_sums_over_paths(losses: GilbertElliott, fates: list[bool]) -> None:
    weights = draw.paths(tuple(fates), losses)
    total = sum(weight for _, weight in weights)
    moves, first = np.zeros((2, 2, 2)), np.zeros(2)
    for path, weight in weights:
        first[path[0]] += weight / total
        for k, fate in enumerate(fates):
            moves[int(fate), path[k], path[k + 1]] += weight / total
    seen = Fates(np.array(fates))
    expected = seen.expected(losses)
    assert expected.log_likelihood == pytest.approx(math.log(total), abs=1e-11)
    assert seen.log_likelihood(losses) == expected.log_likelihood
    np.testing.assert_allclose(expected.moves, moves, atol=1e-11)
    np.testing.assert_allclose(expected.first, first, atol=1e-11)


@pytest.mark.parametrize("losses", CORNERS)
def test_probabilities_of_all_fates_sum_to_one(losses: GilbertElliott) -> None:
    all_fates = [np.array([bool(number >> bit & 1) for bit in range(9)]) for number in range(512)]
    possible = [fates for fates in all_fates if draw.probability(tuple(fates), losses) > 0.0]
    assert sum(math.exp(Fates(fates).log_likelihood(losses)) for fates in possible) == pytest.approx(1.0, abs=1e-12)


def test_a_long_trace_does_not_underflow() -> None:
    losses = GilbertElliott.of(0.02, 0.2, 0.01, 0.6)
    fates = draw.gilbert_elliott(20_000, losses, 1)
    state = np.array([1.0 - losses.states.arrival, losses.states.arrival])
    total = 0.0
    for fate in fates.tolist():
        loss = np.array([0.6, 0.01])
        met = state * (1.0 - loss if fate else loss)
        total += math.log(met.sum())
        state = met / met.sum() @ np.array([[0.8, 0.2], [0.02, 0.98]])
    assert Fates(fates).log_likelihood(losses) == pytest.approx(total, rel=1e-12)


@check
@given(channels, channels, st.integers(0, 1000), st.integers(2, 60))
def test_em_never_falls(truth: GilbertElliott, start: GilbertElliott, seed: int, number: int) -> None:
    reached = [likelihood for _, likelihood in em(Fates(draw.gilbert_elliott(number, truth, seed)), start, 25)]
    assert all(after >= before - 1e-9 for before, after in pairwise(reached))
    assert len(reached) == 26


@check
@given(channels, st.integers(0, 1000))
def test_score_is_the_slope_of_the_likelihood(losses: GilbertElliott, seed: int) -> None:
    fates = draw.gilbert_elliott(40, losses, seed)
    seen, logits = Fates(fates), logit(parameters(losses))
    slopes = []
    for index in range(4):
        ends = []
        for step in (1e-5, -1e-5):
            moved = logits.copy()
            moved[index] += step
            ends.append(seen.log_likelihood(GilbertElliott.of(*expit(moved).tolist())))
        slopes.append((ends[0] - ends[1]) / 2e-5)
    np.testing.assert_allclose(score(losses, seen.expected(losses)), slopes, atol=2e-5, rtol=1e-5)
