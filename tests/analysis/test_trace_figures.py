"""The figures of a trace against counts by hand, and those of a model against its definition."""

from __future__ import annotations

from itertools import groupby

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from testbed.analysis.trace_figures import Model, Packets, correlation_of, share_of_losses, trace_figures
from testbed.channel.gilbert_elliott import GilbertElliott
from testbed.channel.law import LossModel
from testbed.channel.loss import Chain
from testbed.errors import UsageError

MS = 10**6


def rows(fates: str) -> list[tuple[int, int, int | None]]:
    """x lost, . arrived; sent every 10 ms, 2 ms on the way."""
    return [(k, 10 * k * MS, None if fate == "x" else (10 * k + 2) * MS) for k, fate in enumerate(fates)]


@given(st.text("x.", min_size=1, max_size=60))
def test_losses_are_counts(fates: str) -> None:
    found = trace_figures(Packets.of(rows(fates)), None)
    bursts = [len(list(run)) for fate, run in groupby(fates) if fate == "x"]
    inner = [(fate, len(list(run))) for fate, run in groupby(fates)][1:-1]
    gaps = [length for fate, length in inner if fate == "."]
    assert (found.packets, found.lost, found.delivered) == (len(fates), fates.count("x"), fates.count("."))
    assert (found.bursts, found.longest_burst) == (len(bursts), max(bursts, default=0))
    assert found.mean_burst == (np.mean(bursts) if bursts else None)
    assert found.mean_gap == (np.mean(gaps) if gaps else None)
    assert found.interval.low <= found.loss_rate <= found.interval.high
    lost = [window.loss_rate * (window.last - window.first + 1) for window in found.windows]
    assert sum(lost) == pytest.approx(fates.count("x"))
    assert [window.first for window in found.windows[1:]] == [window.last + 1 for window in found.windows[:-1]]
    assert found.reordering.reordered == 0


def test_rows_in_any_order_with_copies() -> None:
    """The first arrival of a packet counts; a lost row of one that arrived counts for nothing."""
    packets = Packets.of([(7, 70, 99), (5, 50, 95), (6, 60, None), (5, 50, 90), (7, 70, None), (8, 80, 92)])
    np.testing.assert_array_equal(packets.arrived, [True, False, True, True])
    np.testing.assert_array_equal(packets.sent_ns, [0, 10, 20, 30])
    np.testing.assert_array_equal(packets.delays_ns, [40, 29, 12])
    np.testing.assert_array_equal(packets.order, [0, 3, 2])
    np.testing.assert_array_equal(packets.order_ns, [40, 42, 49])
    found = trace_figures(packets, None)
    assert (found.copies, found.reordering.reordered, found.reordering.late_max_ns) == (1, 1, 7)


def test_times_of_a_clock_far_from_zero() -> None:
    start = 2**62
    packets = Packets.of([(0, start, start + 5), (1, start + 10, start + 17)])
    np.testing.assert_array_equal(packets.delays_ns, [5, 7])
    with pytest.raises(UsageError, match=r"got times more than 2\^63 ns apart"):
        Packets.of([(0, 0, 5), (1, 2**64, 2**64 + 1)])


def test_nothing_is_a_line() -> None:
    with pytest.raises(UsageError, match="got no packet; allowed: one or more"):
        trace_figures(Packets.of([]), None)


def test_why_there_are_no_delays() -> None:
    assert trace_figures(Packets.of(rows("xxx")), None).why_no_delays == "nothing arrived"
    still = trace_figures(Packets.of([(0, 5, 5), (1, 9, 9)]), None)
    assert (still.delays, still.why_no_delays) == ((), "every delivered_ns is its sent_ns")


MODELS: dict[str, LossModel] = {
    "none": Chain.lossless(),
    "bernoulli": Chain.bernoulli(0.9),
    "markov": Chain.markov(0.25, 0.02),
    "alternating": Chain.markov(0.9, 0.8),
    "gilbert-elliott": GilbertElliott.of(0.02, 0.2, 0.01, 0.6),
}


def enumerated(losses: LossModel, number: int) -> dict[tuple[int, ...], float]:
    """P(fates) of so many packets, 1 = lost, from the chain of the states."""
    if isinstance(losses, GilbertElliott):
        states, loss = losses.states, [losses.loss_bad, losses.loss_good]
    else:
        states, loss = losses, [1.0, 0.0]
    moves = np.array([[1.0 - states.recovery, states.recovery], [states.failure, 1.0 - states.failure]])
    out: dict[tuple[int, ...], float] = {}
    for word in np.ndindex(*[2] * number):
        at = np.array([1.0 - states.arrival, states.arrival])
        for lost in word:
            at = (at * (np.array(loss) if lost else 1.0 - np.array(loss))) @ moves
        out[word] = float(at.sum())
    return out


@pytest.mark.parametrize("name", MODELS)
def test_what_a_model_says_is_what_all_words_say(name: str) -> None:
    losses, number = MODELS[name], 8
    words = enumerated(losses, number)
    share = {word: sum(word) / number for word in words}
    mean = sum(p * share[word] for word, p in words.items())
    spread = np.sqrt(sum(p * (share[word] - mean) ** 2 for word, p in words.items()))
    assert share_of_losses(losses, number) == pytest.approx((mean, spread), abs=1e-9)
    both = [sum(p for word, p in words.items() if word[0] and word[j]) for j in range(number)]
    found = correlation_of(losses, number - 1)
    variance = mean * (1.0 - mean)
    expected = [1.0, *((b - mean**2) / variance if variance else 0.0 for b in both[1:])]
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_a_model_stands_beside_its_own_trace() -> None:
    """A chain of its law in the test; its delays uniform, with their quantile function."""
    random, chain = np.random.default_rng(4), MODELS["markov"]
    fate, made = True, []
    for k in range(40_000):
        fate = bool(random.random() < (1.0 - chain.failure if fate else chain.recovery))
        made.append((k, k * MS, k * MS + int(random.integers(MS)) if fate else None))
    packets = Packets.of(made)
    found = trace_figures(packets, Model("its own", chain, 0, lambda level: int(level * MS)))
    assert found.model is not None
    assert found.model.expected is not None
    assert found.model.expected.low < found.loss_rate < found.model.expected.high
    assert found.model.loss_rate == pytest.approx(0.02 / 0.27)
    assert found.interval.low < found.model.loss_rate < found.interval.high
    assert found.model.goodness.p_value is not None
    assert found.model.goodness.p_value > 1e-3
    np.testing.assert_allclose(found.correlation[:6], found.model.correlation[:6], atol=0.03)
    for quantile in found.delays:
        assert quantile.theory == int(quantile.level * MS)
        assert quantile.low is not None
        assert quantile.high is not None
        assert quantile.low - 2000 < quantile.theory < quantile.high + 2000
    wrong = trace_figures(packets, Model("another", Chain.markov(0.5, 0.04), 0))
    assert wrong.model is not None
    assert wrong.model.goodness.p_value is not None
    assert wrong.model.goodness.p_value < 1e-6
    fitted = trace_figures(packets, Model("fitted", chain, 2))
    assert fitted.model is not None
    assert fitted.model.expected is None
