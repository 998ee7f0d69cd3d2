"""What this machine can do with links: looked up and tried, without changing it."""

from __future__ import annotations

import json
import select
import socket
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from testbed.channel.kernel.hosts import available_congestion
from testbed.channel.kernel.marks import leftovers
from testbed.channel.kernel.namespaces import privileged, sharp_timers
from testbed.channel.kernel.tun import PATH

Steps = dict[str, str | None]
"""By step of a trial, None where it works, else why not; what could not be tried has no entry."""

_BUFFER_BYTES = 2**20
_LATE_NS = 1_000_000


@dataclass(frozen=True)
class Finding:
    """what: the ability. found: what there is, or why it is not. advice: what to do; "" if nothing is needed."""

    what: str
    ok: bool
    found: str
    advice: str = ""


def examine() -> list[Finding]:
    """In the order: what links can run over, what that needs, how exact it is, what is left of earlier hosts."""
    rights = privileged()
    root, user = (_trial("root") if rights else {}), _trial("user")
    best = root if rights else user
    return [
        relay(_loopback()),
        tun_backend(best),
        netem_backend(best),
        Finding("root rights", True, "CAP_NET_ADMIN and CAP_SYS_ADMIN")
        if rights
        else Finding("root rights", False, "no CAP_NET_ADMIN with CAP_SYS_ADMIN", "user namespaces can replace them"),
        user_namespaces(user, rights),
        congestion(available_congestion()),
        clock(time.get_clock_info("monotonic").resolution, _lateness_ns()),
        buffers(_limit("rmem_max"), _limit("wmem_max")),
        left([f"{one.pid} {one.command}" for one in leftovers()]),
    ]


def can_make_hosts() -> Finding:
    """Whether two hosts can be joined through TUN devices."""
    return tun_backend(_trial("root" if privileged() else "user"))


def relay(problem: str | None) -> Finding:
    if problem is None:
        return Finding("relay", True, "sockets on loopback; needs no rights")
    return Finding("relay", False, f"sockets on loopback: {problem}", "allow sockets on 127.0.0.1")


def tun_backend(steps: Steps) -> Finding:
    """Steps: of the trial with the best rights."""
    what = "hosts, backend tun"
    if "network" not in steps:
        return Finding(what, False, "no right to make network namespaces", _RIGHTS)
    if (why := steps["network"]) is not None:
        return Finding(what, False, f"network namespaces: {why}", "in a container: --cap-add SYS_ADMIN,NET_ADMIN")
    if (why := steps.get("tun")) is not None:
        return Finding(what, False, f"{PATH}: {why}", f"modprobe tun; in a container: --device {PATH}")
    if (why := steps.get("address")) is not None:
        return Finding(what, False, f"setting the device up: {why}", _RIGHTS)
    return Finding(what, True, f"network namespaces and {PATH}")


def netem_backend(steps: Steps) -> Finding:
    what = "hosts, backend netem"
    if "netem" not in steps:
        return Finding(what, False, "not tried: no network namespaces", "see above")
    why = steps["netem"]
    if why is None:
        return Finding(what, True, "tc qdisc netem")
    if why.startswith("there is no command"):
        return Finding(what, False, why, "install iproute2")
    return Finding(
        what,
        False,
        f"tc qdisc netem: {why}",
        "modprobe sch_netem, if this kernel has it; backend tun does all and more",
    )


def user_namespaces(steps: Steps, rights: bool) -> Finding:
    what = "user namespaces"
    why = steps.get("user", "could not be tried")
    if why is None:
        return Finding(what, True, "allowed" + (", not needed with root rights" if rights else ""))
    advice = "not needed with root rights" if rights else "see sysctl user.max_user_namespaces, AppArmor, seccomp"
    return Finding(what, False, why, advice)


def congestion(available: list[str]) -> Finding:
    what = "TCP congestion control"
    if not available:
        return Finding(what, False, "the kernel does not tell")
    others = "" if {"cubic", "reno"} <= set(available) else "others by modprobe tcp_NAME"
    return Finding(what, True, ", ".join(available), others)


def clock(resolution_s: float, lateness_ns: float) -> Finding:
    found = f"resolution {resolution_s * 1e9:.0f} ns; waits end {lateness_ns / 1e3:.0f} µs late (median of 50)"
    if lateness_ns > _LATE_NS:
        return Finding("clock and timers", False, found, "less load, or a machine with cores to spare")
    return Finding("clock and timers", True, found)


def buffers(receive: int | None, send: int | None) -> Finding:
    what = "UDP buffers"
    if receive is None or send is None:
        return Finding(what, False, "the kernel does not tell net.core.rmem_max and net.core.wmem_max")
    found = f"at most {receive} bytes to receive, {send} to send"
    if min(receive, send) >= _BUFFER_BYTES:
        return Finding(what, True, found)
    settings = " ".join(f"net.core.{name}_max={4 * _BUFFER_BYTES}" for name in ("rmem", "wmem"))
    return Finding(what, False, f"{found}: bursts may be lost", f"sysctl -w {settings}")


def left(processes: list[str]) -> Finding:
    """Processes: of dead owners, "PID COMMAND"."""
    if not processes:
        return Finding("left behind", True, "nothing")
    return Finding("left behind", False, "; ".join(processes), "testbed link clean")


_RIGHTS = "run as root, or allow user namespaces; the relay needs neither"


def _trial(kind: str) -> Steps:
    command = [sys.executable, "-m", "testbed.channel.kernel.trial", kind]
    done = subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)
    try:
        steps: Steps = json.loads(done.stdout)
    except ValueError:
        return {}
    return steps


def _loopback() -> str | None:
    """Why a datagram cannot be sent on loopback; None if it can."""
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as end:
            end.settimeout(5.0)
            end.bind(("127.0.0.1", 0))
            end.sendto(b"?", end.getsockname())
            end.recv(1)
    except OSError as error:
        return error.strerror or str(error)
    return None


def _lateness_ns() -> float:
    """Median of how late waits of 1 ms end, as the links wait: in a thread of its own, whose timers are sharp."""
    late: list[int] = []

    def wait() -> None:
        sharp_timers()
        for _ in range(50):
            before = time.monotonic_ns()
            select.select((), (), (), 0.001)
            late.append(time.monotonic_ns() - before - 1_000_000)

    thread = threading.Thread(target=wait)
    thread.start()
    thread.join()
    return median(late)


def _limit(name: str) -> int | None:
    try:
        return int(Path("/proc/sys/net/core", name).read_text())
    except (OSError, ValueError):
        return None
