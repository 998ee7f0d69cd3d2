"""Intervals of differences: exact small cases of scipy, and how often they hold what they should hold."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from testbed.analysis.batch_means import batched, correlation_time
from testbed.analysis.bootstrap import bca
from testbed.analysis.differences import Difference, holm, paired, welch

A = np.array([3.1, 2.7, 5.9, 4.4, 8.2, 1.3])
B = np.array([2.2, 3.0, 4.1, 4.9, 6.0, 0.4])


@pytest.fixture
def no_bootstrap(monkeypatch: pytest.MonkeyPatch) -> None:
    """Which takes time, and is not what is tested."""
    monkeypatch.setattr("testbed.analysis.differences.bca", lambda values: None)


def covers(found: Difference, truth: float) -> bool:
    assert found.interval is not None
    return found.interval.low <= truth <= found.interval.high


def test_pairs_are_those_of_scipy() -> None:
    found, expected = paired(A, B), stats.ttest_rel(A, B)
    assert found.p_value == pytest.approx(expected.pvalue, rel=1e-12)
    assert found.interval == pytest.approx(expected.confidence_interval(0.95), rel=1e-12)
    assert found.difference == pytest.approx((A - B).mean(), rel=1e-13)
    assert found.stderr == pytest.approx(stats.sem(A - B), rel=1e-12)
    assert found.ratio == pytest.approx(A.mean() / B.mean(), rel=1e-13)
    assert found.number == 6
    assert found.a_smaller == pytest.approx(2 / 6)
    assert found.a_smaller_interval == pytest.approx(stats.binomtest(2, 6).proportion_ci(method="wilson"), rel=1e-9)


def test_independent_samples_are_those_of_scipy() -> None:
    found, expected = welch(A, B[:4]), stats.ttest_ind(A, B[:4], equal_var=False)
    assert found.p_value == pytest.approx(expected.pvalue, rel=1e-12)
    assert found.interval == pytest.approx(expected.confidence_interval(0.95), rel=1e-12)
    assert found.number == 10


@pytest.mark.parametrize("scale", [1e-300, 1e-9, 1.0, 1e300])
def test_scale_changes_nothing_but_the_scale(scale: float) -> None:
    found, plain = paired(scale * A, scale * B), paired(A, B)
    assert found.p_value == pytest.approx(plain.p_value, rel=1e-9)
    assert found.ratio_interval == pytest.approx(plain.ratio_interval, rel=1e-9)
    assert found.interval is not None
    assert plain.interval is not None
    assert found.interval.low / scale == pytest.approx(plain.interval.low, rel=1e-6)
    assert welch(scale * A, scale * B).p_value == pytest.approx(welch(A, B).p_value, rel=1e-9)


def test_the_order_of_pairs_does_not_matter_but_which_are_paired_does() -> None:
    order = np.random.default_rng(3).permutation(6)
    again, found, apart = paired(A[order], B[order]), paired(A, B), paired(A[order], B)
    assert again.interval == pytest.approx(found.interval, rel=1e-12)
    assert apart.difference == pytest.approx(found.difference, rel=1e-12)
    assert apart.stderr != pytest.approx(found.stderr, rel=1e-2)


def test_correlated_pairs_are_surer_than_independent_samples() -> None:
    """Var(a − b) = 2σ²(1 − r) against 2σ²: with r = 0.9 the interval is about √10 times narrower."""
    rng = np.random.default_rng(1)
    common = rng.normal(size=4000)
    a, b = (math.sqrt(0.9) * common + math.sqrt(0.1) * rng.normal(size=4000) for _ in range(2))
    pairs, apart = paired(a, b), welch(a, b)
    assert pairs.stderr is not None
    assert apart.stderr is not None
    assert apart.stderr / pairs.stderr == pytest.approx(math.sqrt(10), rel=0.05)


def test_equal_differences_have_no_spread() -> None:
    same, none = paired(B + 1.0, B), paired(A, A)
    assert none.difference == 0.0
    assert none.interval == (0.0, 0.0)
    assert none.p_value == 1.0
    assert none.a_smaller is None
    assert none.bootstrap == (0.0, 0.0)
    assert same.p_value is not None
    assert same.p_value < 1e-30
    assert welch(np.ones(3), np.zeros(3)).p_value == 0.0


def test_what_rounding_can_do_is_no_difference() -> None:
    found = paired(A * (1 + 1e-14), A)
    assert (found.difference, found.p_value, found.a_smaller) == (0.0, 1.0, None)
    assert paired(A * (1 + 1e-11), A).p_value != 1.0


def test_values_that_are_not_finite_are_left_out_and_counted() -> None:
    a, b = np.append(A, [math.nan, 1.0, math.inf]), np.append(B, [1.0, math.nan, 2.0])
    found = paired(a, b)
    assert (found.number, found.left_out) == (6, 3)
    assert found.interval == paired(A, B).interval
    apart = welch(a, b)
    assert (apart.number, apart.left_out) == (15, 3)
    nothing = paired(np.full(3, math.nan), np.ones(3))
    assert (nothing.number, nothing.left_out, nothing.difference, nothing.interval) == (0, 3, None, None)
    one = paired(A[:1], B[:1])
    assert one.difference == A[0] - B[0]
    assert one.interval is None
    assert one.p_value is None
    assert welch(A[:1], B).interval is None


@pytest.mark.usefixtures("no_bootstrap")
@pytest.mark.parametrize("lanes", [5, 40])
def test_intervals_of_pairs_cover_as_often_as_they_say(lanes: int) -> None:
    rng = np.random.default_rng(lanes)
    samples = rng.normal(size=(2000, 2, lanes)) + rng.normal(size=(2000, 1, lanes))
    hits = sum(covers(paired(a + 0.3, b), 0.3) for a, b in samples)
    assert stats.binomtest(hits, 2000, 0.95).pvalue > 1e-3


def test_intervals_of_independent_samples_cover_as_often_as_they_say() -> None:
    rng = np.random.default_rng(8)
    a, b = rng.normal(2.0, 1.0, size=(2000, 12)), rng.normal(1.0, 5.0, size=(2000, 30))
    hits = sum(covers(welch(x, y), 1.0) for x, y in zip(a, b, strict=True))
    assert stats.binomtest(hits, 2000, 0.95).pvalue > 1e-3


@pytest.mark.usefixtures("no_bootstrap")
def test_the_interval_of_the_ratio_covers() -> None:
    rng = np.random.default_rng(9)
    common = rng.gamma(4.0, size=(2000, 1, 50))
    samples = common * rng.gamma(20.0, 1 / 20.0, size=(2000, 2, 50))
    hits = 0
    for a, b in samples:
        found = paired(1.5 * a, b).ratio_interval
        assert found is not None
        hits += found.low <= 1.5 <= found.high
    assert 0.93 < hits / 2000 < 0.97


def test_skewed_or_few_pairs_get_a_bootstrap_interval() -> None:
    rng = np.random.default_rng(2)
    symmetric, skewed, zero = rng.normal(size=200), rng.lognormal(0.0, 1.5, size=200), np.zeros(200)
    assert paired(symmetric, zero).bootstrap is None
    assert paired(skewed, zero).bootstrap is not None
    assert paired(symmetric[:10], zero[:10]).bootstrap is not None
    assert paired(symmetric, zero, heavy=True).bootstrap is not None


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_bootstrap_is_that_of_scipy(seed: int) -> None:
    values = np.random.default_rng(seed).lognormal(0.0, 1.0, size=25)
    found = bca(values)
    expected = stats.bootstrap((values,), np.mean, n_resamples=20_000, method="BCa", random_state=5).confidence_interval
    assert found is not None
    width = expected.high - expected.low
    assert found.low == pytest.approx(expected.low, abs=0.02 * width)
    assert found.high == pytest.approx(expected.high, abs=0.04 * width)


def test_the_bootstrap_of_three_values_is_that_of_all_samples() -> None:
    """All 27 samples with replacement are equally likely: bias and quantiles by enumeration."""
    values = np.array([0.0, 1.0, 5.0])
    means = np.sort([np.mean(sample) for sample in product(values, repeat=3)])
    bias = stats.norm.ppf(np.mean(means < 2.0) + 0.5 * np.mean(np.isclose(means, 2.0)))
    jack = np.array([np.mean(np.delete(values, i)) for i in range(3)])
    pull = jack.mean() - jack
    acceleration = (pull**3).sum() / (6 * (pull**2).sum() ** 1.5)
    found = bca(values)
    assert found is not None
    for end, z in zip(found, (-1.959964, 1.959964), strict=True):
        share = stats.norm.cdf(bias + (bias + z) / (1 - acceleration * (bias + z)))
        assert end == pytest.approx(means[math.ceil(27 * share) - 1], abs=1e-9)


def test_the_bootstrap_has_its_bounds() -> None:
    assert bca(np.ones(1)) is None
    assert bca(np.zeros(20_001)) is None
    assert bca(np.ones(5)) == (1.0, 1.0)


def holm_by_definition(p: list[float], alpha: float) -> set[int]:
    """Step down: reject the smallest while it is at most α / (hypotheses left)."""
    rejected: set[int] = set()
    for rank, i in enumerate(sorted(range(len(p)), key=lambda i: p[i])):
        if p[i] > alpha / (len(p) - rank):
            break
        rejected.add(i)
    return rejected


@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=8), st.sampled_from([0.01, 0.05, 0.3]))
def test_adjusted_p_values_reject_what_holm_rejects(p: list[float], alpha: float) -> None:
    found = holm(p)
    margin = 1e-12
    for i, value in enumerate(found):
        assert value is not None
        assert p[i] <= value <= 1.0
        if abs(value - alpha) > margin:
            assert (value <= alpha) == (i in holm_by_definition(p, alpha))


def test_what_has_no_p_value_does_not_count() -> None:
    assert holm([None, 0.02, None, 0.01]) == [None, 0.02, None, 0.02]


def autoregressive(rng: np.random.Generator, memory: float, runs: int, steps: int) -> np.ndarray:
    """(runs, steps), stationary with variance 1."""
    noise = math.sqrt(1 - memory**2) * rng.normal(size=(runs, steps))
    noise[:, 0] /= math.sqrt(1 - memory**2)
    for k in range(1, steps):
        noise[:, k] += memory * noise[:, k - 1]
    return noise


@pytest.mark.parametrize("memory", [0.0, 0.5, 0.9])
def test_the_correlation_time_of_a_chain(memory: float) -> None:
    """1 + 2 Σ r^j = (1 + r)/(1 − r)."""
    found = [correlation_time(row) for row in autoregressive(np.random.default_rng(4), memory, 40, 5000)]
    assert np.mean(found) == pytest.approx((1 + memory) / (1 - memory), rel=0.1)


@pytest.mark.usefixtures("no_bootstrap")
@pytest.mark.parametrize("memory", [0.0, 0.7, 0.9])
def test_batches_of_one_lane_cover(memory: float) -> None:
    rows = autoregressive(np.random.default_rng(5), memory, 1000, 4000)
    found = [batched(row + 1.5, np.full(4000, 0.5)) for row in rows]
    sure = [one for one in found if one.interval is not None]
    assert len(sure) > 970
    assert 0.925 < np.mean([covers(one, 1.0) for one in sure]) < 0.975


def test_too_short_a_series_has_no_interval_and_says_so() -> None:
    row = autoregressive(np.random.default_rng(6), 0.95, 1, 300)[0]
    found = batched(row, np.zeros(300))
    assert found.interval is None
    assert found.difference == pytest.approx(row.mean())
    assert found.note is not None
    assert found.note.startswith("300 steps are too few for an interval")
    missing = batched(np.array([1.0, math.nan]), np.ones(2))
    assert (missing.interval, missing.left_out, missing.note) == (None, 1, "1 of 2 steps have no figure")
