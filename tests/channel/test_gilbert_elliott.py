"""The Gilbert–Elliott channel against sums over all paths of its hidden state, and its draws against those."""

from __future__ import annotations

from collections import Counter
from itertools import product

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import stats

from testbed.analysis.bursts import PhaseType, run_law
from testbed.channel.gilbert_elliott import GilbertElliott, GilbertElliottProcess
from testbed.channel.law import law_of, stationary_of
from testbed.channel.loss import Chain, LossProcess
from testbed.channel.service import loss_process
from testbed.errors import UsageError
from testbed.numerics.streams import Stream
from testbed.scenario import Scenario, parse_scenario

LEVEL = 1e-3
CHANNELS = {
    "noisy": GilbertElliott.of(0.1, 0.3, 0.05, 0.7),
    "only bad loses": GilbertElliott.of(0.05, 0.4, 0.0, 0.5),
    "bad loses all": GilbertElliott.of(0.2, 0.3, 0.1, 1.0),
    "alternating": GilbertElliott.of(0.9, 0.8, 0.2, 0.6),
}
check = settings(deadline=None, max_examples=60, derandomize=True)
rates = st.floats(0.02, 0.98)


@st.composite
def channels(draw: st.DrawFn, stationary: bool = False) -> GilbertElliott:
    to_bad, to_good = draw(rates), draw(rates)
    low, high = sorted((draw(st.sampled_from([0.0, 0.1, 0.4])), draw(st.sampled_from([0.3, 0.5, 0.9, 1.0]))))
    assume(low < high)
    return GilbertElliott.of(to_bad, to_good, low, high, None if stationary else draw(st.floats(0, 1)))


def probability(losses: GilbertElliott, fates: tuple[int, ...]) -> float:
    """P(fates of the first packets): the sum over all paths of the states, 1 = good."""
    states = losses.states
    paths = np.array(list(product((0, 1), repeat=len(fates)))).T
    lost = np.where(paths == 1, losses.loss_good, losses.loss_bad)
    good = np.where(paths == 1, 1.0 - states.failure, states.recovery)
    chances = [np.where(paths[0] == 1, states.start, 1.0 - states.start)]
    chances += [
        np.where(after == 1, to_good, 1.0 - to_good) for to_good, after in zip(good[:-1], paths[1:], strict=True)
    ]
    chances += [1.0 - loss if fate else loss for loss, fate in zip(lost, fates, strict=True)]
    return float(np.prod(chances, axis=0).sum())


@check
@given(channels(), st.lists(st.integers(0, 1), min_size=1, max_size=5))
def test_the_law_gives_the_probabilities_of_all_fates(losses: GilbertElliott, fates: list[int]) -> None:
    law = law_of(losses)
    weights = law.initial * (law.arrived == fates[0])
    for fate in fates[1:]:
        weights = (weights @ law.transition) * (law.arrived == fate)
    assert weights.sum() == pytest.approx(probability(losses, tuple(fates)), abs=1e-14)
    np.testing.assert_allclose(law.transition.sum(axis=1), 1.0, rtol=1e-14)
    np.testing.assert_allclose(stationary_of(losses) @ law.transition, stationary_of(losses), atol=1e-14)


@check
@given(channels(stationary=True), st.integers(1, 4))
def test_stationary_figures(losses: GilbertElliott, lag: int) -> None:
    words = {word: probability(losses, word) for word in product((0, 1), repeat=lag + 1)}
    arrival = sum(p for word, p in words.items() if word[0])
    both = sum(p for word, p in words.items() if word[0] and word[-1])
    assert losses.first_arrival == pytest.approx(arrival, rel=1e-12)
    assert losses.arrival == pytest.approx(arrival, rel=1e-12)
    correlation = (both - arrival**2) / (arrival * (1.0 - arrival))
    assert losses.coupling * losses.memory**lag == pytest.approx(correlation, abs=1e-12)


@check
@given(channels(stationary=True), st.booleans(), st.integers(1, 6))
def test_runs_have_the_law_of_the_phases(losses: GilbertElliott, fate: bool, length: int) -> None:
    """P(run = l) = P(other, fate l times, other) / P(other, fate)."""
    law = run_law(losses, fate)
    assert law is not None
    one, other = int(fate), int(not fate)
    runs = probability(losses, (other, *[one] * length, other)) / probability(losses, (other, one))
    assert law.probability(np.array([float(length)]))[0] == pytest.approx(runs, rel=1e-10)
    beyond, before = law.tail(length), law.tail(length - 1)
    if before - beyond > 1e-6:
        assert law.quantile(1.0 - 0.5 * (before + beyond)) == length
    if not fate:
        assert losses.mean_burst == pytest.approx(law.mean, rel=1e-12)


