"""The bus: publish, subscribe, ask, presence, close. What services need of a network, and no more."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from testbed.errors import TestbedError

Handler = Callable[[str, bytes], None]
"""Called with (key, payload)."""
Answer = Callable[[bytes], bytes]
"""Called with a question, returns the answer."""
PresenceHandler = Callable[[str, bool], None]
"""Called with (key, alive) when a token appears or goes."""
Publish = Callable[[bytes], None]


class BusError(TestbedError):
    """The bus could not be opened, or gave no answer in time."""


class Bus(Protocol):
    """Handlers run on the thread that calls ``run``, one at a time, in the order of arrival."""

    def publisher(self, key: str, *, lazy: bool = False) -> Publish:
        """A function that publishes on ``key``. Order is kept on each key; nothing is lost.

        lazy: nobody waits for these messages; they may be held back until there are many or nothing else to do.
        """
        ...

    def subscribe(self, key: str, handler: Handler) -> None:
        """``key`` may be an expression with ``*`` for one part of a key."""
        ...

    def ask(self, key: str, question: bytes = b"") -> bytes:
        """The answer to a question. Raises BusError when none comes within the bus's deadline."""
        ...

    def answer(self, key: str, answer: Answer) -> None: ...

    def announce(self, key: str) -> None:
        """Declare a presence token, after the subscriptions it promises."""
        ...

    def watch(self, key: str, handler: PresenceHandler) -> None:
        """Be told of tokens that are there, appear and go."""
        ...

    def call(self, order: Callable[[], None]) -> None:
        """Have something done as a handler would be, after what has arrived before; from any thread."""
        ...

    def close(self) -> None: ...
