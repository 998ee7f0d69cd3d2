"""What may lie between the two ends of a link: nothing, the relay or the proxy in its own process, or the kernel."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import tomli_w

from benchmarks.cpu import Busy, usage_of
from benchmarks.link_ends import Found, Shared, Work, scheme

_PATIENCE_S = 60.0
_SYSTEM = {"A": [[1.0]], "C": [[1.0]], "Q": [[1.0]], "R": [[1.0]]}
Start = Callable[..., subprocess.Popen[Any]]


@dataclass(frozen=True)
class Run:
    """What the ends found; the books of the backend on the way to the sink, and the CPU time it took.

    others: CPUs that the rest of the machine kept busy meanwhile.
    """

    found: Found
    books: dict[str, int] = field(default_factory=dict)
    cpu_s: float = 0.0
    others: float = 0.0


def measured(case: Callable[[], Run]) -> Run:
    """Run a case, and see how busy others are."""
    busy, before = Busy(), _own_s()
    run = case()
    return replace(run, others=busy.others(_own_s() - before))


def _own_s() -> float:
    """CPU seconds of this process and of those that it started and that have ended."""
    return sum(os.times()[:4])


def direct(kind: str, work: Work) -> Run:
    port = _free_port(kind)
    return Run(_between(kind, work, ("127.0.0.1", port), ("127.0.0.1", port)))


def relayed(kind: str, work: Work, impairments: dict[str, Any] | None = None) -> Run:
    """Through ``testbed link relay``."""
    port = _free_port(kind)
    with tempfile.TemporaryDirectory() as folder:
        scenario = Path(folder, "link.toml")
        tables = {"name": "link", "seed": 1, "system": _SYSTEM, "links": {"observation": impairments or {}}}
        scenario.write_text(tomli_w.dumps(tables))
        command = [sys.executable, "-m", "testbed", "link", "relay", str(scenario), "--link", "observation", "--json"]
        command += ["--listen", f"{scheme(kind)}/127.0.0.1:0", "--to", f"{scheme(kind)}/127.0.0.1:{port}"]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        try:
            assert process.stderr is not None
            entrance = int(process.stderr.readline().split(" to ")[0].rsplit(":", 1)[1])
            before = _cpu_s(process.pid)
            found = _between(kind, work, ("127.0.0.1", port), ("127.0.0.1", entrance))
            cpu_s = _cpu_s(process.pid) - before
            process.send_signal(signal.SIGINT)
            out, err = process.communicate(timeout=_PATIENCE_S)
        finally:
            process.kill()
            process.wait()
    if process.returncode:
        raise RuntimeError(f"the relay failed: {err}")
    figures = json.loads(out)
    return Run(found, {**figures["forward"], "kernel_dropped": figures.get("kernel_dropped", 0)}, cpu_s)


def _cpu_s(pid: int) -> float:
    return sum(usage_of({pid: "relay"})["relay"].values())


class Kernel:
    """Between two network namespaces, through TUN devices; ``missing`` says why that cannot be done."""

    def __init__(self) -> None:
        self.missing: str | None = None
        try:
            with self._hosts():
                pass
        except ImportError:
            self.missing = "this version has no kernel backend"
        except Exception as error:
            self.missing = str(error)

    def through(self, kind: str, work: Work) -> Run:
        port = 7447
        with self._hosts() as hosts:
            at = (hosts.b.address, port)
            found = _between(kind, work, at, at, hosts.b.popen, hosts.a.popen)
            books = hosts.books()
        return Run(found, books["forward"])

    @staticmethod
    @contextmanager
    def _hosts() -> Iterator[Any]:
        from testbed.channel.kernel.hosts import Hosts, Way
        from testbed.scenario.links import Impairments

        clean = Impairments()
        with Hosts(Way(clean, "link.bench.forward"), Way(clean, "link.bench.backward"), seed=1) as hosts:
            yield hosts


def _between(
    kind: str,
    work: Work,
    sink_at: tuple[str, int],
    entrance: tuple[str, int],
    start_sink: Start = subprocess.Popen,
    start_source: Start = subprocess.Popen,
) -> Found:
    """Start both ends, the sink first, and wait for what it found."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "shared")
        Shared.make(path)

        def command(what: str, at: tuple[str, int]) -> Sequence[str]:
            tail = [kind, at[0], str(at[1]), str(path), json.dumps(asdict(work))]
            return [sys.executable, "-m", "benchmarks.link_ends", what, *tail]

        sink = start_sink(command("sink", sink_at), stdout=subprocess.PIPE, text=True)
        source = None
        try:
            assert sink.stdout is not None
            if sink.stdout.readline() != "ready\n":
                raise RuntimeError(f"{kind}: the sink did not begin")
            source = start_source(command("source", entrance))
            if source.wait(_PATIENCE_S):
                raise RuntimeError(f"{kind}: the source failed")
            out, _ = sink.communicate(timeout=_PATIENCE_S)
        finally:
            for process in (sink, source):
                if process is not None:
                    process.kill()
                    process.wait()
    return Found(**json.loads(out.splitlines()[-1]))


def _free_port(kind: str) -> int:
    with socket.socket(type=socket.SOCK_DGRAM if scheme(kind) == "udp" else socket.SOCK_STREAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
