"""The way of a link's messages through real sockets: two ends, and between them a relay or the kernel."""

from __future__ import annotations

import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from typing import Self

from testbed.channel.real.frames import framed, messages
from testbed.channel.real.middle import RECEIVER, SENDER, Middle
from testbed.errors import RunFailed, TestbedError
from testbed.scenario.carriers import TcpTransport
from testbed.scenario.durations import parse_duration
from testbed.scenario.links import SteppedImpairments

_MODULE = "testbed.channel.real.ends"
_PROBE, _LAST_PROBE = b"probe", b"last probe"
_PROBE_EVERY_S = 0.05
_ATTEMPTS = 5
_LEAVE_S = 0.3
_WAITING_MAX = 65536
_UDP_LEASE_S = 24 * 3600
"""Datagrams have no connection that could be lost; zenoh's is to outlive any burst of losses."""


class Path:
    """Two ends with something between them; to be used in ``with``. At the entry it carries messages without losses.

    ``arrived`` gets what comes out, ``failed`` an error that ends the path; both on threads of the path.
    refused: messages that could not even be handed to the sending end, because too many waited.
    """

    def __init__(
        self,
        middle: Middle,
        settings: SteppedImpairments,
        key: str,
        arrived: Callable[[bytes], None],
        failed: Callable[[TestbedError], None],
        *,
        patience_s: float,
    ) -> None:
        """patience_s: for the path to open."""
        self._middle, self._settings, self._key = middle, settings, key
        self._arrived, self._failed = arrived, failed
        self._patience_s = patience_s
        self._deadline_s = 0.0
        self.refused = 0
        self._ends: dict[str, subprocess.Popen[bytes]] = {}
        self._words: dict[str, str] = {}
        self._outbox: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._news: queue.SimpleQueue[bytes | TestbedError] = queue.SimpleQueue()
        """What comes out until the path is open."""
        self._open = self._closing = False
        self._cleanup = ExitStack()

    def __enter__(self) -> Self:
        self._deadline_s = time.monotonic() + self._patience_s
        with ExitStack() as cleanup:
            cleanup.enter_context(self._middle)
            cleanup.callback(self._end)
            self._receiver()
            self._sender()
            self._probe()
            self._middle.begin(self._settings)
            self._cleanup = cleanup.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._closing = True
        self._cleanup.close()

    def send(self, message: bytes) -> None:
        """Never waits."""
        if self._outbox.qsize() >= _WAITING_MAX:
            self.refused += 1
        else:
            self._outbox.put(message)

    def change(self, settings: SteppedImpairments) -> None:
        """Other impairments from now on. Raises TestbedError where the path cannot express them, or has died."""
        self._middle.change(settings)

    def books(self) -> dict[str, dict[str, int]]:
        """Of packets, by direction. Raises TestbedError where what is between the ends has died."""
        return self._middle.books()

    def _receiver(self) -> None:
        """Start the receiving end; on another port where that one was taken meanwhile."""
        for left in reversed(range(_ATTEMPTS)):
            self._start(RECEIVER, ["--listen", self._middle.listen()])
            try:
                self._ready(RECEIVER)
            except RunFailed:
                if not left:
                    raise
            else:
                return

    def _sender(self) -> None:
        process = self._start(SENDER, ["--connect", self._middle.connect()])
        self._ready(SENDER)
        threading.Thread(target=self._write, args=(process,), daemon=True).start()

    def _ready(self, what: str) -> None:
        try:
            self._hear(max(0.0, self._deadline_s - time.monotonic()))
        except TimeoutError:
            raise RunFailed(f"its {what} was not ready within {self._patience_s:g} s") from None

    def _probe(self) -> None:
        """Until a message comes through, and with it all that was sent before: order is kept."""
        while time.monotonic() < self._deadline_s:
            self._outbox.put(_PROBE)
            with suppress(TimeoutError):
                self._hear(_PROBE_EVERY_S)
                self._outbox.put(_LAST_PROBE)
                while self._hear(max(0.0, self._deadline_s - time.monotonic())) != _LAST_PROBE:
                    pass
                self._open = True
                return
            self._check()
        raise RunFailed(f"its two ends did not hear each other within {self._patience_s:g} s")

    def _hear(self, patience_s: float) -> bytes:
        try:
            news = self._news.get(timeout=patience_s)
        except queue.Empty:
            raise TimeoutError from None
        if isinstance(news, TestbedError):
            raise news
        return news

    def _start(self, what: str, arguments: list[str]) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", _MODULE, *arguments, "--key", self._key, *self._limits()]
        pipe = subprocess.PIPE
        process = self._middle.popen(what)(command, stdin=pipe, stdout=pipe, stderr=pipe, start_new_session=True)
        self._ends[what] = process
        threading.Thread(target=self._read, args=(process,), daemon=True).start()
        threading.Thread(target=self._listen, args=(what, process), daemon=True).start()
        return process

    def _limits(self) -> list[str]:
        transport = self._settings.transport
        lease_ms, blocked_ms, retry_ms = _UDP_LEASE_S * 1000, 5_000, 1_000
        open_ms = max(1, int(self._patience_s * 1000))
        if isinstance(transport, TcpTransport):
            lease_ms, blocked_ms = _ms(transport.lease), _ms(transport.blocked_limit)
            open_ms, retry_ms = _ms(transport.open_limit), _ms(transport.retry)
        values = {"lease": lease_ms, "blocked": blocked_ms, "open": open_ms, "retry": retry_ms}
        return [part for name, value in values.items() for part in (f"--{name}-ms", str(value))]

    def _read(self, process: subprocess.Popen[bytes]) -> None:
        assert process.stdout is not None
        for message in messages(process.stdout):  # type: ignore[arg-type]
            if self._open:
                self._arrived(message)
            else:
                self._news.put(message)
        self._ended(process)

    def _listen(self, what: str, process: subprocess.Popen[bytes]) -> None:
        """What an end complains of goes into the log of the role; the last line is kept for an error."""
        assert process.stderr is not None
        for line in process.stderr:
            text = line.decode(errors="replace").strip()
            print(f"{what}: {text}", file=sys.stderr, flush=True)
            self._words[what] = text or self._words.get(what, "")

    def _write(self, process: subprocess.Popen[bytes]) -> None:
        assert process.stdin is not None
        try:
            while (message := self._outbox.get()) is not None and not self._closing:
                process.stdin.write(framed(message))
                if self._outbox.empty():
                    process.stdin.flush()
            process.stdin.close()
        except OSError:
            self._ended(process)

    def _check(self) -> None:
        for process in self._ends.values():
            if process.poll() is not None:
                self._ended(process)

    def _ended(self, process: subprocess.Popen[bytes]) -> None:
        """An end is gone that should not be."""
        if self._closing:
            return
        what = next(name for name, end in self._ends.items() if end is process)
        with suppress(subprocess.TimeoutExpired):
            process.wait(1.0)
        words = f": {self._words[what][:200]}" if what in self._words else ""
        error = RunFailed(f"its {what} ended ({_ending(process.returncode)}){words}")
        if self._open:
            self._failed(error)
        else:
            self._news.put(error)

    def _end(self) -> None:
        """The ends leave when their standard input closes; those that do not in time are killed."""
        self._closing = True
        self._outbox.put(None)
        receiver = self._ends.get(RECEIVER)
        if receiver is not None and receiver.stdin is not None:
            receiver.stdin.close()
        deadline = time.monotonic() + _LEAVE_S
        for process in self._ends.values():
            try:
                process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _ending(code: int | None) -> str:
    if code is None:
        return "it does not answer"
    return f"killed by signal {-code}" if code < 0 else f"exit code {code}"


def _ms(duration: str) -> int:
    return max(1, parse_duration(duration, zero=True) // 1_000_000)
