"""Estimators that change while a run over zenoh keeps real time; nothing is said of how fast anything is."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from pathlib import Path
from typing import Any

import pytest

from processes.running import figures_of, finish, start, summary_of, wait_for, write_scenario
from processes.test_swaps import TWO, event, once_each, processes_of
from testbed.cli.main import run_command
from testbed.orchestrator.run import Run
from testbed.orchestrator.running import ask
from testbed.scenario import load_scenario

pytestmark = pytest.mark.processes

REAL = 'record = "all"\nclock = { mode = "real", period = "10 ms" }'
LIKE = '{ kind = "aoe" }'
CHANGES = (
    event(20, "swap", estimator='"aoe"', to=LIKE, handover='"full"')
    + event(40, "shadow", estimator='"aoe"', name='"next"', to='{ kind = "gpb", order = 2 }')
    + event(60, "swap", estimator='"aoe"', to=LIKE, handover='"moments"')
    + event(90, "swap", estimator='"aoe"', to='{ kind = "imm" }', handover='"cold"')
    + event(110, "remove", estimator='"twin"')
    + event(130, "swap", estimator='"aoe"', to='"next"')
)


def test_changes_of_each_kind_are_as_in_virtual_time(tmp_path: Path) -> None:
    """Links are modelled, so that no estimate depends on the wall clock."""
    split = f"{REAL}\ntransport = {{ lanes_per_packet = 2 }}"
    process = start(write_scenario(tmp_path, steps=200, lanes=3, head=split, tail=TWO + CHANGES), tmp_path / "out")
    code, _, err = finish(process)
    assert code == 0, err
    summary = summary_of(tmp_path / "out")
    assert [e["ok"] for e in summary["events"]] == [True] * 6
    assert summary["rejected"] == {}
    assert once_each(tmp_path / "out", "aoe", 200, 3)
    steps = [e["step"] for e in summary["events"]]
    assert all(step >= planned for step, planned in zip(steps, (20, 40, 60, 90, 110, 130), strict=True))
    again = CHANGES
    for step, planned in zip(steps, (20, 40, 60, 90, 110, 130), strict=True):  # later, where the machine was too busy
        again = again.replace(f"at = {planned}\n", f"at = {step}\n")
    (tmp_path / "virtual").mkdir()
    there = write_scenario(tmp_path / "virtual", steps=200, lanes=3, tail=TWO + again)
    Run(load_scenario(there), tmp_path / "virtual" / "out").in_process()
    assert figures_of(tmp_path / "out") == figures_of(tmp_path / "virtual" / "out")
    downs = summary["timing"]["swaps"]
    assert [(down["steps"], down["ms"]) for down in downs] == [(0, 0.0)] * 5
    published = summary["realtime"]["stages"]["estimate/aoe"]["published_us"]
    for down in downs:
        if down["step"] != steps[1]:  # the shadow's are elsewhere
            assert down["late_ms"] == pytest.approx(max(published[down["step"] - 1 : down["step"] + 9]) / 1e3)


def going(tmp_path: Path, steps: int, tail: str = "") -> subprocess.Popen[str]:
    out = tmp_path / "out"
    process = start(write_scenario(tmp_path, steps=steps, head=REAL, tail=TWO + tail), out)
    wait_for(lambda: (out / "run.json").exists())
    wait_for(lambda: ask(out, {"do": "status"})["completed"] > 10)
    return process


@pytest.mark.parametrize("sent", [pytest.param(signal.SIGKILL, marks=pytest.mark.slow), signal.SIGSTOP])
def test_a_new_service_that_fails_leaves_the_old_one_in_charge(sent: signal.Signals, tmp_path: Path) -> None:
    """One that is killed, and one that hangs: it joins, and does not take what it is handed."""
    process = going(tmp_path, 500, event(150, "swap", estimator='"aoe"', to='{ kind = "imm" }'))
    os.kill(wait_for(lambda: processes_of(process.pid, "estimator.aoe.2"))[0], sent)
    code, _, err = finish(process)
    assert code == 0, err
    summary = summary_of(tmp_path / "out")
    (refusal,) = summary["events"]
    assert (refusal["ok"], refusal.get("bytes")) == (False, None)
    assert "estimator.aoe.2" in refusal["reason"]
    assert once_each(tmp_path / "out", "aoe", 500, 1)
    own, twin = (summary["estimators"][name]["squared_error_mean"] for name in ("aoe", "twin"))
    assert own == twin
    assert summary["rejected"] == {}


@pytest.mark.slow
def test_by_command(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out, process = tmp_path / "out", going(tmp_path, 20_000)
    assert run_command(["ctl", str(out), "swap", "aoe", "--to", "aoe", "--handover", "full"]) == 0
    assert run_command(["ctl", str(out), "shadow", "aoe", "next", "--to", "aoe", "--handover", "full"]) == 0
    assert run_command(["ctl", str(out), "swap", "aoe", "--promote", "next"]) == 0
    assert run_command(["ctl", str(out), "status", "--json"]) == 0
    assert run_command(["ctl", str(out), "stop"]) == 0
    finish(process)
    lines = capfd.readouterr().out.splitlines()
    status: dict[str, Any] = next(json.loads(line) for line in lines if line.startswith("{"))
    assert status["estimators"]["aoe"]["role"] == "estimator.next"
    summary = summary_of(out)
    assert [int(line.split()[-2]) for line in lines[:3]] == [e["step"] for e in summary["events"]]
    assert [e["ok"] for e in summary["events"]] == [True] * 3
    own, twin = (summary["estimators"][name]["squared_error_mean"] for name in ("aoe", "twin"))
    assert own == twin
    assert once_each(out, "aoe", summary["completed_steps"], 1)
