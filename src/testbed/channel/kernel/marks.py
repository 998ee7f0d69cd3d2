"""Whose processes are whose: a mark in their environment that names the owner, and what dead owners left behind.

The mark is "tb-PID-START-RANDOM" with the owner's process number and start, so that a number used anew is no owner.
Children inherit it. Nothing else can be left behind: see the package.
"""

from __future__ import annotations

import os
import secrets
from dataclasses import dataclass
from pathlib import Path

VARIABLE = "TESTBED_HOSTS"
_PROC = Path("/proc")


@dataclass(frozen=True)
class Leftover:
    """A process whose owner is gone. ``hosts``: its mark."""

    pid: int
    command: str
    hosts: str


def new_mark() -> str:
    """A mark of which this process is the owner."""
    return f"tb-{os.getpid()}-{_started(os.getpid())}-{secrets.token_hex(4)}"


def owner_lives(mark: str) -> bool:
    """Whether the process that made a mark is still there; True for what is no mark."""
    fields = mark.split("-")
    if len(fields) != 4 or not (fields[1].isdecimal() and fields[2].isdecimal()):
        return True
    return _started(int(fields[1])) == int(fields[2])


def leftovers() -> list[Leftover]:
    """The processes of dead owners, as far as this user may see them. Other containers' are not looked at."""
    found = []
    for pid in pids():
        mark = _mark_of(pid)
        if mark is not None and not owner_lives(mark):
            found.append(Leftover(pid, command_of(pid), mark))
    return found


def is_left(pid: int, mark: str) -> bool:
    """Whether the process is (still) the one that carries the mark."""
    return _mark_of(pid) == mark


def pids() -> list[int]:
    """Of all processes but this one."""
    return [int(name) for name in os.listdir(_PROC) if name.isdecimal() and int(name) != os.getpid()]


def command_of(pid: int) -> str:
    """The command line of a process; "" if it is gone."""
    try:
        return (_PROC / str(pid) / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace").strip()
    except OSError:
        return ""


def _started(pid: int) -> int | None:
    """Start of a process in clock ticks since boot; None if there is none, or only its exit code is left."""
    try:
        fields = (_PROC / str(pid) / "stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    return None if fields[0] in "ZX" else int(fields[19])


def _mark_of(pid: int) -> str | None:
    try:
        if os.stat(f"/proc/{pid}/ns/pid").st_ino != os.stat("/proc/self/ns/pid").st_ino:
            return None
        environment = (_PROC / str(pid) / "environ").read_bytes()
    except OSError:
        return None
    for entry in environment.split(b"\0"):
        if entry.startswith(f"{VARIABLE}=".encode()):
            return entry.partition(b"=")[2].decode(errors="replace")
    return None
