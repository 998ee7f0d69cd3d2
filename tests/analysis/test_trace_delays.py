"""Quantiles of delays: their values, and how often their intervals cover, for independent and for correlated delays."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from testbed.analysis.trace_delays import LEVELS, quantiles


def test_values_are_order_statistics() -> None:
    found = quantiles(np.random.default_rng(1).permutation(np.arange(1, 1001)))
    assert [(quantile.level, quantile.value) for quantile in found] == [
        (0.5, 500),
        (0.9, 900),
        (0.99, 990),
        (0.999, 999),
    ]
    assert found[0].low is not None
    assert found[0].high is not None
    assert found[0].low == pytest.approx(500 - 1.96 * np.sqrt(250), abs=3)
    assert found[0].high == pytest.approx(500 + 1.96 * np.sqrt(250), abs=3)


def test_a_short_trace_does_not_bound_a_far_quantile() -> None:
    *_, far = quantiles(np.arange(200))
    assert (far.level, far.value, far.high) == (0.999, 199, None)
    (only, *_) = quantiles(np.array([5]))
    assert (only.value, only.low, only.high) == (5, None, None)


def test_one_delay_for_all() -> None:
    assert [(q.value, q.low) for q in quantiles(np.full(5000, 7))] == [(7, 7)] * 4


@pytest.mark.parametrize("memory", [0.0, 0.8])
def test_coverage(memory: float) -> None:
    """Normal delays, autoregressive of order one: the marginal law is known, and so are its quantiles."""
    random, series, number = np.random.default_rng(5), 400, 6000
    noise = random.normal(size=(number, series))
    value = noise[0]
    delays = np.empty((number, series))
    for k in range(number):
        value = memory * value + np.sqrt(1.0 - memory**2) * noise[k]
        delays[k] = value
    whole = np.rint(10**8 + 10**7 * delays).astype(np.int64)
    hits = dict.fromkeys(LEVELS, 0)
    for lane in range(series):
        for quantile in quantiles(whole[:, lane]):
            truth = 10**8 + 10**7 * stats.norm.ppf(quantile.level)
            low = -np.inf if quantile.low is None else quantile.low
            high = np.inf if quantile.high is None else quantile.high
            hits[quantile.level] += low <= truth <= high
    for level, count in hits.items():
        assert count / series > 0.92, (level, count)
        assert level > 0.9 or count / series <= 0.99
