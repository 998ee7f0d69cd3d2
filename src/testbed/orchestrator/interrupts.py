"""Ctrl-C and a polite kill during a run: noted, so that they end it between two messages, never in its cleaning up."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass


@dataclass
class Interrupts:
    """``asked``: somebody wants the run to end."""

    asked: bool = False


@contextmanager
def noted() -> Iterator[Interrupts]:
    """Note SIGINT and SIGTERM instead of raising KeyboardInterrupt; outside of the main thread, leave them alone."""
    interrupts = Interrupts()
    if threading.current_thread() is not threading.main_thread():
        yield interrupts
        return

    def note(*_: object) -> None:
        interrupts.asked = True

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield interrupts
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
