"""Have things done at a time, by the thread that a bus runs on."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Self

from testbed.channel.schedule import Schedule

Order = Callable[[], None]


class Timer:
    """To be used in ``with``. Times are those of time.monotonic_ns()."""

    def __init__(self, call: Callable[[Order], None]) -> None:
        """call: hands an order to the thread that is to carry it out."""
        self._call = call
        self._changed = threading.Condition()
        self._schedule: Schedule[Order] = Schedule()
        self._over = False
        self._thread = threading.Thread(target=self._run, name="timer", daemon=True)

    def at(self, at_ns: int, order: Order) -> None:
        """From any thread; orders of one time are handed over in the order in which they were given."""
        with self._changed:
            sooner = self._schedule.next_ns is None or at_ns < self._schedule.next_ns
            self._schedule.push(at_ns, order)
            if sooner:
                self._changed.notify()

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._over = True
            self._changed.notify()
        self._thread.join()

    def _run(self) -> None:
        with self._changed:
            while not self._over:
                for _, order in self._schedule.due(time.monotonic_ns()):
                    self._call(order)
                next_ns = self._schedule.next_ns
                wait_s = None if next_ns is None else max(0.0, (next_ns - time.monotonic_ns()) * 1e-9)
                if wait_s is None or wait_s > 0.0:
                    self._changed.wait(wait_s)
