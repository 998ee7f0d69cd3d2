"""Where another thread of this process leaves orders for the thread that has the run."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, TypeVar

from testbed.errors import UsageError

if TYPE_CHECKING:
    from testbed.orchestrator.conductor import Conductor

T = TypeVar("T")


class RunOver(UsageError):
    """Nobody takes an order any more."""


Order = Callable[["Conductor"], Any]


class Desk:
    """``put`` is for any thread, everything else for the thread of the run.

    wake: called by ``put``, from any thread, where the run has to be told that something lies there.
    """

    def __init__(self) -> None:
        self.wake: Callable[[], None] = lambda: None
        self.opened: Callable[[Conductor], None] = lambda conductor: None
        """Called with the conductor before the run begins."""
        self._conductor: Conductor | None = None
        self._orders: SimpleQueue[tuple[Order, Future[Any]]] = SimpleQueue()
        self._closed = False

    def put(self, order: Callable[[Conductor], T]) -> Future[T]:
        """Have an order carried out between two messages; the future has what it returns or raises.

        Where the run is over it raises RunOver.
        """
        future: Future[T] = Future()
        self._orders.put((order, future))
        if self._closed:
            self._clear()
        else:
            self.wake()
        return future

    def open(self, conductor: Conductor) -> None:
        self._conductor = conductor
        self.opened(conductor)

    def work(self) -> None:
        """Carry out what lies there."""
        while not self._orders.empty():
            self._carry_out(*self._orders.get())

    def wait(self, timeout_s: float) -> None:
        """Carry out the next order, waiting for it for a while where there is none."""
        with suppress(Empty):
            self._carry_out(*self._orders.get(timeout=timeout_s))

    def close(self) -> None:
        """The run is over: refuse what lies there and what comes."""
        self._closed = True
        self._clear()

    def _carry_out(self, order: Order, future: Future[Any]) -> None:
        assert self._conductor is not None
        try:
            future.set_result(order(self._conductor))
        except Exception as error:
            future.set_exception(error)

    def _clear(self) -> None:
        while True:
            try:
                _, future = self._orders.get_nowait()
            except Empty:
                return
            future.set_exception(RunOver("the run is over; allowed: while it goes"))