@pytest.mark.parametrize("losses", CHANNELS.values(), ids=CHANNELS)
@pytest.mark.parametrize("fate", [False, True])
def test_moments_of_the_runs_are_those_of_their_law(losses: GilbertElliott, fate: bool) -> None:
    law = run_law(losses, fate)
    assert law is not None
    lengths = np.arange(1.0, 1500.0)
    p = law.probability(lengths)
    assert law.mean == pytest.approx(p @ lengths, rel=1e-9)
    assert law.variance == pytest.approx(p @ lengths**2 - (p @ lengths) ** 2, rel=1e-9)


def test_successive_runs_are_correlated() -> None:
    """Of runs that begin in one of two states for good, the mean has the variance of the two means."""
    start, stay = np.array([0.5, 0.5]), np.diag([0.5, 0.9])
    again = np.array([[0.99, 0.01], [0.01, 0.99]])
    law = PhaseType(start, stay, again)
    means, memory = np.array([2.0, 10.0]), 0.98
    within = 0.5 * (0.5 / 0.25) + 0.5 * (0.9 / 0.01)
    between = 16.0 * (1.0 + memory) / (1.0 - memory)
    assert law.mean == pytest.approx(means.mean())
    assert law.variance_of_mean == pytest.approx(within + between, rel=1e-9)


@check
@given(channels(stationary=True))
def test_long_bursts_get_rarer_by_theta(losses: GilbertElliott) -> None:
    law = law_of(losses)
    lost = law.states_of(False)
    block = law.transition[np.ix_(lost, lost)]
    assert losses.burst_decay == pytest.approx(np.abs(np.linalg.eigvals(block)).max(), rel=1e-9)


@check
@given(channels(stationary=True))
def test_no_past_makes_a_loss_more_likely_than_worst_loss(losses: GilbertElliott) -> None:
    for length in range(7):
        for past in product((0, 1), repeat=length):
            before = probability(losses, past) if past else 1.0
            if before > 1e-12:
                assert probability(losses, (*past, 0)) / before <= losses.worst_loss + 1e-10


def test_worst_loss_is_reached_by_a_long_burst() -> None:
    losses = CHANNELS["noisy"]
    last = probability(losses, (0,) * 13) / probability(losses, (0,) * 12)
    assert last == pytest.approx(losses.worst_loss, rel=1e-6)


@pytest.mark.parametrize(
    ("losses", "chain"),
    [
        (GilbertElliott.of(0.2, 0.5), Chain.markov(0.5, 0.2)),
        (GilbertElliott.of(0.2, 0.5, start_good=0.1), Chain.markov(0.5, 0.2, 0.1)),
        (GilbertElliott.of(0.2, 0.5, 1.0, 0.0), Chain.markov(0.2, 0.5)),
        (GilbertElliott.of(0.2, 0.5, 0.25, 0.25, 0.9), Chain.bernoulli(0.75)),
        (GilbertElliott.of(0.0, 0.5, 0.25, 0.5), Chain.bernoulli(0.75)),
        (GilbertElliott.of(0.5, 0.0, 0.25, 0.5, 0.0), Chain.bernoulli(0.5)),
        (GilbertElliott.of(0.25, 0.75, 0.0, 0.5), Chain.bernoulli(0.875)),
        (GilbertElliott.of(0.25, 0.75, 0.0, 0.0), Chain.bernoulli(1.0)),
    ],
)
def test_what_is_a_chain_of_arrivals_is_taken_for_one(losses: GilbertElliott, chain: Chain) -> None:
    assert losses.as_chain is not None
    for figure in ("never_loses", "independent", "first_arrival", "burst_decay", "recovery", "failure", "start"):
        assert getattr(losses, figure) == pytest.approx(getattr(chain, figure), rel=1e-14)
    for fates in product((0, 1), repeat=3):
        steps = [chain.first_arrival, *(1.0 - chain.failure if last else chain.recovery for last in fates[:-1])]
        expected = np.prod([p if fate else 1.0 - p for p, fate in zip(steps, fates, strict=True)])
        assert probability(losses, fates) == pytest.approx(expected, abs=1e-15)


def test_what_holds_for_chains_alone_says_so() -> None:
    for name in ("recovery", "failure", "start"):
        with pytest.raises(UsageError, match="losses with a hidden state have no recovery and failure rate"):
            getattr(CHANNELS["noisy"], name)


def test_a_burst_that_never_begins_has_no_law() -> None:
    healed = GilbertElliott.of(0.0, 0.5, 0.0, 0.5, 0.0)
    assert not healed.never_loses
    assert (healed.mean_burst, run_law(healed, False), run_law(healed, True)) == (None, None, None)
    dead = GilbertElliott.of(0.1, 0.0, 0.1, 1.0, 1.0)
    assert (dead.mean_burst, run_law(dead, False), dead.burst_decay) == (None, None, 1.0)


