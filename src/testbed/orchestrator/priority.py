"""Real-time priority for processes while a run goes."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path


class Priorities:
    """Raises the threads of processes to SCHED_FIFO, and puts back those of this process.

    ``raised``: role → priority that all its threads have; a role is missing where the system refused.
    """

    def __init__(self, priority: int) -> None:
        self._priority = priority
        self.raised: dict[str, int] = {}

    def raise_all(self, processes: Mapping[str, int]) -> None:
        """processes: role → process id."""
        for role, pid in processes.items():
            try:
                for thread in _threads_of(pid):
                    os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(self._priority))
            except (OSError, AttributeError):  # not permitted; a process that has ended; a system that has none of it
                continue
            self.raised[role] = self._priority

    def lower_own(self) -> None:
        """Let this process be an ordinary one again."""
        if self.raised:
            for thread in _threads_of(os.getpid()):
                os.sched_setscheduler(thread, os.SCHED_OTHER, os.sched_param(0))


def _threads_of(pid: int) -> Iterator[int]:
    return (int(entry.name) for entry in list(Path(f"/proc/{pid}/task").iterdir()))
