"""Starting real runs, finding their processes, and waiting with deadlines."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import zenoh

from testbed.wire.bundle import unbundle

T = TypeVar("T")

SYSTEM = """
[system]
A = [[0.9, 0.1], [0.0, 0.97]]
B = [[-1.0], [1.0]]
C = [[1.0, -1.0], [0.0, 1.0]]
Q = [[2.0, 0.0], [0.0, 1.0]]
R = [[1.0, 0.0], [0.0, 1.0]]
[input]
kind = "sine"
amplitude = 3.0
period = 7.0
[links.observation]
loss = { kind = "markov", recovery = 0.6, failure = 0.3 }
[links.control]
loss = { kind = "markov", recovery = 0.5, failure = 0.2 }
"""
ESTIMATORS = """
[[estimators]]
name = "aoe"
[[estimators]]
name = "kfio"
acks = "perfect"
"""


def write_scenario(folder: Path, *, steps: int, lanes: int = 1, head: str = "", tail: str = ESTIMATORS) -> Path:
    path = folder / "scenario-under-test.toml"
    path.write_text(f"steps = {steps}\nlanes = {lanes}\n{head}\n{SYSTEM}{tail}")
    return path


def start(scenario: Path, out: Path, *options: str, **environment: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "testbed", "run", str(scenario), "--out", str(out), *options]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, env={**os.environ, **environment})


def finish(process: subprocess.Popen[str], seconds: float = 100) -> tuple[int, str, str]:
    out, err = process.communicate(timeout=seconds)
    return process.returncode, out, err


def summary_of(out: Path) -> dict[str, Any]:
    return json.loads((out / "summary.json").read_text())


def figures_of(out: Path) -> dict[str, Any]:
    summary = summary_of(out)
    return {key: summary[key] for key in ("estimators", "links", "bounds")}


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def wait_for(what: Callable[[], T | None], seconds: float = 60) -> T:
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        found = what()
        if found:
            return found
        time.sleep(0.02)
    raise TimeoutError(f"waited {seconds} s in vain")


def children_of(pid: int) -> dict[int, str]:
    """pid → command line of the direct children."""
    found = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                status = (entry / "stat").read_text().rsplit(")", 1)[1].split()
                if int(status[1]) == pid and status[0] != "Z":
                    found[int(entry.name)] = (entry / "cmdline").read_text().replace("\0", " ")
            except (FileNotFoundError, ProcessLookupError):
                continue
    return found


def alive(pid: int) -> bool:
    try:
        return (Path("/proc") / str(pid) / "stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def client(port: int, seconds: float = 60) -> zenoh.Session:
    """A bystander's session to a run's endpoint, once that is there."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["tcp/127.0.0.1:{port}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("connect/timeout_ms", "200")
    deadline = time.monotonic() + seconds
    while True:
        try:
            return zenoh.open(config)
        except zenoh.ZError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.1)


def wait_for_step(session: zenoh.Session, at_least: int = 1) -> str:
    """Wait until some estimate of that step has passed; the run's key prefix."""
    seen: list[str] = []

    def note(sample: zenoh.Sample) -> None:
        for payload in unbundle(sample.payload.to_bytes()):
            header = json.loads(payload[8 : 8 + int.from_bytes(payload[4:8], "little")])
            if header["step"] >= at_least:
                seen.append(str(sample.key_expr))

    subscriber = session.declare_subscriber("testbed/*/estimate/*", note)
    try:
        return wait_for(lambda: seen[0] if seen else None).rsplit("/", 2)[0]
    finally:
        subscriber.undeclare()
