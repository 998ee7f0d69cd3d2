"""The roles' processes: start them, see them die, leave none behind."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from testbed.errors import UsageError
from testbed.orchestrator.roles import RoleSpec
from testbed.scenario import Transport

_ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def command_of(role: RoleSpec, endpoint: str, run: str, transport: Transport) -> list[str]:
    """How to start a role by hand."""
    out = [sys.executable, "-m", role.module, *role.arguments, "--connect", endpoint, "--run", run]
    given = transport.model_dump(mode="json", exclude_defaults=True, exclude={"endpoint", "lanes_per_packet"})
    return [*out, "--transport", json.dumps(given)] if given else out


class Supervisor:
    """Owns the processes it started. Their output goes to ``logs/ROLE.log``."""

    def __init__(self, logs: Path) -> None:
        self._logs = logs
        self._processes: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, role: RoleSpec, endpoint: str, run: str, transport: Transport) -> None:
        """Start a role in a session of its own, so that Ctrl-C reaches only the orchestrator.

        What is left of an earlier process of it is ended before.
        """
        self._logs.mkdir(exist_ok=True)
        command = [*command_of(role, endpoint, run, transport), "--supervised"]
        environment = {**dict.fromkeys(_ONE_THREAD, "1"), **os.environ}
        again = self._forget(role.name)
        with self.log_of(role.name).open("ab" if again else "wb") as log:
            self._processes[role.name] = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=log, stderr=log, env=environment, start_new_session=True
            )

    def _forget(self, role: str) -> bool:
        """Whether there was a process of that role; it is no more."""
        process = self._processes.pop(role, None)
        if process is None:
            return False
        process.kill()
        process.wait()
        if process.stdin is not None:
            process.stdin.close()
        return True

    def stopped(self, role: str) -> bool:
        """Whether a role's process is stopped by a signal, as far as the system tells."""
        try:
            return Path(f"/proc/{self._processes[role].pid}/stat").read_text().rpartition(")")[2].split()[0] == "T"
        except (OSError, KeyError, IndexError):
            return False

    def signal(self, role: str, number: signal.Signals) -> None:
        """Send a signal to a role's process. Raises UsageError where there is none."""
        process = self._processes.get(role)
        if process is None or process.poll() is not None:
            raise UsageError(f"{role}: no process of this run")
        process.send_signal(number)

    def log_of(self, role: str) -> Path:
        return self._logs / f"{role}.log"

    @property
    def pids(self) -> dict[str, int]:
        """Process ids by role."""
        return {role: process.pid for role, process in self._processes.items()}

    def dead(self) -> dict[str, str]:
        """How each process that has ended did so: role → "killed by SIGKILL", "exit code 1"."""
        return {role: _ending(p.returncode) for role, p in self._processes.items() if p.poll() is not None}

    def ending_of(self, role: str, patience_s: float = 0.3) -> str | None:
        """How a role's process ended, waiting a moment for it; None if it is not ours or still runs."""
        process = self._processes.get(role)
        if process is None:
            return None
        try:
            return _ending(process.wait(patience_s))
        except subprocess.TimeoutExpired:
            return None

    def end(self, role: str) -> None:
        """End a role's process that is not wanted any more."""
        process = self._processes.get(role)
        if process is not None and process.poll() is None:
            process.kill()

    def close(self, patience_s: float) -> None:
        """Wait for all to leave; end those that do not. Empty logs are removed."""
        deadline = time.monotonic() + patience_s
        self._wait(deadline)
        for signal_ in (signal.SIGTERM, signal.SIGKILL):
            alive = [p for p in self._processes.values() if p.poll() is None]
            for process in alive:
                process.send_signal(signal_)
            if alive:
                self._wait(time.monotonic() + 0.4)
        for role, process in self._processes.items():
            process.wait()
            if process.stdin is not None:
                process.stdin.close()
            log = self.log_of(role)
            if log.exists() and log.stat().st_size == 0:
                log.unlink()
        if self._logs.exists() and not any(self._logs.iterdir()):
            self._logs.rmdir()

    def _wait(self, deadline: float) -> None:
        for process in self._processes.values():
            try:
                process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                return


def _ending(code: int) -> str:
    return f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
