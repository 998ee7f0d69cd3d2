"""The four-state model, and hidden chains of any number of states, against sums over all paths of the states."""

from __future__ import annotations

import math
from collections import Counter
from itertools import pairwise, product
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import stats

from testbed.analysis.bursts import run_law
from testbed.channel.chains import chain_of
from testbed.channel.four_state import four_state
from testbed.channel.gilbert_elliott import GilbertElliott, GilbertElliottProcess
from testbed.channel.hidden import Hidden, HiddenChain, HiddenProcess
from testbed.channel.law import law_of, stationary_of
from testbed.channel.loss import Chain
from testbed.channel.processes import process_of
from testbed.numerics.markov import long_run
from testbed.numerics.streams import Stream
from testbed.scenario import FourStateLoss

LEVEL = 1e-3
MODELS = {
    "bursts with pauses": four_state(0.05, 0.3, 0.3, 0.5, 0.02),
    "isolated losses": four_state(0.02, 0.4, to_isolated=0.1),
    "long pauses": four_state(0.2, 0.1, 0.4, 0.1),
}
check = settings(deadline=None, max_examples=50, derandomize=True)
rates = st.floats(0.02, 0.98)


@st.composite
def four_states(draw: st.DrawFn, stationary: bool = False) -> HiddenChain:
    leave_good, leave_burst, isolated, pause = (draw(rates) for _ in range(4))
    weights = np.array(draw(st.lists(st.floats(0.0, 1.0), min_size=4, max_size=4)))
    assume(stationary or weights.sum() > 0.1)
    start = None if stationary else tuple((weights / weights.sum()).tolist())
    return four_state(
        leave_good * (1.0 - isolated),
        leave_burst * (1.0 - pause),
        leave_burst * pause,
        draw(rates),
        leave_good * isolated,
        start,
    )


@st.composite
def hidden_chains(draw: st.DrawFn) -> HiddenChain:
    """Of three states, any loss in each, stationary."""
    rows = np.array([draw(st.lists(rates, min_size=3, max_size=3)) for _ in range(3)])
    moves = rows / rows.sum(axis=1, keepdims=True)
    losses = draw(st.lists(st.sampled_from([0.0, 0.2, 0.7, 1.0]), min_size=3, max_size=3, unique=True))
    first = long_run(np.ones(3) / 3, moves)
    return HiddenChain(tuple(first.tolist()), tuple(map(tuple, moves.tolist())), tuple(losses))


def probability(losses: Hidden, fates: tuple[int, ...]) -> float:
    """P(fates of the first packets): a packet meets a state, which decides over its fate; then the state moves."""
    states = range(len(losses.loss))
    total = 0.0
    for path in product(states, repeat=len(fates)):
        chance = losses.initial[path[0]]
        for before, after in pairwise(path):
            chance *= losses.transition[before, after]
        for state, fate in zip(path, fates, strict=True):
            chance *= 1.0 - losses.loss[state] if fate else losses.loss[state]
        total += chance
    return total


models = st.one_of(four_states(), hidden_chains())
stationary_models = st.one_of(four_states(stationary=True), hidden_chains())


@check
@given(models, st.lists(st.integers(0, 1), min_size=1, max_size=4))
def test_the_law_gives_the_probabilities_of_all_fates(losses: Hidden, fates: list[int]) -> None:
    law = law_of(losses)
    weights = law.initial * (law.arrived == fates[0])
    for fate in fates[1:]:
        weights = (weights @ law.transition) * (law.arrived == fate)
    assert weights.sum() == pytest.approx(probability(losses, tuple(fates)), abs=1e-14)
    np.testing.assert_allclose(law.transition.sum(axis=1), 1.0, rtol=1e-14)
    np.testing.assert_allclose(stationary_of(losses) @ law.transition, stationary_of(losses), atol=1e-14)
    assert losses.first_arrival == pytest.approx(probability(losses, (1,)), abs=1e-14)


@check
@given(models)
def test_probabilities_sum_to_one(losses: Hidden) -> None:
    assert sum(probability(losses, fates) for fates in product((0, 1), repeat=4)) == pytest.approx(1.0, abs=1e-12)
    assert losses.stationary.sum() == pytest.approx(1.0, abs=1e-14)
    np.testing.assert_allclose(losses.stationary @ losses.transition, losses.stationary, atol=1e-14)
    assert (losses.stationary >= 0.0).all()


