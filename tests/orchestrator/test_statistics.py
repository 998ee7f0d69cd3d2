"""The figures of an estimator against numpy, and the NEES band against scipy."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from testbed.analysis.consistency import chi_square_band
from testbed.numerics.lanes import matrix_of, vector_of
from testbed.orchestrator.statistics import ERROR_FIGURES, Series, error_figures


def sample(lanes: int, n: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """x, x_hat (M, n) and P (M, n, n)."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(lanes, n, n))
    P = root @ root.transpose(0, 2, 1) + 0.5 * np.eye(n)
    return rng.normal(size=(lanes, n)), rng.normal(size=(lanes, n)), P


@pytest.mark.parametrize("n", [1, 2, 4])
@pytest.mark.parametrize("lanes", [1, 2, 50])
def test_figures_of_each_lane_are_those_of_numpy(lanes: int, n: int) -> None:
    x, x_hat, P = sample(lanes, n, seed=lanes + n)
    found = error_figures(vector_of(x), vector_of(x_hat), matrix_of(P))
    e = x - x_hat
    expected = {
        "trace_P": np.trace(P, axis1=1, axis2=2),
        "squared_error": (e**2).sum(axis=1),
        "nees": np.einsum("mi,mij,mj->m", e, np.linalg.inv(P), e),
        "excess": (e**2).sum(axis=1) - np.trace(P, axis1=1, axis2=2),
    }
    assert set(found) == set(expected) == set(ERROR_FIGURES)
    for name, values in expected.items():
        np.testing.assert_allclose(np.atleast_1d(found[name]), values, rtol=1e-11, atol=1e-12, err_msg=name)


def test_nees_is_not_defined_where_P_is_not_definite() -> None:
    x, x_hat, P = sample(3, 2, seed=1)
    P[1] = [[1.0, 2.0], [2.0, 1.0]]
    P[2] = 0.0
    series = Series(ERROR_FIGURES, lanes=3)
    with np.errstate(all="ignore"):
        series.add(1, 0, error_figures(vector_of(x), vector_of(x_hat), matrix_of(P)))
    series.close(1)
    assert series.undefined == 2
    e = (x - x_hat)[0]
    assert series.mean["nees"] == [pytest.approx(e @ np.linalg.inv(P[0]) @ e, rel=1e-12)]
    assert series.mean["trace_P"] == [pytest.approx(np.trace(P, axis1=1, axis2=2).mean(), rel=1e-12)]


@pytest.mark.parametrize("n", [1, 2, 3, 6])
@pytest.mark.parametrize("lanes", [1, 2, 256, 100_000])
def test_the_band_is_that_of_chi_square(n: int, lanes: int) -> None:
    low, high = chi_square_band(n, lanes)
    law = stats.chi2(n * lanes)
    assert law.cdf(low * lanes) == pytest.approx(0.025, rel=1e-6)
    assert law.sf(high * lanes) == pytest.approx(0.025, rel=1e-6)


@settings(deadline=None, max_examples=40)
@given(st.data())
def test_series_are_numpy_means_step_by_step(data: st.DataObject) -> None:
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    steps, lanes = data.draw(st.integers(1, 4)), data.draw(st.integers(2, 12))
    values = rng.normal(size=(steps, lanes)) * 10.0 ** data.draw(st.integers(-6, 6))
    cuts = [0, *sorted(data.draw(st.sets(st.integers(1, lanes - 1), max_size=3))), lanes]
    pieces = [(k, slice(a, b)) for k in range(steps) for a, b in pairwise(cuts)]
    series = Series(("figure",), lanes)
    for k, lanes_of_piece in data.draw(st.permutations(pieces)):
        piece = values[k, lanes_of_piece]
        series.add(k + 1, lanes_of_piece.start, {"figure": float(piece[0]) if len(piece) == 1 else piece})
    for k in range(steps):
        series.close(k + 1)
    np.testing.assert_allclose(series.mean["figure"], values.mean(axis=1), rtol=1e-9, atol=1e-12 * np.abs(values).max())
    np.testing.assert_allclose(series.stderr["figure"], values.std(axis=1, ddof=1) / math.sqrt(lanes), rtol=1e-11)


def test_a_step_without_values_has_no_figures() -> None:
    for lanes in (1, 2):
        series = Series(("lower", "upper"), lanes)
        series.add(1, 0, {"lower": 2.0 if lanes == 1 else np.array([1.0, 3.0])})
        series.close(1)
        series.close(2)
        assert series.mean == {"lower": [2.0, None], "upper": [None, None]}
        assert series.stderr == {"lower": [None if lanes == 1 else 1.0, None], "upper": [None, None]}


@pytest.mark.parametrize("wrong", [math.nan, math.inf])
def test_one_lane_without_a_figure_has_none(wrong: float) -> None:
    series = Series(("nees", "other"), lanes=1)
    series.add(1, 0, {"nees": wrong, "other": wrong})
    series.add(2, 0, {"nees": 1.0, "other": 2.0})
    for step in (1, 2):
        series.close(step)
    assert series.mean == {"nees": [None, 1.0], "other": [None, 2.0]}
    assert series.undefined == 1
