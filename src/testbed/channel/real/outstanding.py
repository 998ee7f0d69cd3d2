"""The messages that are under way: what comes out of a link must be, byte by byte, one that went in."""

from __future__ import annotations

from typing import Generic, TypeVar

T = TypeVar("T")


class Outstanding(Generic[T]):
    """Messages with what belongs to each. Of more than ``bytes_max`` the oldest are forgotten."""

    def __init__(self, bytes_max: int = 64_000_000) -> None:
        self._of: dict[bytes, T] = {}
        self._bytes, self._bytes_max = 0, bytes_max

    def add(self, message: bytes, belongs: T) -> None:
        self._of[message] = belongs
        self._bytes += len(message)
        while self._bytes > self._bytes_max and len(self._of) > 1:
            oldest = next(iter(self._of))
            del self._of[oldest]
            self._bytes -= len(oldest)

    def find(self, message: bytes) -> T | None:
        """None for what is none of them: altered on the way, from somebody else, or forgotten."""
        return self._of.get(message)
