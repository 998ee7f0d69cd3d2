"""What a run does when something goes wrong outside of it."""

from __future__ import annotations

import os
import random
import signal
import socket
import subprocess
import time
from pathlib import Path

import pytest

from processes.running import (
    alive,
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

pytestmark = pytest.mark.processes
LONG = 1_000_000


Running = tuple[subprocess.Popen[str], dict[int, str], str]


def running(tmp_path: Path, *, head: str = "", at_least: int = 400) -> Running:
    """A run that recovers nothing and is past a step, its children, and its key prefix."""
    port = free_port()
    recovery = '[recovery]\npolicy = "fail"'
    scenario = write_scenario(
        tmp_path,
        steps=LONG,
        head=f'record = "first"\n{recovery}\n[transport]\nendpoint = "tcp/127.0.0.1:{port}"\n{head}',
    )
    process = start(scenario, tmp_path / "out")
    with client(port) as session:
        try:
            prefix = wait_for_step(session, at_least)
        except TimeoutError:
            process.terminate()
            raise AssertionError(process.communicate(timeout=20)) from None
    return process, children_of(process.pid), prefix


@pytest.mark.parametrize(
    ("module", "role"),
    [
        ("testbed.plant --", "plant"),
        ("testbed.control", "controller"),
        ("testbed.channel --link control", "link.control"),
        ("testbed.channel --link observation", "link.observation"),
        ("testbed.estimator --name aoe", "estimator.aoe"),
        ("testbed.estimator.bounds_service", "bounds"),
    ],
)
def test_a_killed_role_ends_the_run_by_name(tmp_path: Path, module: str, role: str) -> None:
    process, children, _ = running(tmp_path)
    (victim,) = [pid for pid, command in children.items() if module in command]
    os.kill(victim, signal.SIGKILL)
    began = time.monotonic()
    wait_for(lambda: not any(alive(pid) for pid in children), 20)
    gone_s = time.monotonic() - began
    code, _, err = finish(process)
    assert code == 1
    assert f"{role} ended: killed by SIGKILL" in err
    summary = summary_of(tmp_path / "out")
    assert summary["status"] == "failed"
    assert summary["reason"] == f"{role} ended: killed by SIGKILL"
    assert summary["completed_steps"] >= 1
    assert len(summary["estimators"]["aoe"]["trace_P_mean"]) == summary["completed_steps"]
    assert (tmp_path / "out" / "report.html").stat().st_size > 10_000
    assert (tmp_path / "out" / "recording.mcap").stat().st_size > 0
    print(f"{role}: all processes gone {gone_s:.2f} s after the kill")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_stops_everything(tmp_path: Path, number: signal.Signals) -> None:
    process, children, _ = running(tmp_path)
    process.send_signal(number)
    code, _, err = finish(process)
    assert code == 130
    assert "interrupted" in err
    assert not any(alive(pid) for pid in children)
    summary = summary_of(tmp_path / "out")
    assert summary["status"] == "interrupted"
    assert summary["completed_steps"] >= 1


def test_roles_leave_when_the_orchestrator_is_killed(tmp_path: Path) -> None:
    process, children, _ = running(tmp_path)
    process.kill()
    process.communicate(timeout=10)
    wait_for(lambda: not any(alive(pid) for pid in children), 10)


def test_a_role_that_hangs_is_named(tmp_path: Path) -> None:
    process, children, _ = running(tmp_path, head='deadline = "8 s"')
    (victim,) = [pid for pid, command in children.items() if "--name aoe" in command]
    os.kill(victim, signal.SIGSTOP)
    code, _, err = finish(process)
    assert code == 1
    assert "no progress for 8 s; waiting for step" in err
    assert "estimate of aoe" in err
    assert not any(alive(pid) for pid in children)


def test_garbage_on_every_key_is_counted_and_changes_nothing(tmp_path: Path) -> None:
    port = free_port()
    head = f'[transport]\nendpoint = "tcp/127.0.0.1:{port}"\nlanes_per_packet = 2'
    scenario = write_scenario(tmp_path, steps=4000, lanes=3, head=head)
    process = start(scenario, tmp_path / "out")
    draw = random.Random(7)
    with client(port) as session:
        seen: dict[str, bytes] = {}
        listener = session.declare_subscriber(
            "testbed/**", lambda sample: seen.setdefault(str(sample.key_expr), sample.payload.to_bytes())
        )
        prefix = wait_for_step(session)
        wait_for(lambda: len(seen) >= 6)
        for _ in range(20):
            for key, payload in list(seen.items()):
                session.put(key, draw.randbytes(draw.randrange(200)))
                session.put(key, payload)  # a duplicate
                session.put(key, payload[:-3])
                session.put(key, payload.replace(b'"v":1', b'"v":2'))
                flipped = bytearray(payload)
                flipped[draw.randrange(8, len(flipped))] ^= 1 << draw.randrange(8)
                session.put(key, bytes(flipped))
        for key in ("clock", "command", "status/plant", "status/estimator.aoe", "status/nobody", "nothing"):
            session.put(f"{prefix}/{key}", b"NCS1\xff\xff\xff\xff{}")
            session.put(f"{prefix}/{key}", b"")
        listener.undeclare()
        code, out, err = finish(process)
    assert code == 0, err
    summary = summary_of(tmp_path / "out")
    refused = summary["rejected"]
    for role in ("controller", "plant", "link.control", "link.observation", "estimator.aoe", "bounds", "orchestrator"):
        assert sum(refused[role].values()) > 0, role
    assert "rejected" in out
    loaded = load_scenario(scenario)
    Run(loaded, tmp_path / "clean").in_process()
    assert figures_of(tmp_path / "out") == figures_of(tmp_path / "clean")


def test_a_port_in_use_is_refused_before_anything_starts(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        scenario = write_scenario(tmp_path, steps=5, head=f'[transport]\nendpoint = "tcp/127.0.0.1:{port}"')
        code, out, err = finish(start(scenario, tmp_path / "out"))
    assert code == 2
    assert err.splitlines() == [f"testbed: cannot listen on tcp/127.0.0.1:{port}: address already in use"]
    assert out == ""


def test_a_folder_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    code, out, err = finish(start(write_scenario(tmp_path, steps=5), tmp_path / "file" / "out"))
    assert code == 2
    assert len(err.splitlines()) == 1
    assert "cannot write into" in err
    assert out == ""
