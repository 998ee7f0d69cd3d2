"""Intervals that know correlation: they cover as often as they say, where those for independent packets do not."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from testbed.analysis.correlation import autocorrelation, autocovariance, correlation_time, share_interval
from testbed.analysis.fit_intervals import chain_loss, wilson
from testbed.channel.loss import Chain
from testbed.numerics.lanes import Bools

SERIES, PACKETS = 600, 5000

# P(state → state), P(lost | state)
MODELS = {
    "independent": ([[0.9, 0.1], [0.9, 0.1]], [0.0, 1.0]),
    "bursts": ([[0.98, 0.02], [0.25, 0.75]], [0.0, 1.0]),
    "alternating": ([[0.3, 0.7], [0.8, 0.2]], [0.0, 1.0]),
    "hidden": ([[0.97, 0.03], [0.06, 0.94]], [0.02, 0.5]),
}


def lost(name: str, seed: int = 3) -> tuple[Bools, float]:
    """Losses (PACKETS, SERIES) of independent stationary series, and their probability."""
    moves, loss = (np.array(part) for part in MODELS[name])
    random = np.random.default_rng(seed)
    bad = moves[0, 1] / (moves[0, 1] + moves[1, 0])
    state = (random.random(SERIES) < bad).astype(int)
    out = np.empty((PACKETS, SERIES), dtype=np.bool_)
    for k in range(PACKETS):
        out[k] = random.random(SERIES) < loss[state]
        state = (random.random(SERIES) < moves[state, 1]).astype(int)
    return out, float((1.0 - bad) * loss[0] + bad * loss[1])


def covered(intervals: list[tuple[float, float]], truth: float) -> int:
    return sum(low <= truth <= high for low, high in intervals)


@pytest.mark.parametrize("name", MODELS)
def test_the_interval_without_a_model_covers(name: str) -> None:
    series, rate = lost(name)
    hits = covered([share_interval(series[:, lane])[0] for lane in range(SERIES)], rate)
    assert stats.binomtest(hits, SERIES, 0.95).pvalue > 1e-4


@pytest.mark.parametrize("name", ["independent", "bursts", "alternating"])
def test_the_interval_of_a_chain_covers(name: str) -> None:
    """A chain fitted by its shares of transitions."""
    series, rate = lost(name)
    intervals = []
    for lane in range(SERIES):
        gone = series[:, lane]
        recovery, failure = np.mean(~gone[1:][gone[:-1]]), np.mean(gone[1:][~gone[:-1]])
        intervals.append(chain_loss(int(gone.sum()), PACKETS, Chain.markov(float(recovery), float(failure))))
    hits = covered([tuple(interval) for interval in intervals], rate)
    assert stats.binomtest(hits, SERIES, 0.95).pvalue > 1e-4


def test_the_interval_for_independent_packets_does_not() -> None:
    """By how much the interval of bursts is wider: √((2 − p − r)/(p + r)) = 2.53 for p = 0.02, r = 0.25."""
    series, rate = lost("bursts")
    hits = covered([tuple(wilson(int(series[:, lane].sum()), PACKETS)) for lane in range(SERIES)], rate)
    assert hits < 0.65 * SERIES
    times = [correlation_time(series[:, lane].astype(float)) for lane in range(SERIES)]
    assert np.sqrt(np.median(times)) == pytest.approx(np.sqrt(1.73 / 0.27), rel=0.05)


def test_autocovariance_is_its_definition() -> None:
    values = np.random.default_rng(1).normal(size=37).cumsum()
    centred = values - values.mean()
    direct = [float(centred[: 37 - j] @ centred[j:]) / 37 for j in range(37)]
    np.testing.assert_allclose(autocovariance(values), direct, rtol=0, atol=1e-10)
    np.testing.assert_allclose(autocorrelation(values, 5), np.array(direct[:6]) / direct[0], atol=1e-12)


@pytest.mark.parametrize("values", [[1.0], [0.0, 0.0], [1.0] * 9])
def test_values_that_are_all_the_same(values: list[float]) -> None:
    assert correlation_time(np.array(values)) == 1.0
    np.testing.assert_array_equal(autocorrelation(np.array(values), 0), [1.0])


def test_strict_alternation_tells_more_than_independence() -> None:
    assert correlation_time(np.tile([0.0, 1.0], 50)) <= 0.05
