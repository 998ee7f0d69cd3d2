"""Runs that a script steers while they go."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from orchestrator.runs import SYSTEM, figures, recorded, run, scenario, written
from testbed import RunFailed, Scenario, UsageError
from testbed.orchestrator.live import LiveRun
from testbed.orchestrator.summary import Summary

STEPS, LANES = 20, 6
SPECS = [{"name": "aoe", "acks": "none"}, {"name": "ff", "acks": "none"}]
Event = dict[str, Any]


@pytest.fixture(autouse=True)
def _without_report() -> Iterator[None]:
    with patch("testbed.orchestrator.report.write_report"):
        yield


def start(folder: Path, **changes: Any) -> LiveRun:
    return scenario(estimators=SPECS, **changes).start(folder, in_process=True)


def determined(summary: Summary) -> dict[str, Any]:
    """Everything but who ordered what."""
    found = figures(summary)
    events = [{k: v for k, v in event.items() if k not in ("by", "number")} for event in found.pop("events")]
    return {**found, "events": sorted(events, key=lambda event: json.dumps(event, sort_keys=True))}


def assert_same(one: Path, other: Path) -> None:
    before, after = recorded(one, LANES, STEPS), recorded(other, LANES, STEPS)
    assert before.keys() == after.keys()
    for topic, arrays in before.items():
        for name, values in arrays.items():
            np.testing.assert_array_equal(values, after[topic][name], err_msg=f"{topic} {name}")


def fail(step: int) -> None:
    raise ZeroDivisionError(step)


def order(actions: Any, event: Event) -> Any:
    return actions.do(event["action"], **{k: v for k, v in event.items() if k not in ("action", "at", "when")})


EVENTS = st.sampled_from(
    [
        {"action": "set", "link": "control", "set": {"loss": {"arrival": 0.3}}},
        {"action": "set", "link": "observation", "set": {"loss": "none"}},
        {"action": "swap", "estimator": "ff", "to": {"kind": "aoe", "acks": "none"}},
        {"action": "swap", "estimator": "ff", "to": {"kind": "gpb", "order": 2, "acks": "none"}, "handover": "cold"},
        {"action": "plant", "A": [[1.0, 0.1], [0.0, 0.9]]},
        {"action": "input", "input": {"kind": "constant", "value": [1.5]}},
        {"action": "mark", "name": "here"},
        {"action": "acks", "acks": "link", "estimator": "aoe"},
    ]
)


@settings(max_examples=6, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(events=st.lists(st.tuples(st.integers(1, STEPS), EVENTS), min_size=1, max_size=3, unique_by=lambda e: e[0]))
def test_what_a_script_orders_is_as_in_the_scenario_to_the_bit(
    events: list[tuple[int, Event]], tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("run")
    table = [{**event, "at": step} for step, event in events]
    expected = run(scenario(estimators=SPECS, events=table, bounds=False), folder / "table")
    with start(folder / "beforehand", bounds=False) as beforehand:
        for step, event in sorted(events, key=lambda entry: entry[0]):
            order(beforehand.at(step), event)
    with start(folder / "now", bounds=False) as now:
        for step, event in sorted(events, key=lambda entry: entry[0]):
            now.until(step - 1)
            assert order(now, event).result().step == step
    for name, live in (("beforehand", beforehand), ("now", now)):
        assert live.summary is not None
        assert determined(live.summary) == determined(expected)
        assert_same(folder / "table", folder / name)


def test_conditions_are_as_in_the_scenario_to_the_bit(tmp_path: Path) -> None:
    condition, swap = "trace_P(ff) > 1 for 3 steps", {"estimator": "ff", "to": {"kind": "aoe", "acks": "none"}}
    table = [{"when": condition, "action": "swap", **swap}]
    expected = run(scenario(estimators=SPECS, events=table), tmp_path / "table")
    with start(tmp_path / "script") as live:
        found = live.when(condition).swap(**swap).result()
        assert live.completed >= found.step - 1
    assert (found.ok, found.by, found.true_at) == (True, "condition", found.step - 1)
    assert live.summary is not None
    assert determined(live.summary) == determined(expected)
    assert_same(tmp_path / "table", tmp_path / "script")


def test_the_clock_is_held_where_the_script_waits(tmp_path: Path) -> None:
    with start(tmp_path, links={}) as live:
        assert (live.status()["status"], live.completed, live.figures) == ("held", 0, {})
        shown = live.until(5)
        assert (shown.step, live.completed, live.status()["granted"], live.status()["held"]) == (5, 5, 5, 5)
        assert live.until("80 ms").step == 8
        assert live.figures == live.until(8)
        summary = live.wait()
        assert (live.status()["status"], live.over) == ("complete", True)
        assert live.until(20) == live.figures
    for name in ("aoe", "ff"):
        whole = summary.estimators[name]
        assert shown[name].trace_P == whole.trace_P_mean[4]
        assert shown[name].squared_error == whole.squared_error_mean[4]
        assert shown[name].nees == whole.nees_mean[4]
        assert shown[name].excess == whole.excess_mean[4]


@pytest.mark.parametrize("held", [True, False])
def test_a_loop_over_the_steps_has_the_figures_of_each(held: bool, tmp_path: Path) -> None:
    with start(tmp_path) as live:
        live.until(3)
        live.at(10).remove("ff")
        seen = []
        for k, found in live.steps(held=held):
            seen.append((k, found["aoe"].trace_P, "ff" in found))
            if held and k < STEPS:
                assert live.status()["granted"] == k
        summary = live.wait()
    means = summary.estimators["aoe"].trace_P_mean
    assert seen == [(k, means[k - 1], k < 10) for k in range(4, STEPS + 1)]


def test_what_is_decided_by_figures_holds_from_the_next_step_on(tmp_path: Path) -> None:
    with start(tmp_path) as live:
        for _, found in live.steps():
            if (found["ff"].trace_P or 0.0) > 1.0:
                ordered = live.swap("ff", to={"kind": "aoe", "acks": "none"}, handover="moments")
                break
        summary = live.wait()
    means = summary.estimators["ff"].trace_P_mean
    k = ordered.result().step - 1
    assert k == next(i for i, mean in enumerate(means, 1) if mean is not None and mean > 1.0)
    assert [(e.step, e.action, e.ok) for e in summary.events] == [(k + 1, "swap", True)]


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        (lambda live: live.swap("fff", to={"kind": "aoe"}), "fff"),
        (lambda live: live.swap("ff", to={"kind": "ao"}), "did you mean 'aoe'"),
        (lambda live: live.swap("ff", to={"kind": "gpb"}, handover="full"), "do not share the state"),
        (lambda live: live.at(5).mark("late"), "7 or later"),
        (lambda live: live.at(21).mark("late"), "at most 20"),
        (lambda live: live.at("5 parsecs").mark("far"), "duration with a unit"),
        (lambda live: live.at(2.5).mark("between"), "got 2.5"),
        (lambda live: live.until(3), "6 or later"),
        (lambda live: live.until(21), "at most 20"),
        (lambda live: live.when("trace_P(fff) > 1").mark("never"), "fff"),
        (lambda live: live.set("obs", loss="none"), "did you mean 'observation'"),
        (lambda live: live.set("control"), "keys of the link"),
        (lambda live: live.do("swop"), "did you mean 'swap'"),
        (lambda live: live.kill("plnt"), "did you mean 'plant'"),
        (lambda live: live.figures["fff"], "did you mean 'ff'"),
    ],
)
def test_wrong_input_is_refused_at_once_in_one_line(wrong: Callable[[LiveRun], Any], text: str, tmp_path: Path) -> None:
    with start(tmp_path) as live:
        live.until(6)
        with pytest.raises(UsageError, match=text) as refused:
            wrong(live)
        assert "\n" not in str(refused.value)
    assert live.summary is not None
    assert (live.summary.status, live.summary.events) == ("complete", ())
    with pytest.raises(UsageError, match="the run is over"):
        live.mark("late")


def test_what_was_not_done_is_raised_by_its_result(tmp_path: Path) -> None:
    with start(tmp_path) as live:
        live.at(4).remove("ff")
        killed = live.at(8).kill("estimator.ff")
        with pytest.raises(RunFailed, match="'ff' does not run"):
            killed.result()
        assert live.completed == 7
        never = live.when("trace_P(ff) > 1e9").mark("never")
        with pytest.raises(RunFailed, match="did not begin to hold"):
            never.result()
        assert live.over


def test_the_death_of_a_process_that_nobody_starts_anew_fails_the_run(tmp_path: Path) -> None:
    with start(tmp_path, recovery={"policy": "fail"}) as live:
        assert live.at(6).kill("plant").result().step == 6
        with pytest.raises(RunFailed, match="plant is gone"):
            live.until(6)
        assert live.completed == 5


def test_an_exception_ends_the_run_and_keeps_what_was_collected(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), start(tmp_path) as live:
        fail(live.until(7).step)
    assert live.summary is not None
    kept = written(tmp_path)
    assert (kept["status"], kept["completed_steps"]) == ("interrupted", 7)
    assert "ZeroDivisionError" in kept["reason"]
    assert not [thread for thread in threading.enumerate() if thread.name == "testbed run"]


def test_a_run_that_fails_says_why_whatever_waits_for_it(tmp_path: Path) -> None:
    system = {"A": [[1e100]], "C": [[1.0]], "Q": [[1.0]], "R": [[1.0]]}
    lost = {"observation": {"loss": {"kind": "bernoulli", "arrival": 0.0}}}
    few = Scenario(steps=STEPS, system=system, links=lost, estimators=[{"name": "kfio"}])
    waits: list[Callable[[LiveRun], Any]] = [
        lambda live: live.until(STEPS),
        lambda live: list(live.steps()),
        lambda live: list(live.steps(held=False)),
        lambda live: live.wait(),
    ]
    for i, wait in enumerate(waits):
        with (
            pytest.raises(RunFailed, match="left the range"),
            few.start(tmp_path / str(i), in_process=True) as live,
        ):
            wait(live)
    with few.start(tmp_path / "unchecked", in_process=True) as live:
        summary = live.wait(check=False)
    assert summary.status == "failed"
    with pytest.raises(RunFailed, match="left the range"), few.start(tmp_path / "leaving", in_process=True):
        pass


def test_a_script_may_stop_its_run(tmp_path: Path) -> None:
    with start(tmp_path) as live:
        live.until(4)
        summary = live.stop()
        assert live.wait() == summary == live.stop()
    assert (summary.status, summary.completed_steps, summary.reason) == ("interrupted", 4, "stopped by the script")


def test_what_cannot_run_does_not_start(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no \\[\\[estimators\\]\\]"):
        Scenario(system=SYSTEM).start(tmp_path, in_process=True)
    assert not [thread for thread in threading.enumerate() if thread.name == "testbed run"]


def test_runs_without_a_folder_have_one_each(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    folders = set()
    for _ in range(3):
        with Scenario(name="a b", steps=2, system=SYSTEM, estimators=[{"name": "ff"}]).start(in_process=True) as live:
            folders.add(live.out)
    assert len(folders) == 3
    assert all(folder.parent == Path("runs") and folder.name.startswith("a-b-") for folder in folders)


def test_real_time_begins_when_the_script_lets_it(tmp_path: Path) -> None:
    clock = {"mode": "real", "period": "5 ms"}
    events = [{"at": 9, "action": "set", "link": "control", "set": {"loss": "none"}}]
    run(scenario(estimators=SPECS, clock=clock, events=events), tmp_path / "table")
    with start(tmp_path / "script", clock=clock) as live:
        live.at(9).set("control", loss="none")
        with pytest.raises(UsageError, match="clock mode 'real'"):
            live.snapshot("ff")
        time.sleep(0.05)
        assert (live.completed, live.status()["status"]) == (0, "held")
        assert live.until(3).step == 3
        summary = live.wait()
    assert [(e.step, e.action) for e in summary.events] == [(9, "set")]
    sent, other = (recorded(tmp_path / name, LANES, STEPS)["control/delivered"] for name in ("table", "script"))
    np.testing.assert_array_equal(sent["mask"], other["mask"])


def test_a_script_that_ends_without_waiting_ends_its_run(tmp_path: Path) -> None:
    code = f"""
from testbed import Scenario
run = Scenario(steps=50, system={SYSTEM!r}, estimators=[{{"name": "ff"}}]).start({str(tmp_path)!r}, in_process=True)
run.until(3)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
    assert (written(tmp_path)["status"], written(tmp_path)["reason"]) == ("interrupted", "the script ended")
