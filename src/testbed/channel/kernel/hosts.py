"""Two hosts with a link between them that does to real IP packets what a pipeline says."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

from testbed.channel.kernel import enter
from testbed.channel.kernel.control import Control
from testbed.channel.kernel.ending import clean, end_within
from testbed.channel.kernel.marks import VARIABLE, Leftover, new_mark
from testbed.channel.kernel.namespaces import identity
from testbed.channel.kernel.netem import netem_arguments
from testbed.channel.kernel.plan import ADDRESSES
from testbed.errors import RunFailed, UsageError, did_you_mean
from testbed.scenario.links import Impairments

Backend = Literal["tun", "netem"]
HostName = Literal["a", "b"]
MTU_MIN, MTU_MAX = 576, 65535
_PATIENCE_S = 30.0
_ENTER = [sys.executable, "-S", "-E", enter.__file__]
_AVAILABLE = Path("/proc/sys/net/ipv4/tcp_available_congestion_control")


@dataclass(frozen=True)
class Way:
    """One direction. component: whose random streams its draws are. trace: file for TRACE.csv."""

    impairments: Impairments
    component: str
    trace: Path | None = None

    def as_json(self) -> dict[str, Any]:
        """Raises UsageError where the trace cannot be written."""
        if self.trace is not None:
            try:
                self.trace.touch()
            except OSError as error:
                raise UsageError(f"cannot write {self.trace}: {(error.strerror or str(error)).lower()}") from None
        trace = None if self.trace is None else str(self.trace.resolve())
        return {"impairments": _dumped(self.impairments), "component": self.component, "trace": trace}


class Host:
    """name: a or b. address: where the other one finds it."""

    def __init__(self, hosts: Hosts, which: int) -> None:
        self.name = "ab"[which]
        self.address = ADDRESSES[which]
        self._hosts, self._which = hosts, which

    def popen(self, command: Sequence[str], **options: Any) -> subprocess.Popen[Any]:
        """Start a command in this host; ``options`` are those of subprocess.Popen, but shell and executable.

        Raises UsageError if there is no such command.
        """
        return self._hosts._start(self._which, command, options)

    def run(
        self, command: Sequence[str], *, timeout: float | None = None, **options: Any
    ) -> subprocess.CompletedProcess[str]:
        """Run a command in this host to its end; what it printed, errors too, is in ``stdout``."""
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True, **options}
        with self.popen(command, **pipes) as process:
            try:
                printed, _ = process.communicate(timeout=timeout)
            except BaseException:
                process.kill()
                raise
        return subprocess.CompletedProcess(list(command), process.returncode, printed)


class Hosts:
    """Hosts a and b; forward is from a to b. To be used in a ``with`` statement.

    congestion: the TCP congestion control of both hosts, or by host; None: the kernel's own choice.
    removed: what dead owners had left, ended before these hosts were made.
    stubborn: commands that had to be killed at the end.
    Raises UsageError if this machine cannot do it, and says why.
    """

    def __init__(
        self,
        forward: Way,
        backward: Way,
        *,
        seed: int,
        congestion: str | Mapping[HostName, str] | None = None,
        mtu: int = 1500,
        backend: Backend = "tun",
    ) -> None:
        if not MTU_MIN <= mtu <= MTU_MAX:
            raise UsageError(f"mtu: got {mtu}; allowed: {MTU_MIN} … {MTU_MAX}")
        if backend == "netem":
            for way in (forward, backward):
                netem_arguments(way.impairments)
        self.mark = new_mark()
        self.a, self.b = Host(self, 0), Host(self, 1)
        self.removed: list[Leftover] = []
        self.stubborn: list[str] = []
        self._plan = {
            "backend": backend,
            "seed": seed,
            "mtu": mtu,
            "congestion": _congestion(congestion),
            "forward": forward.as_json(),
            "backward": backward.as_json(),
        }
        self._engine: subprocess.Popen[bytes] | None = None
        self._control: Control | None = None
        self._user: list[int] = []
        self._networks: list[int] = []
        self._started: list[subprocess.Popen[Any]] = []
        self._books: dict[str, dict[str, int]] = {}

    def __enter__(self) -> Hosts:
        self.removed = clean()
        try:
            self._open()
        except BaseException:
            self._close()
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._close()

    def books(self) -> dict[str, dict[str, int]]:
        """By direction, what became of the packets; in the end, with what was still in flight.

        Raises RunFailed if the process of the link has died.
        """
        if self._control is not None:
            self._books = self._ask({"books": True})["books"]
        return self._books

    def change(self, direction: Literal["forward", "backward"], impairments: Impairments) -> None:
        """Other parameters from now on; chains, draws and what is in flight go on. Only through TUN devices."""
        self._may_change()
        self._books = self._ask({"change": direction, "impairments": _dumped(impairments)})["books"]

    def begin(self, forward: Impairments, backward: Impairments) -> None:
        """These impairments from the next packet on, which is number 0, with empty books: once nothing is in flight."""
        self._may_change()
        self._books = self._ask({"begin": {"forward": _dumped(forward), "backward": _dumped(backward)}})["books"]

    def _may_change(self) -> None:
        if self._plan["backend"] == "netem":
            raise UsageError("backend netem: its parameters cannot be changed while it runs; allowed: backend tun")
        if self._control is None:
            raise UsageError("the hosts are closed; allowed: a change while they run")

    @property
    def entrances(self) -> dict[str, str]:
        """By host, the beginning of a command line that runs the rest in it, from another terminal."""
        assert self._engine is not None
        fds = f"/proc/{os.getpid()}/fd"
        user = "".join(f" --user={fds}/{fd} --preserve-credentials" for fd in self._user)
        return {
            host.name: f"nsenter{user} --net={fds}/{network}"
            for host, network in zip((self.a, self.b), self._networks, strict=True)
        }

    def _open(self) -> None:
        ours, theirs = socket.socketpair()
        ours.settimeout(_PATIENCE_S)
        self._control = Control(ours)
        environment = {**os.environ, VARIABLE: self.mark, "OPENBLAS_NUM_THREADS": "1"}
        with theirs:
            self._engine = subprocess.Popen(
                [sys.executable, "-m", "testbed.channel.kernel.engine", str(theirs.fileno()), str(os.getpid())],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                env=environment,
                start_new_session=True,
            )
        self._control.send(self._plan)
        _, fds = self._hear(3)
        self._user, self._networks = fds[:-2], fds[-2:]
        self._hear()

    def _hear(self, fds_max: int = 0) -> tuple[dict[str, Any], list[int]]:
        assert self._control is not None
        try:
            answer, fds = self._control.receive(fds_max)
        except EOFError:
            raise RunFailed(f"the process of the link ended{self._ending()}") from None
        except TimeoutError:
            raise RunFailed(f"no answer from the process of the link for {_PATIENCE_S:g} s") from None
        if "wrong" in answer:
            raise UsageError(answer["wrong"])
        if "refused" in answer:
            raise UsageError(
                f"no hosts on this machine: {answer['refused']}; allowed: what `testbed link doctor` shows as ok, "
                "and `testbed link relay` needs none of it"
            )
        return answer, fds

    def _ask(self, message: dict[str, Any]) -> dict[str, Any]:
        assert self._control is not None
        try:
            self._control.send(message)
        except OSError:
            raise RunFailed(f"the process of the link ended{self._ending()}") from None
        return self._hear()[0]

    def _ending(self) -> str:
        assert self._engine is not None
        try:
            return f" with code {self._engine.wait(1.0)}"
        except subprocess.TimeoutExpired:
            return ""

    def _start(self, which: int, command: Sequence[str], options: dict[str, Any]) -> subprocess.Popen[Any]:
        if self._control is None:
            raise UsageError("the hosts are closed; allowed: commands while they run")
        environment = {**(options.pop("env", None) or os.environ), VARIABLE: self.mark}
        if not command:
            raise UsageError("got no command; allowed: a command and its arguments")
        if shutil.which(command[0], path=environment.get("PATH")) is None and options.get("cwd") is None:
            raise UsageError(f"{command[0]}: no such command")
        fds = [*self._user, self._networks[which]]
        process: subprocess.Popen[Any] = subprocess.Popen(
            [*_ENTER, ",".join(map(str, fds)), *command],
            env=environment,
            pass_fds=[*options.pop("pass_fds", ()), *fds],
            **options,
        )
        self._started.append(process)
        return process

    def _close(self) -> None:
        """End what runs in the hosts, and with it the hosts."""
        control, self._control = self._control, None
        if control is not None:
            try:
                control.send({"end": True})
                answer, _ = control.receive()
                self._books, self.stubborn = answer["books"], answer["stubborn"]
            except (OSError, EOFError, KeyError):  # it has died, or never lived
                pass
            control.close()
        if self._engine is not None:
            try:
                self._engine.wait(_PATIENCE_S)
            except subprocess.TimeoutExpired:
                self._engine.kill()
                self._engine.wait()
        self.stubborn += end_within({identity(fd) for fd in self._networks}, self.mark)
        for fd in (*self._user, *self._networks):
            os.close(fd)
        self._user, self._networks = [], []
        for process in self._started:
            process.wait(_PATIENCE_S)


def _dumped(impairments: Impairments) -> dict[str, Any]:
    return impairments.model_dump(mode="json", include=set(Impairments.model_fields), exclude_none=True)


def _congestion(given: str | Mapping[HostName, str] | None) -> tuple[str | None, str | None]:
    both = (given.get("a"), given.get("b")) if isinstance(given, Mapping) else (given, given)
    available = available_congestion()
    for name in both:
        if name is not None and name not in available:
            raise UsageError(
                f"congestion: got {name!r}; allowed: {', '.join(available)}, and others once their module is loaded "
                f"(modprobe tcp_NAME){did_you_mean(name, available)}"
            )
    return both


def available_congestion() -> list[str]:
    """The TCP congestion controls that the kernel has loaded."""
    try:
        return sorted(_AVAILABLE.read_text().split())
    except OSError:
        return []
