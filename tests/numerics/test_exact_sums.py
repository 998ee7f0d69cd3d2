"""Exact sums against rational arithmetic; and that neither order nor split of the terms changes a bit."""

from __future__ import annotations

import math
from decimal import Decimal, localcontext
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from testbed.numerics.exact import ExactMoments, exact_parts, fixed, square

check = settings(deadline=None, max_examples=150)

usable = st.floats(min_value=-1e149, max_value=1e149)
ordinary = st.floats(min_value=-1e3, max_value=1e3)
subnormal = st.floats(min_value=-2e-308, max_value=2e-308)
squarable = st.one_of(st.just(0.0), st.floats(1e-100, 1e140), st.floats(-1e140, -1e-100), st.floats(1.0, 2.0))
useless = st.sampled_from([math.inf, -math.inf, math.nan, 1e150, -1e150, 1e308])
anything = st.one_of(usable, ordinary, subnormal)


def moments_of(values: list[float]) -> ExactMoments:
    moments = ExactMoments()
    moments.add(np.array(values, dtype=np.float64))
    return moments


def figures(moments: ExactMoments) -> tuple[object, ...]:
    return moments.count, moments.undefined, moments.mean, moments.standard_error


def exact_mean(values: list[float]) -> float:
    return float(sum(map(Fraction, values), Fraction(0)) / len(values))


def exact_standard_error(values: list[float]) -> float:
    terms, n = [Fraction(v) for v in values], len(values)
    mean = sum(terms, Fraction(0)) / n
    variance = sum(((t - mean) ** 2 for t in terms), Fraction(0)) / (n - 1) / n
    with localcontext() as context:
        context.prec = 60
        return float((Decimal(variance.numerator) / Decimal(variance.denominator)).sqrt())


@check
@given(st.lists(anything, min_size=1, max_size=60))
def test_the_mean_is_correctly_rounded(values: list[float]) -> None:
    assert moments_of(values).mean == exact_mean(values)


@check
@given(st.lists(squarable, min_size=2, max_size=60))
def test_the_standard_error_is_that_of_rational_arithmetic(values: list[float]) -> None:
    given_error, expected = moments_of(values).standard_error, exact_standard_error(values)
    assert given_error is not None
    if expected < 1e-150:  # its square is not a normal double
        assert given_error < 1e-149
    else:
        assert math.isclose(given_error, expected, rel_tol=1e-15)


def test_cancellation_loses_nothing() -> None:
    rng = np.random.default_rng(1)
    small = rng.normal(size=20_001)
    big = rng.normal(size=10_000) * 10.0 ** rng.integers(0, 100, size=10_000)
    values = np.concatenate([small, big, -big])
    rng.shuffle(values)
    assert moments_of(values.tolist()).mean == float(sum(map(Fraction, small.tolist()), Fraction(0)) / len(values))


def test_a_spread_far_below_the_mean_keeps_its_digits() -> None:
    values = [1e8 + 1e-7 * i for i in range(1000)]
    error = moments_of(values).standard_error
    assert error is not None
    assert math.isclose(error, exact_standard_error(values), rel_tol=1e-15)


@check
@given(st.data())
def test_no_order_and_no_split_changes_a_bit(data: st.DataObject) -> None:
    values = data.draw(st.lists(st.one_of(anything, useless), min_size=1, max_size=40))
    expected = figures(moments_of(values))
    shuffled = data.draw(st.permutations(values))
    ends = sorted(data.draw(st.sets(st.integers(1, len(values)), max_size=5)) | {len(values)})
    whole = ExactMoments()
    for begin, end in zip([0, *ends], ends, strict=False):
        part = ExactMoments()
        piece = shuffled[begin:end]
        if len(piece) == 1 and data.draw(st.booleans()):
            part.add(piece[0])  # one lane is a float
        else:
            part.add(np.array(piece))
        whole.merge(part)
    assert figures(whole) == expected


@check
@given(st.lists(st.one_of(anything, useless), min_size=1, max_size=40))
def test_floats_one_by_one_are_the_array(values: list[float]) -> None:
    one_by_one = ExactMoments()
    for value in values:
        one_by_one.add(value)
    assert figures(one_by_one) == figures(moments_of(values))


@check
@given(st.lists(anything, max_size=30), st.lists(useless, max_size=10))
def test_what_has_no_square_is_left_out_and_counted(values: list[float], others: list[float]) -> None:
    moments = moments_of([*others, *values])
    assert (moments.count, moments.undefined) == (len(values), len(others))
    assert moments.mean == (exact_mean(values) if values else None)


def test_without_enough_values_there_is_no_figure() -> None:
    assert (ExactMoments().mean, ExactMoments().standard_error) == (None, None)
    assert (moments_of([3.0]).mean, moments_of([3.0]).standard_error) == (3.0, None)
    assert (moments_of([]).count, moments_of([]).mean) == (0, None)
    assert moments_of([0.1] * 7).standard_error == 0.0


@check
@given(st.lists(st.floats(min_value=-1e299, max_value=1e299), max_size=60))
def test_parts_have_the_sum_of_the_array(values: list[float]) -> None:
    parts = exact_parts(np.array(values, dtype=np.float64))
    assert sum(map(Fraction, parts), Fraction(0)) == sum(map(Fraction, values), Fraction(0))


@pytest.mark.parametrize("count", [1, 2, 3, 1000, 4095, 4096, 100_000])
def test_parts_of_large_arrays_of_equal_peaks(count: int) -> None:
    x = np.full(count, np.nextafter(1.0, 0.0))
    assert sum(map(Fraction, exact_parts(x)), Fraction(0)) == count * Fraction(float(x[0]))


@check
@given(squarable)
def test_a_square_has_no_error(x: float) -> None:
    for argument in (x, np.array([x, x, x])):
        hi, lo = square(argument)
        last = [float(np.ravel(part)[-1]) for part in (hi, lo)]
        assert Fraction(last[0]) + Fraction(last[1]) == Fraction(x) ** 2
        assert last[0] == x * x


@check
@given(st.floats(allow_nan=False, allow_infinity=False))
def test_fixed_point_holds_every_double(x: float) -> None:
    assert Fraction(fixed(x), 2**1126) == Fraction(x)
