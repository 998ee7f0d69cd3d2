"""One thread that waits for sockets, for the time and for orders from other threads."""

from __future__ import annotations

import os
import select
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import CancelledError, Future, InvalidStateError
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

from testbed.errors import TestbedError

Handler = Callable[[int], None]
Result = TypeVar("Result")

READ, WRITE = select.EPOLLIN, select.EPOLLOUT
_SELECTABLE = 1024  # file descriptors that select() takes are below this
OVERDUE_NS = 1_000_000
"""What is done later than this after it was due is counted."""
_PATIENCE_S = 10.0
_SPIN_NS = 50_000  # it takes about so long to wake up: the rest of a wait is spent awake
_NAP_S = 3600.0  # at most so long at once: select() takes no century


class LinkFailed(TestbedError):
    """The thread of a link over real sockets ended by an error."""


class Loop:
    """Runs handlers of sockets, and ``due`` when the time that it asked for has come, all in one thread.

    ``due(now_ns)`` does what is due and returns when it wants to be called next, None for never. Times are nanoseconds
    since the loop was made. Waiting is by select() over the epoll, since epoll alone counts in milliseconds.
    """

    def __init__(self, name: str, due: Callable[[int], int | None]) -> None:
        self._due = due
        self._epoll = select.epoll()
        if self._epoll.fileno() >= _SELECTABLE:
            self._epoll.close()
            raise LinkFailed(f"{name}: got {_SELECTABLE} open files or more; allowed: fewer")
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._handlers: dict[int, Handler] = {self._wake: self._obey}
        self._epoll.register(self._wake, READ)
        self._fresh: set[int] = set()
        self._orders: deque[tuple[Callable[[], Any], Future[Any]]] = deque()
        self._stopping = False
        self._start_ns = time.monotonic_ns()
        self._ended = threading.Event()
        self.failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    @property
    def now_ns(self) -> int:
        return time.monotonic_ns() - self._start_ns

    def start(self) -> None:
        self._thread.start()

    def watch(self, fd: int, handler: Handler, mask: int = READ) -> None:
        """Call the handler whenever a socket is ready; from the thread of the loop, or before it starts."""
        if fd in self._handlers:
            self._epoll.modify(fd, mask)
        else:
            self._epoll.register(fd, mask)
            self._fresh.add(fd)
        self._handlers[fd] = handler

    def forget(self, fd: int) -> None:
        if self._handlers.pop(fd, None) is not None and not self._epoll.closed:
            self._epoll.unregister(fd)

    def call(self, order: Callable[[], Result]) -> Result:
        """Run something between two packets, in the thread of the loop, and wait for what it returns or raises."""
        if self._ended.is_set() or not self._thread.is_alive():
            return order()
        future: Future[Result] = Future()
        self._orders.append((order, future))
        os.eventfd_write(self._wake, 1)
        while True:
            try:
                return future.result(0.1 if self._thread.is_alive() else 0.0)
            except TimeoutError:
                if future.done():
                    raise
                if not self._thread.is_alive():
                    future.cancel()
            except CancelledError:
                raise LinkFailed(f"{self._thread.name}: it ended meanwhile") from self.failure

    def wait(self, seconds: float | None = None) -> bool:
        """Whether the loop ended within so many seconds. Raises LinkFailed where an error ended it."""
        ended = self._ended.wait(seconds)
        if self.failure is not None:
            raise LinkFailed(f"{self._thread.name}: {self.failure!r}") from self.failure
        return ended

    def stop(self) -> None:
        """End the thread; nothing is called afterwards. Raises LinkFailed where an error had ended it."""
        if self._thread.is_alive():
            self._stopping = True
            os.eventfd_write(self._wake, 1)
            self._thread.join(_PATIENCE_S)
            if self._thread.is_alive():
                raise LinkFailed(f"{self._thread.name}: its thread did not end within {_PATIENCE_S:g} s")
        self._ended.set()
        if not self._epoll.closed:
            self._epoll.close()
            os.close(self._wake)
        if self.failure is not None:
            raise LinkFailed(f"{self._thread.name}: {self.failure!r}") from self.failure

    def _run(self) -> None:
        _wake_on_time()
        try:
            self._turn()
        except BaseException as error:
            self.failure = error
        finally:
            self._ended.set()
            while self._orders:
                self._orders.popleft()[1].cancel()

    def _turn(self) -> None:
        poll, handlers = self._epoll.poll, self._handlers
        while not self._stopping:
            next_ns = self._due(self.now_ns)
            if next_ns is None:
                ready = poll()
            else:
                wait_ns = next_ns - self.now_ns
                if wait_ns > _SPIN_NS:
                    select.select((self._epoll,), (), (), min((wait_ns - _SPIN_NS) * 1e-9, _NAP_S))
                ready = poll(0)
            self._fresh.clear()
            for fd, mask in ready:
                handler = handlers.get(fd)
                if handler is not None and fd not in self._fresh:  # else the news are of a socket closed just now
                    handler(mask)

    def _obey(self, _: int) -> None:
        os.eventfd_read(self._wake)
        while self._orders:
            order, future = self._orders.popleft()
            try:
                result = order()
            except BaseException as error:
                with suppress(InvalidStateError):
                    future.set_exception(error)
            else:
                with suppress(InvalidStateError):  # given up
                    future.set_result(result)


def _wake_on_time() -> None:
    """Ask the kernel to wake this thread at the time it asked for, not up to 50 µs later."""
    with suppress(OSError):
        Path(f"/proc/{threading.get_native_id()}/timerslack_ns").write_text("1")
