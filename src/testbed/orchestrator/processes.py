"""What can be done to the processes of a run."""

from __future__ import annotations

from typing import Protocol

from testbed.errors import RunFailed


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