@check
@given(stationary_models)
def test_stationary_figures(losses: Hidden) -> None:
    words = {word: probability(losses, word) for word in product((0, 1), repeat=2)}
    arrival = words[1, 0] + words[1, 1]
    assert losses.arrival == pytest.approx(arrival, rel=1e-12)
    assert losses.correlation == pytest.approx((words[1, 1] - arrival**2) / (arrival * (1.0 - arrival)), abs=1e-12)
    assert losses.mean_burst == pytest.approx((1.0 - arrival) / words[1, 0], rel=1e-12)
    law = run_law(losses, False)
    assert law is not None
    assert losses.mean_burst == pytest.approx(law.mean, rel=1e-9)


@check
@given(models, st.integers(1, 4))
def test_moments_of_the_share_that_is_delivered(losses: Hidden, packets: int) -> None:
    """The mean from the first packet on, and the variance of the stationary law."""
    stationary = HiddenChain(
        tuple(losses.stationary.tolist()), tuple(map(tuple, losses.transition.tolist())), tuple(losses.loss.tolist())
    )
    words = list(product((0, 1), repeat=packets))
    share = np.array([sum(word) / packets for word in words])
    settled = np.array([probability(stationary, word) for word in words])
    mean, variance = losses.share_moments(packets)
    assert mean == pytest.approx(share @ [probability(losses, word) for word in words], abs=1e-11)
    assert variance == pytest.approx(share**2 @ settled - (share @ settled) ** 2, abs=1e-11)


def test_moments_of_long_shares_are_those_of_the_chain() -> None:
    """Of 10^6 packets of a slow chain, without loss of digits."""
    chain = Chain.markov(0.002, 0.001)
    hidden = four_state(0.001, 0.002)
    assert hidden.share_moments(10**6) == pytest.approx(chain.share_moments(10**6), rel=1e-9)


@check
@given(models, st.integers(0, 3))
def test_the_covariance_factor_covers_the_covariances(losses: Hidden, row: int) -> None:
    packets = 4
    words = np.array(list(product((0, 1), repeat=packets)))
    weights = np.array([probability(losses, tuple(word)) for word in words.tolist()])
    away = words - weights @ words
    covariances = (away * weights[:, None]).T @ away
    factor = losses.covariance_factor
    assert factor is not None
    assert np.abs(covariances[row]).sum() <= 0.25 * factor + 1e-12


def test_the_covariance_factor_of_two_states_is_the_closed_form() -> None:
    channel = GilbertElliott.of(0.1, 0.2, 0.1, 0.8)
    same = HiddenChain(tuple(channel.initial), tuple(map(tuple, channel.transition)), tuple(channel.loss))
    assert same.covariance_factor == pytest.approx(channel.covariance_factor, rel=1e-12)
    assert four_state(1.0, 1.0).covariance_factor is None  # alternates
    r = 0.7
    assert four_state(0.1, 0.2).covariance_factor == pytest.approx(1.0 + 2.0 * r / (1.0 - r), rel=1e-12)


@check
@given(stationary_models)
def test_long_bursts_get_rarer_by_theta(losses: Hidden) -> None:
    law = law_of(losses)
    lost = law.states_of(False)
    block = law.transition[np.ix_(lost, lost)]
    weights = stationary_of(losses)[lost]
    tails = [(weights @ np.linalg.matrix_power(block, m)).sum() for m in (400, 401)]
    if tails[1] > 1e-280:
        assert losses.burst_decay == pytest.approx(tails[1] / tails[0], rel=2e-2)
    assert losses.burst_decay == pytest.approx(np.abs(np.linalg.eigvals(block)).max(), rel=1e-9, abs=1e-12)


@check
@given(stationary_models)
def test_no_past_makes_a_loss_more_likely_than_worst_loss(losses: Hidden) -> None:
    for past in product((0, 1), repeat=4):
        before = probability(losses, past)
        if before > 1e-12:
            assert probability(losses, (*past, 0)) / before <= losses.worst_loss + 1e-10


