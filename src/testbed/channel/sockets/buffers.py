"""What sockets of links ask of the kernel."""

from __future__ import annotations

import socket
import struct

_BUFFER_BYTES = 8 * 2**20
_SO_RCVBUFFORCE, _SO_SNDBUFFORCE, _SO_MEMINFO = 33, 32, 55  # asm-generic/socket.h; the module socket lacks them
_MEMINFO = struct.Struct("=9I")  # linux/sock_diag.h: SK_MEMINFO_VARS numbers, the last one SK_MEMINFO_DROPS


def enlarge(packets: socket.socket) -> None:
    """Large buffers; larger than the system allows to others where we may."""
    for forced, asked in ((_SO_RCVBUFFORCE, socket.SO_RCVBUF), (_SO_SNDBUFFORCE, socket.SO_SNDBUF)):
        try:
            packets.setsockopt(socket.SOL_SOCKET, forced, _BUFFER_BYTES)
        except OSError:
            packets.setsockopt(socket.SOL_SOCKET, asked, _BUFFER_BYTES)


def dropped_by_kernel(packets: socket.socket) -> int:
    """Packets that came for this socket and were dropped before it, since its buffer was full."""
    return int(_MEMINFO.unpack(packets.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _MEMINFO.size))[-1])
