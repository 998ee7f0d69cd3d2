"""A collector that goes on from the state of another one, and one that goes on without an estimator."""

from __future__ import annotations

from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from orchestrator.parts import Bench, Part, given_scenario
from testbed.errors import UsageError
from testbed.orchestrator import lane_windows
from testbed.orchestrator.collect import Collector

STEPS = 8
COST = {"Qx": [[1.0, 0.0], [0.0, 2.0]], "Ru": [[0.5]], "reference": [0.5, 0.0]}
VARIANTS: dict[str, dict[str, Any]] = {
    "blocks": {"lanes": 5},
    "one lane": {"lanes": 1},
    "without bounds": {"lanes": 3, "bounds": False},
}


def bench(variant: str, late: bool, **changes: Any) -> Bench:
    """Windows of three steps, so that most cuts fall into one."""
    own = VARIANTS[variant]
    with patch.object(lane_windows, "LANE_WINDOWS_MAX", 3 * own["lanes"]):
        made = given_scenario(**{"steps": STEPS, "cost": COST, **own, **changes})
        return Bench(made, late=("new", 5) if late else None)


def figures(collector: Collector) -> dict[str, Any]:
    """Everything that a summary and lanes.npz take from a collector."""
    lanes = collector.by_lane()
    assert collector.cost is not None
    series = {**collector.estimators, "bounds of all": collector.bounds, "cost": collector.cost.series}
    return {
        "completed": collector.completed,
        "applied": collector.applied,
        "largest": collector.largest_state,
        "series": {name: (s.mean, s.stderr, s.undefined) for name, s in series.items()},
        "total": collector.cost.total(),
        "ends": lanes.ends.tolist(),
        "lanes": {name: {f: a.tobytes() for f, a in of.items()} for name, of in lanes.figures.items()},
        "whole": {name: a.tobytes() for name, a in lanes.whole.items()},
    }


def give_all(made: Bench, order: list[Part]) -> None:
    """In an order in which the late estimator is expected before any part of its first step comes."""
    if made.late is None:
        early, rest = [], order
    else:
        name, first = made.late
        early, rest = [p for p in order if p[1] < first], [p for p in order if p[1] >= first]
        half = len(early) // 2
        early, rest = early[:half], early[half:] + rest
    for part in early:
        made.give(part)
    if made.late is not None:
        made.collector.expect(name, first, STEPS)
    for part in rest:
        made.give(part)


@pytest.mark.parametrize("late", [False, True], ids=["from the start", "one joins"])
@pytest.mark.parametrize("variant", VARIANTS)
@settings(deadline=None, max_examples=25)
@given(data=st.data())
def test_a_new_collector_goes_on_to_the_same_bits(data: st.DataObject, variant: str, late: bool) -> None:
    first, second = bench(variant, late), bench(variant, late)
    cuts = sorted(data.draw(st.sets(st.integers(1, STEPS))) | {s := data.draw(st.integers(1, STEPS))})
    kept: list[tuple[int, bytes]] = []
    states: dict[int, bytes] = {}

    def on_completed(step: int) -> None:
        assert step == first.collector.completed
        if step in cuts:
            kept.append((step, first.collector.figures(kept[-1][0] if kept else 0, step)))
            states[step] = first.collector.state()

    first.collector.on_completed = on_completed
    give_all(first, data.draw(st.permutations(first.parts())))
    assert first.collector.finished
    assert list(states) == cuts
    second.collector.resume(s, states[s], [part for _, part in kept])
    joined = late and "new" in second.collector.estimators
    assert figures(second.collector)["completed"] == s
    rest = [part for part in data.draw(st.permutations(second.parts())) if part[1] > s]
    if joined:
        second.late = None
    elif second.late is not None:
        assert s < second.late[1]
    give_all(second, rest)
    assert figures(second.collector) == figures(first.collector)


def test_each_completed_step_is_called_once_and_in_its_turn() -> None:
    """Also where one part completes several steps: what the collector has is that of the step that is called."""
    made, called = bench("blocks", late=False), []
    parts = made.parts()
    held = next(part for part in parts if part[0] == "truth" and part[1] == 1)
    in_turn = bench("blocks", late=False)
    expected: list[bytes] = []
    in_turn.collector.on_completed = lambda step: expected.append(in_turn.collector.state())
    made.collector.on_completed = lambda step: called.append((step, made.collector.state()))
    for part in sorted(parts, key=lambda part: part[1]):
        in_turn.give(part)
    for part in parts:
        if part != held:
            made.give(part)
    assert not called
    made.give(held)
    assert [step for step, _ in called] == list(range(1, STEPS + 1))
    assert [state for _, state in called] == expected


