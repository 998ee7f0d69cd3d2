import numpy as np
import pytest

from orchestrator.fabricated_summary import estimator, fabricate
from testbed.orchestrator.report import text
from testbed.orchestrator.report.derived import common_band, mean, relative_excess, settled


def figures(steps=8, **overrides):
    return estimator(np.random.default_rng(1), np.ones(steps), **overrides)


def test_last_quarter_of_the_run():
    tail = settled(figures(trace_P_mean=[9, 9, 9, 9, 9, 9, 1, 2], trace_P_stderr=[0, 0, 0, 0, 0, 0, 0.25, 0.5]), 8)
    assert (tail.first, tail.last) == (7, 8)
    assert tail.trace_P == 1.5
    assert tail.trace_P_stderr == 0.375


@pytest.mark.parametrize(("steps", "first"), [(1, 1), (3, 3), (4, 4), (7, 7), (8, 7), (100, 76)])
def test_where_the_last_quarter_starts(steps, first):
    tail = settled(figures(steps), steps)
    assert (tail.first, tail.last) == (first, steps)


def test_an_estimator_that_stops_early_has_a_quarter_of_its_own():
    tail = settled(figures(until=4, trace_P_mean=[1, 2, 3, 4, None, None, None, None]), 8)
    assert (tail.first, tail.last, tail.trace_P, tail.missing) == (4, 4, 4.0, 0)
    assert settled(figures(until=0), 8) is None
    assert settled(figures(until=20), 8).last == 8


def test_a_value_that_overflowed_does_not_drop_out_of_its_mean():
    tail = settled(figures(trace_P_mean=[1, 1, 1, 1, 1, 1, 1e300, None]), 8)
    assert tail.trace_P is None
    assert tail.missing == 1


def test_shares_count_only_steps_that_have_the_figure():
    tail = settled(
        figures(
            nees_mean=[1, 2, 3, None, 2, 2, 2, 2.5],
            nees_band_95=(1.5, 2.5),
            excess_mean=[1.0, -1.0, 3.0, 0.0, None, 0.1, 0.1, 0.1],
            excess_stderr=[1.0, 1.0, 1.0, None, 1.0, 0.1, 0.01, 0.1],
        ),
        8,
    )
    assert tail.nees_in_band == pytest.approx(5 / 7)
    assert tail.excess_consistent == pytest.approx(4 / 6)


def test_one_lane_has_no_standard_errors():
    tail = settled(figures(lanes=1), 8)
    assert tail.trace_P_stderr is None
    assert tail.excess_consistent is None
    assert tail.nees_in_band is not None


def test_mean_of_what_overflows_when_added():
    assert mean(np.full(10, 1.5e308)) == pytest.approx(1.5e308)
    assert mean(np.zeros(3)) == 0.0
    assert mean(np.array([])) is None


def test_relative_excess_is_undefined_where_the_covariance_is_zero():
    ratio, stderr = relative_excess(
        figures(2, trace_P_mean=[0.0, 2.0], excess_mean=[1.0, 1.0], excess_stderr=[1.0, 0.5])
    )
    assert np.isnan([ratio[0], stderr[0]]).all()
    assert (ratio[1], stderr[1]) == (0.5, 0.25)


def test_one_band_only_when_all_share_it():
    summary = fabricate(steps=4)
    assert common_band(summary) == summary.estimators["oe"].nees_band_95
    two = {"a": figures(4), "b": figures(4, lanes=2)}
    assert common_band(fabricate(steps=4, estimators=two)) is None
    assert common_band(fabricate(steps=4, estimators={})) is None


@pytest.mark.parametrize(
    ("value", "stderr", "expected"),
    [
        (41.2345, 0.312, "41.23 ± 0.31"),
        (-41.2345, 12.0, "-41 ± 12"),
        (None, 0.3, "—"),
        (41.2345, None, "41.23"),
        (41.2345, 0.0, "41.23"),
        (2.0, 0.00123, "2.0000 ± 0.0012"),
        (1.25e7, 3.1e5, "(1.250 ± 0.031)·10⁷"),
        (6.5e300, 1.2e299, "(6.50 ± 0.12)·10³⁰⁰"),
        (6.5e-300, 1.2e-301, "(6.50 ± 0.12)·10⁻³⁰⁰"),
        (0.0, 0.5, "0.00 ± 0.50"),
    ],
)
def test_value_and_error_are_rounded_together(value, stderr, expected):
    assert text.plus_minus(value, stderr) == expected


def test_numbers_as_text():
    assert [text.number(v) for v in (None, 0.0, 2.0, 1234.4, 1e300, -2.5e-7)] == [
        "—", "0", "2.000", "1234", "1.000·10³⁰⁰", "-2.500·10⁻⁷"
    ]  # fmt: skip
    assert text.share(0.946) == "95 %"
    assert text.plural(1, "step") == "1 step"
    assert text.plural(25600, "lane") == "25\u2009600 lanes"
    assert text.steps(3, 3) == "3"