@pytest.mark.parametrize(
    ("losses", "chain"),
    [
        (four_state(0.2, 0.5), Chain.markov(0.5, 0.2)),
        (four_state(0.2, 0.5, from_pause=0.3, start=(0.1, 0.0, 0.9, 0.0)), Chain.markov(0.5, 0.2, 0.1)),
        (four_state(0.2, 0.5, 0.5, 0.3, 0.1), Chain.markov(1.0, 0.3)),
        (four_state(0.2, 0.5, 0.3, 0.2), Chain.markov(0.8, 0.2)),
        (four_state(0.2, 0.5, 0.3, 0.2, start=(0.0, 0.0, 1.0, 0.0)), Chain(0.8, 0.2, 0.0)),
        (four_state(0.25, 0.75), Chain.bernoulli(0.75)),
        (four_state(0.0, 0.5), Chain.lossless()),
        (four_state(0.3, 0.0, start=(0.0, 0.0, 1.0, 0.0)), Chain.bernoulli(0.0)),
    ],
)
def test_what_is_a_chain_of_arrivals_is_taken_for_one(losses: HiddenChain, chain: Chain) -> None:
    assert losses.as_chain is not None
    assert len(law_of(losses).arrived) == 2
    for figure in ("never_loses", "independent", "first_arrival", "burst_decay", "recovery", "failure", "start"):
        assert getattr(losses, figure) == pytest.approx(getattr(chain, figure), rel=1e-14, abs=1e-15)
    for fates in product((0, 1), repeat=3):
        steps = [chain.first_arrival, *(1.0 - chain.failure if last else chain.recovery for last in fates[:-1])]
        expected = math.prod(p if fate else 1.0 - p for p, fate in zip(steps, fates, strict=True))
        assert probability(losses, fates) == pytest.approx(expected, abs=1e-15)


def test_states_that_say_more_than_the_fates_are_no_chain() -> None:
    assert all(losses.as_chain is None for losses in MODELS.values())


def stream(purpose: str, lanes: int, lane: int = 0) -> Stream:
    return Stream(1, "link.test", purpose, width=1, lane=lane, lanes=lanes)


def fates(losses: HiddenChain, packets: int, *, lanes: int = 1, lane: int = 0) -> NDArray[np.bool_]:
    """Arrival bits of shape (packets, lanes)."""
    process = HiddenProcess(losses, stream("state", lanes, lane), stream("loss", lanes, lane), lanes)
    return np.array([process.next(number) for number in range(packets)], dtype=np.bool_).reshape(packets, lanes)


def test_the_draws_of_two_states_are_those_of_gilbert_elliott() -> None:
    """A burst without pause or isolated loss; and any channel of two states, good first."""
    for lanes in (1, 50):
        for channel, same in (
            (GilbertElliott.of(0.1, 0.3), four_state(0.1, 0.3)),
            (GilbertElliott.of(0.1, 0.3, 0.2, 0.7), _good_first(GilbertElliott.of(0.1, 0.3, 0.2, 0.7))),
        ):
            process = GilbertElliottProcess(channel, stream("state", lanes), stream("loss", lanes), lanes)
            reference = np.array([process.next(k) for k in range(2000)]).reshape(2000, lanes)
            np.testing.assert_array_equal(fates(same, 2000, lanes=lanes), reference)


def _good_first(channel: GilbertElliott) -> HiddenChain:
    moves = tuple(map(tuple, channel.transition[::-1, ::-1].tolist()))
    return HiddenChain(tuple(channel.initial[::-1].tolist()), moves, tuple(channel.loss[::-1].tolist()))


def test_a_split_of_the_lanes_changes_no_fate() -> None:
    whole = fates(MODELS["bursts with pauses"], 200, lanes=7)
    for lane, lanes in ((0, 1), (1, 3), (4, 2), (6, 1)):
        part = fates(MODELS["bursts with pauses"], 200, lane=lane, lanes=lanes)
        np.testing.assert_array_equal(part, whole[:, lane : lane + lanes])


class Highest:
    """In place of a stream: the largest number that one can draw."""

    def __init__(self, lanes: int) -> None:
        self._lanes = lanes

    def uniforms(self, step: int) -> list[Any]:
        point = 1.0 - 2.0**-53
        return [point if self._lanes == 1 else np.full(self._lanes, point)]

    def first(self, step: int) -> Any:
        return self.uniforms(step)[0]


