"""A script that steers a run over zenoh: the same bits as in process, and no process is left behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from orchestrator.runs import figures, scenario
from processes.running import alive, children_of, summary_of, wait_for
from testbed.orchestrator.live import LiveRun
from testbed.orchestrator.summary import Summary

pytestmark = pytest.mark.processes

SPECS = [{"name": "aoe", "acks": "none"}, {"name": "ff", "acks": "none"}]


def steer(live: LiveRun) -> Summary:
    with live as run:
        run.at(4).swap("ff", to={"kind": "gpb", "order": 2, "acks": "none"}, handover="cold")
        run.when("trace_P(aoe) > 1 for 2 steps").mark("large")
        found = run.until(9)
        run.set("control", loss={"arrival": 0.2 if (found["aoe"].trace_P or 0.0) > 0.1 else 0.9})
        assert run.swap("aoe", to={"kind": "aoe", "acks": "none"}, handover="full").result().step == 10
        for k, _ in run.steps():
            if k == 12:
                break
        run.plant(A=[[1.0, 0.1], [0.0, 0.9]])
        return run.wait()


def determined(summary: Summary) -> dict[str, Any]:
    return figures(summary)


def test_a_script_gets_the_same_bits_as_in_process(tmp_path: Path) -> None:
    given = scenario(estimators=SPECS)
    over_zenoh = steer(given.start(tmp_path / "zenoh"))
    in_process = steer(given.start(tmp_path / "in-process", in_process=True))
    assert over_zenoh.status == "complete"
    assert [(e.step, e.action) for e in over_zenoh.events if e.action != "mark"] == [
        (4, "swap"),
        (10, "set"),
        (10, "swap"),
        (13, "plant"),
    ]
    assert determined(over_zenoh) == determined(in_process)
    assert not [command for command in children_of(os.getpid()).values() if "--supervised" in command]


SCRIPT = """
import sys, time
from testbed import load_scenario
with load_scenario(sys.argv[1]).start(sys.argv[2]) as run:
    run.until(20)
    print("there", flush=True)
    {then}
"""


@pytest.mark.parametrize("then", ["run.until(100_000)", "time.sleep(100)"])
def test_ctrl_c_in_a_script_stops_the_run_and_leaves_no_process(then: str, tmp_path: Path) -> None:
    from testbed.scenario import to_toml

    (tmp_path / "scenario.toml").write_text(to_toml(scenario(estimators=SPECS, steps=100_000, record="none")))
    command = [sys.executable, "-c", SCRIPT.format(then=then), str(tmp_path / "scenario.toml"), str(tmp_path / "out")]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "there\n"
    roles = wait_for(lambda: children_of(process.pid))
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == -signal.SIGINT, err
    assert err.rstrip().endswith("KeyboardInterrupt")
    assert not [pid for pid in roles if alive(pid)]
    summary = summary_of(tmp_path / "out")
    assert (summary["status"], summary["reason"]) == ("interrupted", "stopped: the script raised KeyboardInterrupt")
    assert summary["completed_steps"] >= 20


def test_a_script_kills_processes_and_the_figures_stay(tmp_path: Path) -> None:
    given = scenario(estimators=SPECS, recovery={"policy": "restart", "every": 5})
    with given.start(tmp_path / "killed") as run:
        run.until(8)
        assert run.kill("estimator.ff").result().step == 9
        assert run.at(14).kill("plant").result().step == 14
        killed = run.wait()
    plain = given.start(tmp_path / "plain", in_process=True).wait()
    assert (killed.status, killed.completed_steps) == ("complete", 20)
    assert killed.estimators == plain.estimators
    assert killed.bounds == plain.bounds
