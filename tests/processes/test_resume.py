"""The orchestrator is lost, or told to stop: `testbed resume` finishes the run to the same figures."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from processes.running import alive, children_of, finish, start, summary_of, wait_for, write_scenario
from processes.test_recovery import determined
from testbed.orchestrator.run import Run
from testbed.scenario import load_scenario

pytestmark = pytest.mark.processes


def resume(out: Path, *options: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "testbed", "resume", str(out), "-q", *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def cut(process: subprocess.Popen[str], out: Path, number: signal.Signals) -> tuple[int, str, str]:
    """The run is cut off once a checkpoint is on disk that there was not before, and all its roles have left."""
    before = set((out / "journal").glob("checkpoint-*.bin"))
    wait_for(lambda: set((out / "journal").glob("checkpoint-*.bin")) - before)
    children = children_of(process.pid)
    assert children
    process.send_signal(number)
    ended = finish(process)
    deadline = time.monotonic() + 10
    while any(alive(pid) for pid in children):
        assert time.monotonic() < deadline, "a role is left behind"
        time.sleep(0.05)
    return ended


def test_a_run_that_was_killed_and_then_interrupted_is_finished(tmp_path: Path) -> None:
    scenario = write_scenario(tmp_path, steps=2_000, lanes=2, head="[recovery]\nevery = 50")
    out, plain = tmp_path / "out", tmp_path / "plain"
    code, _, _ = cut(start(scenario, out, "-q"), out, signal.SIGKILL)
    assert code == -signal.SIGKILL
    assert not (out / "summary.json").exists()
    code, _, err = cut(resume(out), out, signal.SIGINT)
    assert code == 130
    assert err.startswith("resuming after step ")
    assert f"to finish it: testbed resume {out}" in err
    code, _, err = finish(resume(out, "--in-process"))
    assert code == 0, err
    Run(load_scenario(scenario), plain).in_process()
    assert determined(out) == determined(plain)
    with np.load(out / "lanes.npz") as first, np.load(plain / "lanes.npz") as second:
        assert all(first[name].tobytes() == second[name].tobytes() for name in (*first, *second))
    assert [entry["role"] for entry in summary_of(out)["recovered"]] == ["orchestrator", "orchestrator"]
    assert not (out / "journal").exists()
    assert not (out / "run.json").exists()
