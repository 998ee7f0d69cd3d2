"""CPU time of processes, read from /proc: by process, and within it by kind of thread."""

from __future__ import annotations

import os
import time
from collections import defaultdict
from pathlib import Path

_TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")

Usage = dict[str, dict[str, float]]
"""process name → {"main": CPU seconds of its main thread, "transport": of all its other threads}"""


def children_of(pid: int) -> list[int]:
    """Processes that any thread of ``pid`` started and that are still there."""
    found: list[int] = []
    for task in _tasks(pid):
        try:
            found += map(int, (task / "children").read_text().split())
        except OSError:
            continue
    return found


def usage_of(processes: dict[int, str]) -> Usage:
    """CPU seconds so far of every process: pid → name."""
    out: Usage = {}
    for pid, name in processes.items():
        parts: dict[str, float] = defaultdict(float)
        for task in _tasks(pid):
            parts["main" if int(task.name) == pid else "transport"] += _seconds(task)
        out[name] = dict(parts)
    return out


def difference(after: Usage, before: Usage) -> Usage:
    return {
        name: {part: seconds - before.get(name, {}).get(part, 0.0) for part, seconds in parts.items()}
        for name, parts in after.items()
    }


def command_of(pid: int) -> list[str]:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().decode().split("\0")
    except OSError:
        return []


class Busy:
    """CPU seconds that the whole machine spent, to tell what others took beside a measurement."""

    def __init__(self) -> None:
        self._begun, self._used = time.monotonic(), _machine()

    def others(self, own_s: float) -> float:
        """Mean number of CPUs that other processes kept busy since the beginning."""
        wall = time.monotonic() - self._begun
        return max(0.0, (_machine() - self._used - own_s) / wall) if wall > 0 else 0.0


def _machine() -> float:
    user, nice, system, _idle, _wait, irq, soft, *_ = map(
        int, Path("/proc/stat").read_text().split("\n")[0].split()[1:]
    )
    return (user + nice + system + irq + soft) * _TICK_S


def _tasks(pid: int) -> list[Path]:
    try:
        return list(Path(f"/proc/{pid}/task").iterdir())
    except OSError:
        return []


def _seconds(task: Path) -> float:
    """CPU seconds of one thread: in nanoseconds where the kernel keeps them, else in clock ticks."""
    try:
        return int((task / "schedstat").read_text().split()[0]) * 1e-9
    except (OSError, IndexError):
        pass
    try:
        fields = (task / "stat").read_text().rsplit(")", 1)[1].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) * _TICK_S
