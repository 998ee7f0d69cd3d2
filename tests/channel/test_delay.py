"""Delay laws against scipy's distributions, and against their own distribution functions."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import TypeAdapter
from scipy import stats

from channel.impaired import MS, pipeline, send_all, times_of
from testbed.channel.delay import cdf_of, law_of
from testbed.scenario.impairments import Delay

check = settings(deadline=None, max_examples=60)
LAWS: dict[str, tuple[dict[str, Any], Any]] = {
    "uniform": ({"kind": "uniform", "low": "2 ms", "high": "12 ms"}, stats.uniform(2 * MS, 10 * MS)),
    "normal": (
        {"kind": "normal", "mean": "10 ms", "std": "3 ms"},
        stats.truncnorm(-10 / 3, np.inf, 10 * MS, 3 * MS),
    ),
    "cut near the mean": (
        {"kind": "normal", "mean": "10 ms", "std": "3 ms", "minimum": "11 ms"},
        stats.truncnorm(1 / 3, np.inf, 10 * MS, 3 * MS),
    ),
    "never cut": ({"kind": "normal", "mean": "100 ms", "std": "1 ms"}, stats.norm(100 * MS, 1 * MS)),
    "cut far out": (
        {"kind": "normal", "mean": "1 ms", "std": "1 ms", "minimum": "7 ms"},
        stats.truncnorm(6, np.inf, 1 * MS, 1 * MS),
    ),
    "log-normal": (
        {"kind": "log-normal", "median": "5 ms", "sigma": 0.8, "minimum": "3 ms"},
        stats.lognorm(0.8, 3 * MS, 5 * MS),
    ),
}


ANY: TypeAdapter[Delay] = TypeAdapter(Delay)


def delay_of(given: dict[str, Any]) -> Delay:
    return ANY.validate_python(given)


@pytest.mark.parametrize("name", LAWS)
def test_quantiles_are_scipy_s(name: str) -> None:
    given, expected = LAWS[name]
    law = law_of(delay_of(given))
    chances = np.concatenate([np.linspace(0.001, 0.999, 333), [1e-9, 1e-6, 1 - 1e-6, 1 - 1e-9]])
    found = [law(float(u)) for u in chances]
    assert all(isinstance(value, int) for value in found)
    np.testing.assert_allclose(found, expected.ppf(chances), rtol=1e-8, atol=1.0)


@pytest.mark.parametrize("name", LAWS)
def test_the_first_and_the_last_draw_are_finite_and_far_out(name: str) -> None:
    """They stand for the middle of their share, 2^-54 from either end; scipy has few digits there."""
    given, expected = LAWS[name]
    law = law_of(delay_of(given))
    assert law(0.0) == pytest.approx(expected.ppf(2.0**-54), rel=0.02, abs=1)
    assert law(1.0 - 2.0**-53) == pytest.approx(expected.isf(2.0**-54), rel=0.02)


@pytest.mark.parametrize("name", LAWS)
def test_distribution_functions_are_scipy_s(name: str) -> None:
    given, expected = LAWS[name]
    at = np.linspace(0, 120 * MS, 1501).astype(int)
    cdf = cdf_of(delay_of(given))
    found = [cdf(int(ns)) for ns in at]
    np.testing.assert_allclose(found, expected.cdf(at), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name", LAWS)
def test_draws_have_the_law(name: str) -> None:
    given, expected = LAWS[name]
    law = law_of(delay_of(given))
    draws = [law(u) for u in np.random.default_rng(11).random(100_000).tolist()]
    assert stats.kstest(draws, expected.cdf).pvalue >= 1e-6


@pytest.mark.parametrize("name", LAWS)
@check
@given(u=st.floats(0.0, 1.0, exclude_max=True))
def test_quantile_and_distribution_function_are_inverse(name: str, u: float) -> None:
    delay = delay_of(LAWS[name][0])
    at, cdf = law_of(delay)(u), cdf_of(delay)
    assert at >= 0
    assert cdf(at - 2) <= u + 1e-9
    assert cdf(at + 2) >= u - 1e-9


@pytest.mark.parametrize("by", ["0 s", "3 ms"])
def test_a_constant_is_one(by: str) -> None:
    delay = delay_of({"kind": "constant", "by": by})
    at = 0 if by == "0 s" else 3 * MS
    assert {law_of(delay)(u) for u in (0.0, 0.3, 1 - 2**-53)} == {at}
    assert (cdf_of(delay)(at - 1), cdf_of(delay)(at)) == (0.0, 1.0)


def test_a_log_normal_without_spread_is_a_constant() -> None:
    delay = delay_of({"kind": "log-normal", "median": "5 ms", "sigma": 0.0, "minimum": "1 ms"})
    assert {law_of(delay)(u) for u in (0.0, 0.3, 1 - 2**-53)} == {6 * MS}
    assert (cdf_of(delay)(6 * MS - 1), cdf_of(delay)(6 * MS)) == (0.0, 1.0)


def test_a_uniform_without_width_is_a_constant() -> None:
    delay = delay_of({"kind": "uniform", "low": "5 ms", "high": "5 ms"})
    assert {law_of(delay)(u) for u in (0.0, 0.3, 1 - 2**-53)} == {5 * MS}
    assert (cdf_of(delay)(5 * MS - 1), cdf_of(delay)(5 * MS)) == (0.0, 1.0)


@check
@given(st.lists(st.integers(0, 50), min_size=1, max_size=12), st.integers(1, 5))
def test_a_table_is_its_empirical_law(values: list[int], times: int) -> None:
    delay = delay_of({"kind": "table", "unit": "us", "values": values})
    parts = len(values) * times
    found = [law_of(delay)((i + 0.5) / parts) for i in range(parts)]
    assert sorted(found) == sorted(value * 1000 for value in values for _ in range(times))
    assert law_of(delay)(0.0) in found
    assert law_of(delay)(1 - 2**-53) in found
    cdf = cdf_of(delay)
    for ns in range(-1000, 52_000, 500):
        assert abs(cdf(ns) - sum(value * 1000 <= ns for value in values) / len(values)) < 1e-15


def test_in_order_waits_for_the_latest_before() -> None:
    given, times = LAWS["uniform"][0], times_of(500)
    free = [copies[0].at_ns for copies in send_all(pipeline(delay=given), times)]
    ordered = [copies[0].at_ns for copies in send_all(pipeline(delay=given | {"in_order": True}), times)]
    assert ordered == [max(free[: i + 1]) for i in range(len(free))] != free


def test_a_lost_packet_keeps_nobody_waiting() -> None:
    given, times = LAWS["uniform"][0] | {"in_order": True}, times_of(500)
    loss = {"kind": "bernoulli", "arrival": 0.5}
    free = [copies[0].at_ns for copies in send_all(pipeline(delay=LAWS["uniform"][0]), times)]
    found = send_all(pipeline(delay=given, loss=loss), times)
    latest = 0
    for at, copies in zip(free, found, strict=True):
        if copies:
            latest = max(latest, at)
            assert [copy.at_ns for copy in copies] == [latest]
