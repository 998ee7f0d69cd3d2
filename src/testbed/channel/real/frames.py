"""Messages over a pipe: each behind its length as a uint32, little-endian."""

from __future__ import annotations

from collections.abc import Iterator
from typing import BinaryIO

_LENGTH = 4


def framed(message: bytes) -> bytes:
    return len(message).to_bytes(_LENGTH, "little") + message


def messages(pipe: BinaryIO) -> Iterator[bytes]:
    """Until the pipe ends; a message that is cut off by that is not one."""
    while len(head := pipe.read(_LENGTH)) == _LENGTH:
        size = int.from_bytes(head, "little")
        message = pipe.read(size)
        if len(message) < size:
            return
        yield message
