"""Means and standard errors over lanes against rational arithmetic; and that no split of the lanes changes a bit."""

from __future__ import annotations

import math
from decimal import Decimal, localcontext
from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from testbed.numerics.moments import GROUP, LaneMoments

Floats = NDArray[np.float64]
Result = tuple[int, float | None, float | None]
check = settings(deadline=None, max_examples=80)
UNIT = 2.0**-53

sizes = st.one_of(st.integers(1, 12), st.sampled_from([GROUP - 1, GROUP, GROUP + 1, 2 * GROUP, 3 * GROUP + 5, 300]))
ordinary = st.one_of(st.just(0.0), st.floats(1e-100, 1e3), st.floats(-1e3, -1e-100))
wide = st.floats(-1e140, 1e140)
useless = st.sampled_from([math.inf, -math.inf, math.nan])


def results(values: Floats, blocks: list[tuple[int, int]] | None = None) -> list[Result]:
    """Of values (F, lanes), brought in blocks (lane, lanes) in the order given."""
    figures, lanes = values.shape
    moments = LaneMoments(figures, lanes)
    for lane, size in blocks or [(0, lanes)]:
        moments.add(lane, values[:, lane : lane + size])
    return [moments.results()[i] for i in range(figures)]


def exact(values: list[float]) -> tuple[float, float]:
    """Mean and standard error, each rounded once."""
    terms, n = [Fraction(v) for v in values], len(values)
    mean = sum(terms, Fraction(0)) / n
    variance = sum(((t - mean) ** 2 for t in terms), Fraction(0)) / max(1, n - 1) / n
    with localcontext() as context:
        context.prec = 60
        return float(mean), float((Decimal(variance.numerator) / Decimal(variance.denominator)).sqrt())


@check
@given(sizes.flatmap(lambda lanes: hnp.arrays(np.float64, (1, lanes), elements=st.one_of(ordinary, wide))))
def test_the_mean_is_that_of_rational_arithmetic(values: Floats) -> None:
    ((count, mean, _),) = results(values)
    terms = values[0].tolist()
    assert count == len(terms)
    assert mean is not None
    assert abs(mean - exact(terms)[0]) <= 12 * UNIT * math.fsum(map(abs, terms)) / len(terms)


@check
@given(
    sizes.filter(lambda lanes: lanes > 1).flatmap(lambda lanes: hnp.arrays(np.float64, (1, lanes), elements=ordinary))
)
def test_the_standard_error_is_that_of_rational_arithmetic(values: Floats) -> None:
    ((_, _, error),) = results(values)
    expected = exact(values[0].tolist())[1]
    size = float(np.abs(values).max())
    assert error is not None
    assert abs(error - expected) <= 1e-14 * expected + 1e-15 * size


@pytest.mark.parametrize("lanes", [2, 63, 64, 65, 1000, 100_000])
def test_a_spread_far_below_the_mean_keeps_its_digits(lanes: int) -> None:
    noise = np.random.default_rng(lanes).normal(size=lanes)
    ((_, mean, error),) = results((1e6 + noise)[None])
    expected = exact((1e6 + noise).tolist())
    assert mean == pytest.approx(expected[0], rel=1e-15)
    assert error == pytest.approx(expected[1], rel=1e-13)


@st.composite
def splits(draw: st.DrawFn, lanes: int) -> list[tuple[int, int]]:
    """Blocks (lane, lanes) that make up all lanes, in any order."""
    cuts = draw(st.sets(st.integers(1, max(1, lanes - 1)), max_size=8)) if lanes > 1 else set()
    ends = [0, *sorted(cuts), lanes]
    blocks = [(a, b - a) for a, b in pairwise(ends)]
    return draw(st.permutations(blocks))


@pytest.mark.filterwarnings("error")
@settings(deadline=None, max_examples=120)
@given(st.data())
def test_no_split_and_no_order_changes_a_bit(data: st.DataObject) -> None:
    figures, lanes = data.draw(st.integers(1, 4)), data.draw(sizes)
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    values = rng.normal(size=(figures, lanes)) * 10.0 ** rng.integers(-20, 20, size=(figures, lanes))
    for _ in range(data.draw(st.integers(0, 4))):
        place = rng.integers(figures), rng.integers(lanes)
        values[place] = data.draw(st.one_of(useless, st.sampled_from([1e150, -1e299, 1e301, -1.7e308, 1.7e308])))
    whole = results(values)
    split = results(values, data.draw(splits(lanes)))
    one_by_one = results(values, [(int(lane), 1) for lane in rng.permutation(lanes)])
    np.testing.assert_equal(split, whole)
    np.testing.assert_equal(one_by_one, whole)


@pytest.mark.filterwarnings("error")
@check
@given(sizes, st.data())
def test_what_is_not_finite_is_left_out_and_counted(lanes: int, data: st.DataObject) -> None:
    rng = np.random.default_rng(lanes)
    values = rng.normal(size=(2, lanes))
    usable = np.array(data.draw(st.lists(st.booleans(), min_size=lanes, max_size=lanes)))
    values[0, ~usable] = data.draw(useless)
    (count, mean, error), (all_of_them, _, _) = results(values)
    kept = values[0, usable].tolist()
    assert (count, all_of_them) == (len(kept), lanes)
    if not kept:
        assert (mean, error) == (None, None)
        return
    expected = exact(kept)
    assert mean == pytest.approx(expected[0], rel=1e-13, abs=1e-15)
    if len(kept) == 1:
        assert error is None
    else:
        assert error == pytest.approx(expected[1], rel=1e-13)


@pytest.mark.filterwarnings("error")
def test_figures_too_large_for_a_square_are_not_left_out() -> None:
    ((count, mean, error),) = results(np.array([[1e300, 3e300]]))
    assert (count, mean) == (2, 2e300)
    assert error == math.inf


def test_equal_values_have_no_error() -> None:
    for lanes in (2, 64, 200):
        ((_, mean, error),) = results(np.full((1, lanes), 0.1))
        assert mean == pytest.approx(0.1, rel=1e-15)
        assert error is not None
        assert error < 1e-17