def fates(losses: GilbertElliott, packets: int, *, lanes: int = 1, lane: int = 0, seed: int = 1) -> NDArray[np.bool_]:
    """Arrival bits of shape (packets, lanes)."""
    states, drops = (Stream(seed, "link.test", p, width=1, lane=lane, lanes=lanes) for p in ("state", "loss"))
    process = GilbertElliottProcess(losses, states, drops, lanes)
    return np.array([process.next(number) for number in range(packets)], dtype=np.bool_).reshape(packets, lanes)


@pytest.fixture(scope="module", params=CHANNELS, ids=str)
def drawn(request: pytest.FixtureRequest) -> tuple[GilbertElliott, NDArray[np.bool_]]:
    losses = CHANNELS[request.param]
    return losses, fates(losses, 100_000)[:, 0]


def test_words_of_three_fates_have_their_probabilities(drawn: tuple[GilbertElliott, NDArray[np.bool_]]) -> None:
    """Taken far enough apart to be independent: memory^20 is below 1e-3."""
    losses, bits = drawn
    words = list(product((0, 1), repeat=3))
    counted = Counter(tuple(map(int, bits[i : i + 3])) for i in range(0, len(bits) - 3, 22))
    total = sum(counted.values())
    expected = [total * probability(losses, word) for word in words]
    assert stats.chisquare([counted[word] for word in words], expected).pvalue > LEVEL


@pytest.mark.parametrize("fate", [False, True])
def test_runs_are_drawn_from_their_law(drawn: tuple[GilbertElliott, NDArray[np.bool_]], fate: bool) -> None:
    """Every tenth run: neighbours are correlated through the state in which they begin."""
    losses, bits = drawn
    edges = np.flatnonzero(np.diff(bits.astype(np.int8))) + 1
    lengths = np.diff(edges)[bits[edges[:-1]] == fate][::10]
    law = run_law(losses, fate)
    assert law is not None
    longest = max(1, law.quantile(1.0 - min(0.9, 10.0 / len(lengths))) - 1)
    observed = [np.count_nonzero(lengths == n) for n in range(1, longest + 1)] + [np.count_nonzero(lengths > longest)]
    p = law.probability(np.arange(1.0, longest + 1.0))
    assert stats.chisquare(observed, len(lengths) * np.append(p, 1.0 - p.sum())).pvalue > LEVEL


def test_the_first_packets_follow_the_start() -> None:
    losses = GilbertElliott.of(0.3, 0.2, 0.1, 0.8, start_good=0.9)
    bits = fates(losses, 2, lanes=40_000)
    for word in product((0, 1), repeat=2):
        seen = int(np.count_nonzero((word == bits.T).all(axis=1)))
        assert stats.binomtest(seen, 40_000, probability(losses, word)).pvalue > LEVEL


def test_a_split_of_the_lanes_changes_no_fate() -> None:
    whole = fates(CHANNELS["noisy"], 200, lanes=7)
    for lane, lanes in ((0, 1), (1, 3), (4, 2), (6, 1)):
        part = fates(CHANNELS["noisy"], 200, lane=lane, lanes=lanes)
        np.testing.assert_array_equal(part, whole[:, lane : lane + lanes])


def scenario(**loss: float | str) -> Scenario:
    system = {"A": [[1.0]], "C": [[1.0]], "Q": [[1.0]], "R": [[1.0]]}
    return parse_scenario({"system": system, "links": {"observation": {"loss": loss}}})


def link(**loss: float | str) -> NDArray[np.bool_]:
    process = loss_process(scenario(**loss), "observation", 0, 64)
    return np.array([process.next(k) for k in range(300)])


def channel(**loss: float) -> NDArray[np.bool_]:
    return link(**({"kind": "gilbert-elliott", "to_bad": 0.1, "to_good": 0.2} | loss))


def test_moves_and_drops_have_draws_of_their_own() -> None:
    """Where both states lose alike the moves do not matter and the draws are those of a Bernoulli link; where the
    states say all, the drops do not matter; a larger loss_bad takes packets away and gives none back."""
    alike = channel(loss_good=0.3, loss_bad=0.3)
    np.testing.assert_array_equal(alike, link(kind="bernoulli", loss=0.3))
    np.testing.assert_array_equal(alike, channel(loss_good=0.3, loss_bad=0.3, to_bad=0.6))
    bad, worse = channel(loss_good=0.1, loss_bad=0.5), channel(loss_good=0.1, loss_bad=0.8)
    assert (worse <= bad).all()
    assert (worse < bad).any()
    states = LossProcess(Chain.markov(0.2, 0.1), Stream(1, "link.observation", "state", width=1, lane=0, lanes=64), 64)
    good = np.array([states.next(k) for k in range(300)])
    np.testing.assert_array_equal(channel(), good)
    np.testing.assert_array_equal(bad[good], channel(loss_good=0.1, loss_bad=0.9)[good])
