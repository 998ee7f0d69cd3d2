"""Programs that run in the hosts, and what the tests ask about them."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from testbed.channel.kernel.hosts import Host, Hosts, Way
from testbed.scenario.links import Impairments

T = TypeVar("T")
PORT = 9000
PAYLOAD = 64
PACKET = PAYLOAD + 28
"""Bytes of the IP packet around a payload."""

_RECEIVER = """
import select, socket, sys
end = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
end.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2**22)
end.bind((sys.argv[1], int(sys.argv[2])))
print("ready", flush=True)
got = []
while True:
    ready = select.select([end, sys.stdin], [], [])[0]
    if end in ready:
        got.append(end.recv(65536)[:4])
    elif sys.stdin in ready:
        break
print(*(int.from_bytes(head, "big") for head in got))
"""
_SENDER = """
import socket, sys, time
end = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
end.connect((sys.argv[1], int(sys.argv[2])))
for number in range(int(sys.argv[3]), int(sys.argv[3]) + int(sys.argv[4])):
    end.send(number.to_bytes(4, "big").ljust(int(sys.argv[5]), b"."))
    if number % 20 == 19:
        time.sleep(0.001)
"""


def python(script: str, *arguments: object) -> list[str]:
    """A command that runs a script that needs nothing but the standard library."""
    return [sys.executable, "-S", "-E", "-c", script, *map(str, arguments)]


def link(**settings: Any) -> Impairments:
    return Impairments.model_validate(settings)


def hosts(forward: Impairments, backward: Impairments | None = None, **options: Any) -> Hosts:
    traces = {name: options.pop(name, None) for name in ("trace", "trace_back")}
    there = Way(forward, "link.observation", traces["trace"])
    back = Way(backward or link(), "link.observation.backward", traces["trace_back"])
    return Hosts(there, back, **{"seed": 7, **options})


class Receiver:
    """Counts the datagrams by the number in them."""

    def __init__(self, host: Host) -> None:
        pipe = subprocess.PIPE
        self._host = host
        self._process = host.popen(python(_RECEIVER, host.address, PORT), stdin=pipe, stdout=pipe, text=True)
        assert self._process.stdout is not None
        assert self._process.stdout.readline() == "ready\n"

    def counts(self) -> Counter[int]:
        """All that has come; ends it."""
        out, _ = self._process.communicate(timeout=30)
        return Counter(map(int, out.split()))


def send(pair: Hosts, number: int, first: int = 0) -> None:
    """Numbered datagrams from a to b; returns when all of them have arrived or been dropped."""
    done = pair.a.run(python(_SENDER, pair.b.address, PORT, first, number, PAYLOAD), timeout=60)
    assert (done.returncode, done.stdout) == (0, "")
    wait_for(lambda: pair.books()["forward"]["sent"] >= first + number and not pair.books()["forward"]["in_flight"])


def wait_for(what: Callable[[], T | None], seconds: float = 30) -> T:
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        found = what()
        if found:
            return found
        time.sleep(0.02)
    raise TimeoutError(f"waited {seconds} s in vain")


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] not in "ZX"
    except OSError:
        return False


def network_of(host: Host) -> str:
    """The name of a host's network namespace, such as net:[4026532246]."""
    return host.run(["readlink", "/proc/self/ns/net"]).stdout.strip()


def users_of(network: str) -> list[int]:
    """Processes in it."""
    out = []
    for name in os.listdir("/proc"):
        try:
            if name.isdecimal() and os.readlink(f"/proc/{name}/ns/net") == network:
                out.append(int(name))
        except OSError:
            continue
    return out
