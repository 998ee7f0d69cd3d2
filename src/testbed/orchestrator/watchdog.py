"""Who hangs: a run that stands still, and a role that does not answer."""

from __future__ import annotations

import time
from collections.abc import Callable

from testbed.orchestrator.collect import Collector
from testbed.wire.setup import Setup


class Watchdog:
    """Asks all roles for a sign of life when no step was completed for half of its patience."""

    def __init__(self, setup: Setup, collector: Collector, ping: Callable[[], None]) -> None:
        recovery, deadline_ns = setup.scenario.recovery, setup.scenario.transport.deadline_ns
        self.patience_s = (recovery.patience_ns or deadline_ns // 2) / 1e9
        self.stopped: Callable[[str], bool] = lambda role: False
        """Whether the system says that a role's process is stopped."""
        self.alive: set[str] = set()
        self._collector, self._ping = collector, ping
        self._completed, self._since, self._asked = -1, 0.0, False

    def hung(self, roles: set[str], busy: bool) -> list[str]:
        """Those of the roles that are taken for hung now; busy: the run waits for something else.

        Where some processes are stopped, it is those: others may only be held up by them.
        """
        now = time.monotonic()
        if busy or self._collector.completed != self._completed:
            self._completed, self._since, self._asked = self._collector.completed, now, False
            return []
        if not self._asked and now - self._since > self.patience_s / 2:
            self._asked = True
            self.alive.clear()
            self._ping()
        if not self._asked or now - self._since <= self.patience_s:
            return []
        self._since, self._asked = now, False
        silent = sorted(roles - self.alive)
        return [role for role in silent if self.stopped(role)] or silent
