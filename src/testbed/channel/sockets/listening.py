"""Sockets that others send or connect to."""

from __future__ import annotations

import socket
from typing import Any

from testbed.channel.sockets.endpoints import Endpoint
from testbed.errors import UsageError


def listening(at: Endpoint, kind: socket.SocketKind) -> socket.socket:
    """A non-blocking socket bound there. Raises UsageError."""
    family, address = at.resolve()
    try:
        made = _bound(family, kind, address)
        if kind == socket.SOCK_DGRAM or at.port != 0:
            return made
        with made:  # a port that the system chose is given back when the socket stops listening; one asked for is not
            return _bound(family, kind, made.getsockname())
    except OSError as error:
        raise UsageError(f"cannot listen on {at}: {(error.strerror or str(error)).lower()}") from None


def _bound(family: socket.AddressFamily, kind: socket.SocketKind, address: Any) -> socket.socket:
    made = socket.socket(family, kind)
    try:
        made.setblocking(False)
        if kind == socket.SOCK_STREAM:
            made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        made.bind(address)
    except BaseException:
        made.close()
        raise
    return made
