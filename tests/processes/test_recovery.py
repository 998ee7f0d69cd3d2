"""Processes that are killed or stopped while a run goes: the figures are those of a run without that."""

from __future__ import annotations

import os
import random
import signal
import time
from pathlib import Path
from typing import Any

import pytest

from processes.running import (
    alive,
    children_of,
    client,
    finish,
    free_port,
    start,
    summary_of,
    wait_for_step,
    write_scenario,
)
from testbed.orchestrator.run import Run
from testbed.scenario import load_scenario

pytestmark = pytest.mark.processes

EVENTS_OF_RECOVERY = {"timing", "recovered", "repeated", "rejected", "versions"}
LOOP = """
[[estimators]]
name = "aoe"
[input]
kind = "lqg"
Qx = [[1.0, 0.0], [0.0, 1.0]]
Ru = [[0.5]]
"""


def determined(out: Path) -> dict[str, Any]:
    return {key: value for key, value in summary_of(out).items() if key not in EVENTS_OF_RECOVERY}


def struck(tmp_path: Path, victims: list[str], number: signal.Signals, *, steps: int, head: str = "") -> dict[str, Any]:
    """The summary of a run whose processes get a signal, one after the other, as soon as the one before is back."""
    port = free_port()
    head = f'[transport]\nendpoint = "tcp/127.0.0.1:{port}"\n[recovery]\nevery = 60\n{head}'
    scenario = write_scenario(tmp_path, steps=steps, lanes=2, head=head)
    process = start(scenario, tmp_path / "out")
    draw = random.Random(3)
    with client(port) as session:
        wait_for_step(session, 200)
        children = children_of(process.pid)
        for victim in victims:
            (pid,) = [pid for pid, command in children.items() if victim in command]
            os.kill(pid, number)
            time.sleep(0.8 + draw.random())
    code, _, err = finish(process)
    assert code == 0, err
    assert not any(alive(pid) for pid in children)
    Run(load_scenario(scenario), tmp_path / "plain").in_process()
    assert determined(tmp_path / "out") == determined(tmp_path / "plain")
    return summary_of(tmp_path / "out")


def test_killed_processes_change_nothing(tmp_path: Path) -> None:
    victims = ["testbed.plant", "--name aoe", "--link control", "testbed.control", "--link observation"]
    summary = struck(tmp_path, victims, signal.SIGKILL, steps=6_000)
    assert [entry["role"] for entry in summary["recovered"]] == [
        "plant",
        "estimator.aoe",
        "link.control",
        "controller",
        "link.observation",
    ]
    for entry in summary["recovered"]:
        assert entry["how"] == "ended: killed by SIGKILL"
        assert entry["begin"] % 60 == 0
        assert entry["begin"] <= entry["step"]
        assert entry["down_ms"] > 0


def test_a_process_that_hangs_is_replaced(tmp_path: Path) -> None:
    summary = struck(tmp_path, ["--name kfio"], signal.SIGSTOP, steps=3_000, head='patience = "1500 ms"')
    (entry,) = summary["recovered"]
    assert entry["role"] == "estimator.kfio"
    assert entry["how"] == "gave no sign of life for 1.5 s"
