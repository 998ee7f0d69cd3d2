"""The collector: it knows what is complete, in whatever order the parts come, and what is still awaited."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from orchestrator.parts import STEPS, Bench, Part, given_scenario


def complete_steps(given: set[Part], all_parts: list[Part]) -> int:
    """The number of steps from the first on of which nothing is missing, by definition."""
    k = 0
    while k < STEPS and all(part in given for part in all_parts if part[1] == k + 1):
        k += 1
    return k


@settings(deadline=None, max_examples=60)
@given(st.data())
def test_steps_are_complete_when_all_their_parts_are_there(data: st.DataObject) -> None:
    bench = Bench(given_scenario())
    parts = bench.parts()
    seen: set[Part] = set()
    for part in data.draw(st.permutations(parts)):
        bench.give(part)
        seen.add(part)
        complete = complete_steps(seen, parts)
        assert bench.collector.completed == complete
        assert bench.collector.finished == (complete == STEPS)
        assert len(bench.collector.estimators["aoe"].mean["nees"]) == complete
        if complete < STEPS:
            missing = {what for what, k, lane in parts if k == complete + 1 and (what, k, lane) not in seen}
            texts = {"truth": "truth", "bounds": "bounds", "aoe": "estimate of aoe", "oe": "estimate of oe"}
            assert bench.collector.awaiting() == f"step {complete + 1}: {', '.join(sorted(texts[w] for w in missing))}"


@settings(deadline=None, max_examples=40)
@given(st.data())
def test_the_order_of_the_parts_changes_no_bit(data: st.DataObject) -> None:
    in_order, shuffled = Bench(given_scenario()), Bench(given_scenario())
    for part in in_order.parts():
        in_order.give(part)
    for part in data.draw(st.permutations(shuffled.parts())):
        shuffled.give(part)
    for name in ("aoe", "oe"):
        one, other = in_order.collector.estimators[name], shuffled.collector.estimators[name]
        assert (one.mean, one.stderr, one.undefined) == (other.mean, other.stderr, other.undefined)
    assert in_order.collector.bounds.mean == shuffled.collector.bounds.mean
    assert in_order.collector.applied == shuffled.collector.applied


def test_figures_are_means_over_all_lanes_of_the_errors() -> None:
    bench = Bench(given_scenario())
    for part in bench.parts():
        bench.give(part)
    collector = bench.collector
    errors = ((bench.x - bench.x_hat["aoe"])[1:] ** 2).sum(axis=2)
    np.testing.assert_allclose(collector.estimators["aoe"].mean["squared_error"], errors.mean(axis=1), rtol=1e-13)
    traces = np.trace(bench.P, axis1=2, axis2=3)[1:]
    np.testing.assert_allclose(collector.estimators["aoe"].mean["trace_P"], traces.mean(axis=1), rtol=1e-13)
    np.testing.assert_allclose(collector.bounds.mean["lower"], bench.traces[0, 1:].mean(axis=1), rtol=1e-13)
    np.testing.assert_allclose(collector.bounds.mean["upper"], bench.traces[1, 1:].mean(axis=1), rtol=1e-13)
    assert collector.applied == int(bench.nu[1:].sum())


def test_an_estimator_that_ends_is_not_awaited_any_longer() -> None:
    bench = Bench(given_scenario())
    for part in bench.parts():
        bench.give(part)
    series = bench.collector.estimators["oe"]
    assert bench.collector.finished
    for values in (*series.mean.values(), *series.stderr.values()):
        assert [value is None for value in values] == [False, False, True, True]


def test_without_bounds_none_are_awaited() -> None:
    bench = Bench(given_scenario(bounds=False))
    for part in bench.parts():
        if part[0] != "bounds":
            bench.give(part)
    assert bench.collector.finished


def test_figures_are_paired_by_lane() -> None:
    """The mean of an excess needs truth and estimate of the same lanes, whichever came first."""
    for first, second in (("truth", "aoe"), ("aoe", "truth")):
        bench = Bench(given_scenario())
        for what in (first, second, "oe", "bounds"):
            for part in bench.parts():
                if part[0] == what:
                    bench.give(part)
        e = bench.x[1:] - bench.x_hat["aoe"][1:]
        nees = np.einsum("kmi,kmij,kmj->km", e, np.linalg.inv(bench.P[1:]), e)
        np.testing.assert_allclose(bench.collector.estimators["aoe"].mean["nees"], nees.mean(axis=1), rtol=1e-10)