@pytest.mark.parametrize("lanes", [1, 2])
def test_rounding_leads_to_no_state_that_cannot_be(lanes: int) -> None:
    """(1 − p13 − p14) + p13 may be less than 1 where p14 = 0."""
    losses = four_state(0.23, 0.1, 0.2, 0.3)
    assert any(sum(row[:-1]) < 1.0 for row in (losses.first, *losses.moves))
    process = HiddenProcess(losses, Highest(lanes), Highest(lanes), lanes)  # type: ignore[arg-type]
    for number in range(5):
        state = int(np.atleast_1d(process.move(number))[0])
        assert state != 3


def test_the_first_packets_follow_the_start() -> None:
    losses = four_state(0.3, 0.2, 0.4, 0.5, 0.1, start=(0.4, 0.3, 0.2, 0.1))
    bits = fates(losses, 3, lanes=40_000)
    for word in product((0, 1), repeat=3):
        seen = int(np.count_nonzero((word == bits.T).all(axis=1)))
        assert stats.binomtest(seen, 40_000, probability(losses, word)).pvalue > LEVEL


@pytest.mark.parametrize("losses", MODELS.values(), ids=MODELS)
def test_runs_and_words_are_drawn_from_their_law(losses: HiddenChain) -> None:
    """60,000 packets: words far enough apart, every tenth run."""
    bits = fates(losses, 1500, lanes=40)
    words = list(product((0, 1), repeat=3))
    counted = Counter(tuple(map(int, word)) for start in range(0, 1450, 50) for word in bits[start : start + 3].T)
    total = sum(counted.values())
    expected = [total * probability(losses, word) for word in words]
    assert stats.chisquare([counted[word] for word in words], expected).pvalue > LEVEL
    for fate in (False, True):
        law = run_law(losses, fate)
        assert law is not None
        lengths = np.concatenate([_runs(lane, fate) for lane in bits.T])[::10]
        longest = max(1, law.quantile(0.9))
        observed = [*np.bincount(np.minimum(lengths, longest + 1), minlength=longest + 2)[1:]]
        p = law.probability(np.arange(1.0, longest + 1.0))
        assert stats.chisquare(observed, len(lengths) * np.append(p, 1.0 - p.sum())).pvalue > LEVEL


def _runs(lane: NDArray[np.bool_], fate: bool) -> NDArray[np.intp]:
    """Whole runs that begin in the first half, so that long ones are not left out."""
    edges = np.flatnonzero(np.diff(lane.astype(np.int8))) + 1
    begins = edges[:-1] < len(lane) // 2
    return np.diff(edges)[(lane[edges[:-1]] == fate) & begins]


def test_a_state_that_is_moved_by_time_decides_over_all_packets_of_its_slot() -> None:
    """State number k is the same whether packets or slots are counted, and no packet is drawn from it."""
    loss = FourStateLoss(to_burst=0.1, to_good=0.3, to_pause=0.2, from_pause=0.5, to_isolated=0.1)
    by_packet, by_slot = (process_of(loss, lambda purpose: stream(purpose, 1), 1) for _ in range(2))
    for slot in range(200):
        state, arrived = by_slot.move(slot), by_packet.next(slot)
        assert by_packet.state == state
        assert {by_slot.fate(number, state) for number in (3 * slot, 3 * slot + 1)} == {arrived}


def test_the_words_of_netem() -> None:
    """tc netem loss state p13 p31 p32 p23 p14."""
    p13, p31, p32, p23, p14 = 0.1, 0.3, 0.2, 0.4, 0.05
    loss = FourStateLoss(to_burst=p13, to_good=p31, to_pause=p32, from_pause=p23, to_isolated=p14)
    losses = chain_of(loss)
    assert isinstance(losses, HiddenChain)
    expected = [[1 - p13 - p14, 0, p13, p14], [0, 1 - p23, p23, 0], [p31, p32, 1 - p31 - p32, 0], [1, 0, 0, 0]]
    np.testing.assert_allclose(losses.transition, expected, rtol=1e-15, atol=1e-16)
    weights = np.array([1.0, p13 * p32 / (p31 * p23), p13 / p31, p14])
    np.testing.assert_allclose(losses.initial, weights / weights.sum(), rtol=1e-14)
    assert losses.losses == (0.0, 0.0, 1.0, 1.0)
