"""Runs over processes in which much happens: no estimate is missing, none is there twice, and none has another bit."""

from __future__ import annotations

import tomllib
from collections import Counter
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest

from orchestrator.runs import recorded, run
from processes.running import summary_of
from testbed.orchestrator.recording import read_recording
from testbed.orchestrator.run import Run
from testbed.scenario import Scenario

pytestmark = pytest.mark.processes

EXAMPLE = Path(__file__).parents[2] / "scenarios" / "timeline.toml"
Table = dict[str, Any]
DETERMINED = {"estimators", "links", "bounds", "cost", "controller", "status", "completed_steps"}


def example(steps: int = 2000, **changed: Any) -> Table:
    """The example; in a shorter one the processes are lost when all swaps are made."""
    given: Table = {**tomllib.loads(EXAMPLE.read_text()), **changed, "steps": steps}
    if steps != 2000:
        for place, event in enumerate(given["events"]):
            event["at"] = {"kill": steps // 2, "restart": 2 * steps // 3}.get(event["action"], 20 + 15 * place)
    return given


def virtual(given: Table) -> Table:
    return {key: value for key, value in given.items() if key != "clock"}


def undisturbed(given: Table) -> Table:
    """Nobody is lost."""
    events = [event for event in given["events"] if event["action"] not in ("kill", "restart")]
    return {key: value for key, value in given.items() if key != "recovery"} | {"events": events}


def as_it_was(given: Table, summary: Table) -> Table:
    """Its events at the steps at which they took effect."""
    steps = {event["number"]: event["step"] for event in summary["events"]}
    return given | {"events": [{**event, "at": steps[n]} for n, event in enumerate(given["events"])]}


def over_processes(given: Table, out: Path) -> Table:
    with patch("testbed.orchestrator.report.write_report"):
        Run(Scenario.model_validate(given), out).over_zenoh()
    return summary_of(out)


def in_process(given: Table, out: Path) -> Table:
    run(Scenario.model_validate(given), out)
    return summary_of(out)


def check_every_step(out: Path, given: Table, summary: Table) -> None:
    """One estimate of each name, step and lane where it runs, in the recording and in the figures."""
    steps, lanes = given["steps"], given["lanes"]
    assert (summary["status"], summary["completed_steps"], summary["rejected"]) == ("complete", steps, {})
    found: Counter[tuple[str, int, int]] = Counter()
    for topic, packet, _ in read_recording(out / "recording.mcap"):
        if topic.startswith("estimate/"):
            found.update((topic.removeprefix("estimate/"), packet.step, packet.lane + i) for i in range(packet.lanes))
    shadow, promoted = (e["step"] for e in summary["events"] if "candidate" in (e["name"], e["to"]))
    runs = {"active": (1, steps), "twin": (1, steps), "kfio": (1, steps), "candidate": (shadow, promoted - 1)}
    steps_of = {name: range(first, last + 1) for name, (first, last) in runs.items()}
    assert found == {(name, k, lane): 1 for name, ks in steps_of.items() for k in ks for lane in range(lanes)}
    for name, (first, last) in runs.items():
        there = [value is not None for value in summary["estimators"][name]["trace_P_mean"]]
        assert there == [first <= k <= last for k in range(1, steps + 1)]


def check_same(one: tuple[Path, Table], other: tuple[Path, Table], given: Table) -> None:
    """To the last bit: figures, lanes, and every packet that was recorded."""
    for key in DETERMINED:
        assert one[1][key] == other[1][key], key
    assert (one[0] / "lanes.npz").read_bytes() == (other[0] / "lanes.npz").read_bytes()
    packets = [recorded(out, given["lanes"], given["steps"]) for out, _ in (one, other)]
    assert packets[0].keys() == packets[1].keys()
    for topic, arrays in packets[0].items():
        for name, values in arrays.items():
            assert values.tobytes() == packets[1][topic][name].tobytes(), (topic, name)


def check_events(given: Table, summary: Table) -> None:
    """All were done, at their steps; in real time a swap may come later, which is then said."""
    asked = [event["at"] for event in given["events"]]
    happened = sorted(summary["events"], key=lambda event: event["number"])
    assert [(event["action"], event["ok"]) for event in happened] == [(e["action"], True) for e in given["events"]]
    assert [event["step"] if event["due"] is None else event["due"] for event in happened] == asked
    assert all(event["due"] is None or ("clock" in given and event["step"] > event["due"]) for event in happened)
    lost = [(entry["role"].split(".")[:2], entry["policy"]) for entry in summary["recovered"]]
    assert lost == [(["estimator", "active"], "restart"), (["plant"], "restart")]
    assert all(down["steps"] == 0 for down in summary["timing"]["swaps"])


def test_virtual_time(tmp_path: Path) -> None:
    given = virtual(example())
    summary = over_processes(given, tmp_path / "lost")
    check_events(given, summary)
    check_every_step(tmp_path / "lost", given, summary)
    plain = in_process(undisturbed(given), tmp_path / "plain")
    check_same((tmp_path / "lost", summary), (tmp_path / "plain", plain), given)


@pytest.mark.parametrize("steps", [300, pytest.param(2000, marks=pytest.mark.slow)])
def test_real_time(steps: int, tmp_path: Path) -> None:
    given = example(steps)
    summary = over_processes(given, tmp_path / "real")
    check_events(given, summary)
    check_every_step(tmp_path / "real", given, summary)
    plain = in_process(undisturbed(virtual(as_it_was(given, summary))), tmp_path / "plain")
    check_same((tmp_path / "real", summary), (tmp_path / "plain", plain), given)
