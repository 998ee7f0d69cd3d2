"""Runs in real time over real processes: what follows from the definition, and nothing of how fast anything is."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
from pathlib import Path
from typing import Any

import pytest

from processes.running import (
    children_of,
    client,
    figures_of,
    finish,
    free_port,
    start,
    summary_of,
    wait_for,
    wait_for_step,
    write_scenario,
)
from testbed.orchestrator.run import Run
from testbed.scenario import load_scenario
from testbed.wire.bundle import unbundle

pytestmark = pytest.mark.processes

Started = tuple[subprocess.Popen[str], dict[int, str], str, int]


def going(tmp_path: Path, clock: str, steps: int, tail: str = "") -> Started:
    """A run in real time that is past a step: the process, its children, its key prefix, its port."""
    port = free_port()
    head = f'clock = {{ mode = "real", {clock} }}\n[transport]\nendpoint = "tcp/127.0.0.1:{port}"\n{tail}'
    process = start(write_scenario(tmp_path, steps=steps, head=head), tmp_path / "out")
    with client(port) as session:
        prefix = wait_for_step(session, 5)
    return process, children_of(process.pid), prefix, port


def stop(children: dict[int, str]) -> int:
    """Stop the process of estimator aoe; its id."""
    (victim,) = [pid for pid, command in children.items() if "--name aoe" in command]
    os.kill(victim, signal.SIGSTOP)
    return victim


def virtual_figures(tmp_path: Path, steps: int) -> dict[str, Any]:
    (tmp_path / "virtual").mkdir()
    scenario = write_scenario(tmp_path / "virtual", steps=steps)
    Run(load_scenario(scenario), tmp_path / "virtual" / "out").in_process()
    return figures_of(tmp_path / "virtual" / "out")


def test_a_stopped_estimator_is_late_and_holds_up_nobody(tmp_path: Path) -> None:
    steps = 600
    process, children, prefix, port = going(tmp_path, 'period = "5 ms"', steps)
    victim = stop(children)
    try:
        with client(port) as session:
            seen: dict[str, int] = {}

            def note(sample: Any) -> None:
                key = str(sample.key_expr).removeprefix(f"{prefix}/")
                seen[key] = seen.get(key, 0) + len(unbundle(sample.payload.to_bytes()))

            session.declare_subscriber(f"{prefix}/**", note)
            wait_for(lambda: seen.get("control/sent"))
            seen.pop("estimate/aoe", None)  # what was on its way
            wait_for(lambda: min(seen.get(key, 0) for key in ("control/sent", "estimate/kfio", "truth")) >= 50)
            assert "estimate/aoe" not in seen
    finally:
        os.kill(victim, signal.SIGCONT)
    code, _, err = finish(process)
    assert code == 0, err
    summary = summary_of(tmp_path / "out")
    assert figures_of(tmp_path / "out") == virtual_figures(tmp_path, steps)
    stages = summary["realtime"]["stages"]
    late = stages["estimate/aoe"]
    # at least 50 steps were due while it was stopped; the last of them may have been in time
    assert late["missed"] >= 48
    assert late["published"]["max"] >= 48 * 5000
    for stage in stages.values():
        assert len(stage["published_us"]) == steps
        assert stage["absent"] == 0
        assert None not in stage["published_us"]
        # a microsecond for the resolution of the two clocks
        assert min(stage["published_us"]) >= -1.0
        assert stage["hop"]["p50"] > -1.0
        assert stage["arrived"]["max"] > stage["published"]["p50"]
    assert summary["realtime"]["outstanding_max"] >= 45


def test_strict_ends_the_run_with_the_role_and_the_step(tmp_path: Path) -> None:
    process, children, _, _ = going(tmp_path, 'period = "20 ms", deadline = "2 s", deadlines = "strict"', 5000)
    stop(children)
    code, _, err = finish(process)
    assert code == 1
    reason = summary_of(tmp_path / "out")["reason"]
    assert reason.startswith("estimator.aoe missed the deadline of step ")
    assert reason.endswith(" ms after it")
    assert ": no estimate " in reason
    assert reason in err


def test_too_many_steps_behind_end_the_run(tmp_path: Path) -> None:
    process, children, _, _ = going(tmp_path, 'period = "20 ms", window = 60', 5000)
    stop(children)
    code, _, err = finish(process)
    assert code == 1
    summary = summary_of(tmp_path / "out")
    assert "steps are not complete, allowed: 60 (clock.window); waiting for step " in summary["reason"]
    assert summary["reason"].endswith("estimate of aoe")
    assert summary["reason"] in err
    assert len(summary["realtime"]["stages"]["control/sent"]["published_us"]) == summary["completed_steps"]


def test_an_estimator_that_somebody_starts_takes_part_and_does_not_hold_the_clock(tmp_path: Path) -> None:
    steps, port = 300, free_port()
    head = f'clock = {{ mode = "real", period = "10 ms" }}\n[transport]\nendpoint = "tcp/127.0.0.1:{port}"'
    process = start(write_scenario(tmp_path, steps=steps, head=head), tmp_path / "out", "--external", "estimator.aoe")
    assert process.stderr is not None
    line = process.stderr.readline()
    assert line.startswith("start estimator.aoe by hand: ")
    mine = subprocess.Popen(shlex.split(line.split(": ", 1)[1]))
    try:
        with client(port) as session:
            wait_for_step(session, 20)
            os.kill(mine.pid, signal.SIGSTOP)
            wait_for_step(session, 120)  # of the other estimator
    finally:
        os.kill(mine.pid, signal.SIGCONT)
    code, _, err = finish(process)
    assert code == 0, err
    assert mine.wait(10) == 0
    assert figures_of(tmp_path / "out") == virtual_figures(tmp_path, steps)
    assert summary_of(tmp_path / "out")["realtime"]["stages"]["estimate/aoe"]["missed"] > 0
