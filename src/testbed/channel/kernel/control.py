"""What owner and engine say to each other over their socket: JSON, one object a line, and file descriptors."""

from __future__ import annotations

import array
import json
import socket
from typing import Any

_LINE_MAX = 2**26


class Control:
    """One end. Not for several threads at once."""

    def __init__(self, end: socket.socket) -> None:
        self._end = end
        self._read = b""

    def fileno(self) -> int:
        return self._end.fileno()

    def send(self, message: dict[str, Any], fds: list[int] | None = None) -> None:
        """Raises OSError if the other end is gone."""
        line = json.dumps(message).encode() + b"\n"
        ancillary = [(socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array("i", fds))] if fds else []
        sent = self._end.sendmsg([line], ancillary)
        if sent < len(line):
            self._end.sendall(line[sent:])

    def receive(self, fds_max: int = 0) -> tuple[dict[str, Any], list[int]]:
        """The next message. Raises EOFError if the other end is gone, TimeoutError if it says nothing."""
        fds: list[int] = []
        while b"\n" not in self._read:
            if len(self._read) > _LINE_MAX:
                raise EOFError
            try:
                more, got, _, _ = socket.recv_fds(self._end, 65536, fds_max)
            except ConnectionError:
                raise EOFError from None
            fds += got
            if not more:
                raise EOFError
            self._read += more
        line, _, self._read = self._read.partition(b"\n")
        message: dict[str, Any] = json.loads(line)
        return message, fds

    def close(self) -> None:
        self._end.close()
