"""Runs on the in-process bus for tests: scenarios, the run itself without its report, and its recording as arrays."""

from __future__ import annotations

import json
from collections import defaultdict
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from testbed.orchestrator.recording import read_recording
from testbed.orchestrator.run import Run
from testbed.orchestrator.summary import Summary
from testbed.scenario import Scenario, parse_scenario
from testbed.wire.memory_bus import MemoryNetwork

SYSTEM: dict[str, Any] = {
    "A": [[1.1, 0.2], [0.0, 0.7]],
    "B": [[1.0], [-0.5]],
    "C": [[1.0, 0.5]],
    "Q": [[0.5, 0.1], [0.1, 0.3]],
    "R": [[0.4]],
    "x0_mean": [1.0, -1.0],
    "P0": [[2.0, 0.3], [0.3, 1.0]],
}
BERNOULLI = {"kind": "bernoulli", "arrival": 0.7}
MARKOV = {"kind": "markov", "recovery": 0.7, "failure": 0.2}


def tables(**changes: Any) -> dict[str, Any]:
    """A scenario with every estimator, and ACKs over a lossy link; `changes` replace whole tables."""
    return {
        "name": "test",
        "steps": 20,
        "lanes": 6,
        "seed": 7,
        "record": "all",
        "system": SYSTEM,
        "input": {"kind": "sine", "amplitude": 4.0, "period": 7.0},
        "links": {
            "control": {"loss": BERNOULLI},
            "observation": {"loss": MARKOV},
            "ack": {"mode": "link", "loss": {"kind": "bernoulli", "arrival": 0.6}},
        },
        "estimators": [
            {"name": "aoe", "acks": "none"},
            {"name": "aoe-acks", "kind": "aoe"},
            {"name": "ff", "acks": "none"},
            {"name": "kfio", "acks": "perfect"},
            {"name": "oe", "acks": "none", "until": 7},
            {"name": "oe-acks", "kind": "oe", "until": 9},
        ],
        **changes,
    }


def scenario(**changes: Any) -> Scenario:
    return parse_scenario(tables(**changes))


def run(
    given: Scenario, out: Path, schedule: int | None = None, network: type[MemoryNetwork] = MemoryNetwork
) -> Summary:
    """The run in process; figures for the report are not drawn."""
    with (
        patch("testbed.orchestrator.report.write_report"),
        patch("testbed.orchestrator.run.MemoryNetwork", network),
    ):
        return Run(given, out).in_process(schedule)


def figures(summary: Summary) -> dict[str, Any]:
    """Everything in a summary that scenario and seed determine."""
    return summary.model_dump(exclude={"timing", "versions"})


Recorded = dict[str, dict[str, NDArray[Any]]]


def recorded(out: Path, lanes: int, steps: int) -> Recorded:
    """topic → array → values of shape (steps, lanes, …), steps in order; less what came late (see ``late_ones``).

    Zero where a link delivered nothing, as a packet that arrives in some lanes has it; NaN where nothing was published.
    """
    pieces: dict[tuple[str, str], list[tuple[int, int, NDArray[Any]]]] = defaultdict(list)
    for topic, packet, arrays in read_recording(out / "recording.mcap"):
        for name, array in arrays.items():
            if name.startswith("late_"):
                continue
            pieces[topic, name].append((packet.step - packet.FIRST_STEP, packet.lane, array))
    result: Recorded = defaultdict(dict)
    for (topic, name), parts in pieces.items():
        blank = 0.0 if topic.endswith("/delivered") else np.nan
        whole = np.full((steps, lanes, *parts[0][2].shape[1:]), blank)
        for step, lane, array in parts:
            whole[step, lane : lane + len(array)] = array
        result[topic][name] = whole
    return dict(result)


def late_ones(out: Path, topic: str, content: str) -> list[tuple[int, int, int, Any]]:
    """(step in which it came, step that it belongs to, lane, content) of what came late, sorted by the first three."""
    found = []
    for name, packet, arrays in read_recording(out / "recording.mcap"):
        if name == topic and "late_step" in arrays:
            for row, place in np.argwhere(arrays["late_mask"]):
                of = int(arrays["late_step"][row, place])
                found.append((packet.step, of, packet.lane + int(row), arrays[f"late_{content}"][row, place].tolist()))
    return sorted(found, key=lambda one: one[:3])


def written(out: Path) -> dict[str, Any]:
    """summary.json as any JSON reader sees it."""
    return dict(json.loads((out / "summary.json").read_text()))
