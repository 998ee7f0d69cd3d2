"""One cell with real zenoh between two network namespaces, through the testbed's own TUN link."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from contextlib import suppress
from typing import Any

import numpy as np

from benchmarks.fidelity_cells import Cell, Seen
from testbed.channel.kernel.hosts import Host, Hosts, Way
from testbed.scenario.links import Impairments

CONGESTION = "cubic"
_OPEN_S = 40.0
_LEAD_S, _QUIET_S = 2.0, 0.2  # from ready to the first message; how long before it the losses begin
_SLACK_S = 15.0  # a blocked put, and the answers
_PORT = 7447


class Failed(Exception):
    """The cell came to nothing, and why."""


def through_kernel(cell: Cell, seconds: float, stop: threading.Event) -> Seen:
    """The losses begin when the session is open. Raises Failed, at the latest when the cell's time is over."""
    delay = {"delay": {"kind": "constant", "by": f"{cell.delay_ms} ms"}}
    clean = Impairments.model_validate(delay)
    lossy = Impairments.model_validate(cell.impairments())
    component = f"link.{cell.name.replace(' ', '-')}"
    there, back = (Way(clean, f"{component}.{direction}") for direction in ("forward", "backward"))
    messages = cell.messages(seconds)
    running: list[subprocess.Popen[Any]] = []
    with Hosts(there, back, seed=1, congestion=CONGESTION) as hosts:
        limit_s = _OPEN_S + seconds + cell.drain_s + _SLACK_S
        threading.Thread(target=_end_in, args=(limit_s, stop, running), daemon=True).start()
        try:
            endpoint = f"{cell.transport}/{hosts.b.address}:{_PORT}"
            receiver = _start(running, hosts.b, ["receive", endpoint, str(messages)])
            traffic = ["--size", str(cell.size), "--period-ns", str(cell.period_ns)]
            sender = _start(running, hosts.a, ["send", endpoint, str(messages), *traffic])
            congestion = _congestion(hosts) if cell.transport == "tcp" else ""
            before, first = _timeouts(hosts), hosts.books()
            begin_ns = time.monotonic_ns() + round(_LEAD_S * 1e9)
            until_ns = begin_ns + round((seconds + cell.drain_s) * 1e9)
            for process in running:
                _tell(process, f"{begin_ns} {until_ns}\n")
            if stop.wait(_LEAD_S - _QUIET_S):
                raise Failed("stopped")
            hosts.change("forward", lossy)
            if cell.transport == "tcp":
                hosts.change("backward", lossy)
            sent, got = (_heard(process) for process in (sender, receiver))
            ways = hosts.books()
            timeouts = _timeouts(hosts) - before
        finally:
            _kill(running)
    numbers = np.array(got["numbers"], dtype=np.int64)
    at_ms = (np.array(got["at_ns"], dtype=np.int64) - begin_ns).astype(np.float64) * 1e-6
    notes = {
        **sent,
        "congestion": congestion,
        "overdue": sum(way["overdue"] for way in ways.values()),
        "overrun": sum(way["overrun"] for way in ways.values()),
    }
    packets = [ways[way]["sent"] - first[way]["sent"] for way in ("forward", "backward")]
    return Seen(messages, cell.period_ns * 1e-6, numbers, at_ms, timeouts, packets[1] / packets[0], notes)


def _start(running: list[subprocess.Popen[Any]], host: Host, arguments: list[str]) -> subprocess.Popen[Any]:
    command = [sys.executable, "-m", "benchmarks.fidelity_ends", *arguments]
    process = host.popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    running.append(process)
    assert process.stdout is not None
    if process.stdout.readline() != "ready\n":
        raise Failed(f"zenoh did not open ({arguments[0]})")
    return process


def _tell(process: subprocess.Popen[Any], text: str) -> None:
    assert process.stdin is not None
    try:
        process.stdin.write(text)
        process.stdin.flush()
    except OSError:
        raise Failed("an end of the link has died") from None


def _heard(process: subprocess.Popen[Any]) -> dict[str, Any]:
    assert process.stdout is not None
    try:
        answer: dict[str, Any] = json.loads(process.stdout.readline())
    except ValueError:
        raise Failed("an end of the link died, or the cell's time is over") from None
    return answer


def _end_in(limit_s: float, stop: threading.Event, running: list[subprocess.Popen[Any]]) -> None:
    """When the time is over, or all is to stop."""
    stop.wait(limit_s)
    _kill(running)


def _kill(running: list[subprocess.Popen[Any]]) -> None:
    for process in running:
        with suppress(OSError):
            process.kill()


def _congestion(hosts: Hosts) -> str:
    """What the sender's connection is seen to use. Raises Failed if that is not what it should be."""
    try:
        shown = hosts.a.run(["ss", "-tinH"], timeout=10).stdout
    except Exception as error:  # no iproute2: the route says it, and nobody looked
        return f"not looked at ({error})"
    if CONGESTION not in shown.split():
        raise Failed(f"the connection does not use {CONGESTION}")
    return CONGESTION


def _timeouts(hosts: Hosts) -> int:
    """TCPTimeouts of host a."""
    lines = hosts.a.run(["cat", "/proc/net/netstat"], timeout=10).stdout.splitlines()
    names, values = next(pair for pair in zip(lines[::2], lines[1::2], strict=True) if pair[0].startswith("TcpExt"))
    return int(dict(zip(names.split(), values.split(), strict=True))["TCPTimeouts"])
