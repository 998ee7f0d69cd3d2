"""The loss processes against the laws that define them, by χ² at fixed seeds."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from testbed.channel.chains import chain_of
from testbed.channel.loss import Chain, LossProcess
from testbed.numerics.streams import Stream
from testbed.scenario import BernoulliLoss, MarkovLoss, NoLoss

Bits = NDArray[np.bool_]
PACKETS = 200_000
LEVEL = 1e-3

CHAINS = {
    "bernoulli 0.8": Chain.bernoulli(0.8),
    "bernoulli 0.05": Chain.bernoulli(0.05),
    "sticky": Chain.markov(0.1, 0.02),
    "mild": Chain.markov(0.5, 0.3),
    "mostly lost": Chain.markov(0.2, 0.9),
    "alternating": Chain.markov(0.95, 0.9),
    "recovers at once": Chain.markov(1.0, 0.25),
    "fails at once": Chain.markov(0.3, 1.0),
}


def fates(chain: Chain, packets: int, *, lanes: int = 1, lane: int = 0, seed: int = 1) -> Bits:
    """Arrival bits of shape (packets, lanes)."""
    process = LossProcess(chain, Stream(seed, "link.test", "loss", width=1, lane=lane, lanes=lanes), lanes)
    return np.array([process.next(number) for number in range(packets)], dtype=np.bool_).reshape(packets, lanes)


def runs(bits: Bits, value: bool) -> NDArray[np.int64]:
    """Lengths of the whole runs of ``value``: neither the first nor the last run of the sequence."""
    edges = np.flatnonzero(np.diff(bits.astype(np.int8))) + 1
    return np.diff(edges)[bits[edges[:-1]] == value]


def geometric_pvalue(lengths: NDArray[np.int64], parameter: float) -> float:
    """χ² of run lengths 1, 2, … against the geometric law; the tail is pooled where 10 or fewer are expected."""
    total = len(lengths)
    longest = max(1, int(stats.geom.isf(min(1.0, 10.0 / total), parameter)))
    observed = [np.count_nonzero(lengths == n) for n in range(1, longest + 1)] + [np.count_nonzero(lengths > longest)]
    law = stats.geom(parameter)
    expected = [total * law.pmf(n) for n in range(1, longest + 1)] + [total * law.sf(longest)]
    return float(stats.chisquare(observed, expected).pvalue)


def along_time(chain: Chain) -> Bits:
    return fates(chain, PACKETS)[:, 0]


@pytest.fixture(scope="module", params=CHAINS, ids=str)
def sequence(request: pytest.FixtureRequest) -> tuple[Chain, Bits]:
    chain = CHAINS[request.param]
    return chain, along_time(chain)


def test_moves_from_each_state_have_the_probabilities_of_the_chain(sequence: tuple[Chain, Bits]) -> None:
    chain, bits = sequence
    for state, arrival in ((False, chain.recovery), (True, 1.0 - chain.failure)):
        after = bits[1:][bits[:-1] == state]
        observed = np.array([np.count_nonzero(~after), np.count_nonzero(after)])
        expected = len(after) * np.array([1.0 - arrival, arrival])
        if arrival in (0.0, 1.0):
            np.testing.assert_array_equal(observed, expected)
        else:
            assert stats.chisquare(observed, expected).pvalue > LEVEL


def test_the_last_fate_is_all_that_counts(sequence: tuple[Chain, Bits]) -> None:
    """Given the last fate, the one before it says nothing: χ² of independence."""
    _, bits = sequence
    for state in (False, True):
        here = bits[1:-1] == state
        before, after = bits[:-2][here], bits[2:][here]
        table = [[np.count_nonzero((before == a) & (after == b)) for b in (False, True)] for a in (False, True)]
        if np.min(np.sum(table, axis=0)) and np.min(np.sum(table, axis=1)):
            assert stats.chi2_contingency(table, correction=False).pvalue > LEVEL


def test_bursts_are_geometric_with_the_recovery_rate(sequence: tuple[Chain, Bits]) -> None:
    chain, bits = sequence
    bursts = runs(bits, False)
    if chain.recovery == 1.0:
        assert set(bursts) == {1}
    else:
        assert geometric_pvalue(bursts, chain.recovery) > LEVEL


def test_gaps_are_geometric_with_the_failure_rate(sequence: tuple[Chain, Bits]) -> None:
    chain, bits = sequence
    gaps = runs(bits, True)
    if chain.failure == 1.0:
        assert set(gaps) == {1}
    else:
        assert geometric_pvalue(gaps, chain.failure) > LEVEL


def test_the_law_is_stationary_from_the_first_packet_on(sequence: tuple[Chain, Bits]) -> None:
    chain, _ = sequence
    bits = fates(chain, 12, lanes=20_000)
    rate = chain.recovery / (chain.recovery + chain.failure)
    for packet in (0, 1, 11):
        ones = np.count_nonzero(bits[packet])
        assert stats.binomtest(int(ones), bits.shape[1], rate).pvalue > LEVEL


def test_lanes_side_by_side_follow_the_chain_as_well(sequence: tuple[Chain, Bits]) -> None:
    chain, _ = sequence
    bits = fates(chain, 40, lanes=5000, seed=2)
    lost = bits[1:][~bits[:-1]]
    kept = bits[1:][bits[:-1]]
    assert stats.binomtest(int(lost.sum()), lost.size, chain.recovery).pvalue > LEVEL
    assert stats.binomtest(int(kept.sum()), kept.size, 1.0 - chain.failure).pvalue > LEVEL


@pytest.mark.parametrize("start", [0.0, 0.3, 1.0])
def test_the_first_packet_follows_start(start: float) -> None:
    chain = chain_of(MarkovLoss(recovery=0.5, failure=0.25, start=start))
    bits = fates(chain, 2, lanes=40_000)
    assert stats.binomtest(int(bits[0].sum()), 40_000, start).pvalue > LEVEL
    second = start * 0.75 + (1.0 - start) * 0.5
    assert stats.binomtest(int(bits[1].sum()), 40_000, second).pvalue > LEVEL


@pytest.mark.parametrize("lanes", [1, 2, 5])
@pytest.mark.parametrize(
    ("chain", "expected"),
    [
        (chain_of(NoLoss()), True),
        (chain_of(BernoulliLoss(arrival=1.0)), True),
        (chain_of(BernoulliLoss(arrival=0.0)), False),
        (chain_of(MarkovLoss(recovery=0.4, failure=0.0)), True),
        (chain_of(MarkovLoss(recovery=0.0, failure=0.4)), False),
        (chain_of(MarkovLoss(recovery=0.0, failure=0.4, start=0.0)), False),
        (chain_of(MarkovLoss(recovery=0.4, failure=0.0, start=1.0)), True),
    ],
)
def test_certain_fates(chain: Chain, expected: bool, lanes: int) -> None:
    np.testing.assert_array_equal(fates(chain, 1000, lanes=lanes), expected)
    mask = LossProcess(chain, Stream(1, "link.test", "loss", width=1, lane=0, lanes=lanes), lanes).next(0)
    assert isinstance(mask, bool) if lanes == 1 else mask.shape == (lanes,)


def test_a_chain_that_only_recovers_never_loses_again() -> None:
    bits = fates(Chain.markov(0.3, 0.0, start=0.0), 60, lanes=200)
    assert not bits[0].any()
    assert bits[-1].all()
    assert (np.diff(bits.astype(np.int8), axis=0) >= 0).all()
    assert not Chain.markov(0.3, 0.0, start=0.0).never_loses


def test_alternation_is_strict_where_both_rates_are_one() -> None:
    bits = fates(Chain.markov(1.0, 1.0, start=1.0), 10, lanes=3)
    np.testing.assert_array_equal(bits, np.arange(10)[:, None] % 2 == np.zeros((1, 3)))


def test_no_split_of_the_lanes_changes_a_fate() -> None:
    chain = Chain.markov(0.5, 0.3)
    whole = fates(chain, 200, lanes=7)
    for lane, lanes in ((0, 1), (1, 3), (4, 2), (6, 1)):
        np.testing.assert_array_equal(fates(chain, 200, lane=lane, lanes=lanes), whole[:, lane : lane + lanes])


def test_lanes_are_independent() -> None:
    bits = fates(Chain.markov(0.5, 0.3), 20_000, lanes=2).astype(float)
    thinned = bits[::20]  # the chain forgets: (1 − 0.5 − 0.3)^20
    assert abs(np.corrcoef(thinned.T)[0, 1]) < 4.0 / np.sqrt(len(thinned))


@pytest.mark.parametrize(("loss", "mean_burst"), [(0.1, 2.0), (0.3, 1.0), (0.5, 5.0)])
def test_the_other_parameters_of_a_markov_loss(loss: float, mean_burst: float) -> None:
    from testbed.scenario import parse_scenario

    table = {"kind": "markov", "loss": loss, "mean_burst": mean_burst}
    system = {"A": [[1.0]], "C": [[1.0]], "Q": [[1.0]], "R": [[1.0]]}
    scenario = parse_scenario({"system": system, "links": {"observation": {"loss": table}}})
    bits = along_time(chain_of(scenario.links.observation.loss))
    bursts = runs(bits, False)
    deviation = np.std(bursts) / np.sqrt(len(bursts)) + 1e-12
    assert abs(bursts.mean() - mean_burst) < 4.0 * deviation
    per_block = np.reshape(~bits, (200, -1)).mean(axis=1)
    assert abs(per_block.mean() - loss) < 4.0 * per_block.std() / np.sqrt(200)
