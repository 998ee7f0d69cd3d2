"""What can be done to the processes of a run."""

from __future__ import annotations

import signal
from collections.abc import Callable
from contextlib import suppress
from typing import Protocol

from testbed.errors import RunFailed, TestbedError
from testbed.orchestrator.supervise import Supervisor
from testbed.wire.bus import Bus
from testbed.wire.memory_bus import MemoryBus


class Processes(Protocol):
    """Whoever started the roles. Every method raises a TestbedError where it cannot be done."""

    def kill(self, role: str) -> None:
        """End a role's process as a crash would."""
        ...

    def pause(self, role: str, for_s: float) -> None:
        """Let a role's process stand still for so many seconds; returns at once."""
        ...

    def restart(self, role: str) -> None:
        """End a role's process, and start it anew."""
        ...


class NoProcesses:
    """Of a run whose roles nobody can end."""

    def kill(self, role: str) -> None:
        raise RunFailed(f"nobody can kill {role} in this run")

    def pause(self, role: str, for_s: float) -> None:
        raise RunFailed(f"nobody can pause {role} in this run")

    def restart(self, role: str) -> None:
        raise RunFailed(f"nobody can restart {role} in this run")


class OwnProcesses:
    """Of the processes that a supervisor has started. ``again`` starts a role anew."""

    def __init__(self, supervisor: Supervisor, bus: Bus, again: Callable[[str], None]) -> None:
        self._supervisor, self._bus, self._again = supervisor, bus, again

    def kill(self, role: str) -> None:
        self._supervisor.signal(role, signal.SIGKILL)

    def pause(self, role: str, for_s: float) -> None:
        self._supervisor.signal(role, signal.SIGSTOP)

        def go_on() -> None:
            with suppress(TestbedError):  # it has ended meanwhile, which is noticed elsewhere
                self._supervisor.signal(role, signal.SIGCONT)

        self._bus.at(self._bus.clock.monotonic_ns() + round(1e9 * for_s), go_on)

    def restart(self, role: str) -> None:
        self._again(role)


class OneProcess:
    """Of roles that are objects of this process: ``bus_of`` says on which bus a role is. ``again`` as above."""

    def __init__(self, bus_of: Callable[[str], MemoryBus], again: Callable[[str], None]) -> None:
        self._bus_of, self._again = bus_of, again

    def kill(self, role: str) -> None:
        self._bus_of(role).close()

    def pause(self, role: str, for_s: float) -> None:
        self._bus_of(role).pause(for_s)

    def restart(self, role: str) -> None:
        self._again(role)