@pytest.mark.parametrize("variant", ["blocks", "one lane"])
@settings(deadline=None, max_examples=40)
@given(data=st.data())
def test_what_is_abandoned_ends_with_its_last_whole_step(data: st.DataObject, variant: str) -> None:
    """The figures up to there are as without it; nothing waits for it, and what is late is counted."""
    what = data.draw(st.sampled_from(["aoe", "oe", "bounds"]))
    made = bench(variant, late=False)
    order = data.draw(st.permutations(made.parts()))
    cut = data.draw(st.integers(0, len(order)))
    lanes = dict(made.setup.blocks)
    for part in order[:cut]:
        made.give(part)
    due = max(part[1] for part in order if part[0] == what)
    whole = 0
    while whole < due and all((what, whole + 1, lane) in order[:cut] for lane in lanes):
        whole += 1
    assert (made.collector.abandon_bounds() if what == "bounds" else made.collector.abandon(what)) == whole
    for part in order[cut:]:
        needed = {p for p in order if p[0] != what or p[1] <= whole}
        made.give(part)
        seen = set(order[: order.index(part) + 1])
        complete = 0
        while complete < STEPS and all(p in seen for p in needed if p[1] == complete + 1):
            complete += 1
        assert made.collector.completed == complete
    assert made.collector.finished
    word = "bounds" if what == "bounds" else f"estimate of {what}"
    assert made.collector.discarded == {word: sum(lanes[p[2]] for p in order if p[0] == what and p[1] > whole)}
    found, all_parts = figures(made.collector), bench(variant, late=False)
    for part in order:
        all_parts.give(part)
    expected = figures(all_parts.collector)
    for name, of in expected["series"].items():
        means, stderrs, _ = found["series"][name]
        last = whole if name in (what, f"{what} of all") else STEPS
        for values, own in ((of[0], means), (of[1], stderrs)):
            assert {k: v[:last] + [None] * (STEPS - last) for k, v in values.items()} == own
    ends = [end for end in expected["ends"] if end <= whole]
    for name, of in expected["lanes"].items():
        for figure, content in of.items():
            rows = len(ends) if name == what else len(expected["ends"])
            kept = np.frombuffer(content)[: rows * made.setup.scenario.lanes]
            assert found["lanes"][name][figure] == kept.tobytes()


def test_a_run_without_an_estimator_resumes_without_it() -> None:
    first, second = bench("blocks", late=False), bench("blocks", late=False)
    parts = sorted(first.parts(), key=lambda part: part[1])
    for part in parts:
        if part[1] <= 3:
            first.give(part)
    assert first.collector.abandon("aoe") == 3
    kept: list[tuple[bytes, bytes]] = []
    first.collector.on_completed = lambda step: kept.append((first.collector.state(), first.collector.figures(0, step)))
    for part in parts:
        if part[1] > 3:
            first.give(part)
    state, until = kept[1]
    second.collector.resume(5, state, [until])
    for part in parts:
        if part[1] > 5 and part[0] != "aoe":
            second.give(part)
    assert figures(second.collector) == figures(first.collector)


def test_figures_that_were_given_twice_count_once() -> None:
    """As after a run that was resumed at step 4 and ended again: the later ones count."""
    first, again, second = (bench("blocks", late=False) for _ in range(3))
    kept: dict[int, tuple[bytes, bytes]] = {}

    def keep(made: Bench, after: int) -> None:
        collector = made.collector
        collector.on_completed = lambda step: kept.update({step: (collector.state(), collector.figures(after, step))})

    keep(first, 0)
    for part in first.parts():
        first.give(part)
    state, whole = kept[4][0], kept[7][1]
    again.collector.resume(4, state, [whole])
    keep(again, 4)
    for part in again.parts():
        if part[1] > 4:
            again.give(part)
    state, later = kept[6]
    second.collector.resume(6, state, [whole, later])
    for part in second.parts():
        if part[1] > 6:
            second.give(part)
    assert figures(second.collector) == figures(first.collector)


def test_what_does_not_belong_to_the_run_is_refused() -> None:
    kept: list[tuple[bytes, bytes]] = []
    made = bench("blocks", late=False)
    made.collector.on_completed = lambda step: kept.append((made.collector.state(), made.collector.figures(1, step)))
    for part in made.parts():
        made.give(part)
    (early, _), (state, later) = kept[1], kept[4]
    whole = made.collector.figures(0, 5)
    cases: list[tuple[str, bytes, list[bytes], str]] = [
        ("blocks", state, [later], "no figures of the steps 1 … 1"),
        ("blocks", early, [whole], "not that after step 5"),
        ("blocks", state, [], "figures of 0 steps, expected 5"),
        ("blocks", state, [whole[:-1]], "digest"),
        ("without bounds", state, [whole], "not what a collector of this run gave"),
    ]
    for variant, given_state, given_figures, text in cases:
        with pytest.raises(UsageError, match=text):
            bench(variant, late=False).collector.resume(5, given_state, given_figures)
