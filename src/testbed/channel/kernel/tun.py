"""A TUN device in this thread's network namespace."""

from __future__ import annotations

import fcntl
import os
import struct
from pathlib import Path

from testbed.channel.kernel.rtnetlink import add_address, add_route, bring_up, only_ipv4

PATH = "/dev/net/tun"
DEVICE = "tb0"
_TUNSETIFF = 0x400454CA
_IFF_TUN, _IFF_NO_PI = 0x0001, 0x1000
_QUEUE_PACKETS = 16384


def open_tun() -> int:
    """A new device, down; what is read from and written to it is one IP packet. It is gone when this is closed.

    Raises OSError.
    """
    fd = os.open(PATH, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        fcntl.ioctl(fd, _TUNSETIFF, struct.pack("=16sH22x", DEVICE.encode(), _IFF_TUN | _IFF_NO_PI))
    except OSError:
        os.close(fd)
        raise
    return fd


def join(address: str, peer: str, mtu: int, congestion: str | None) -> None:
    """Bring loopback and the device up, with its address and the route to the other host. Raises OSError."""
    only_ipv4()
    bring_up("lo")
    bring_up(DEVICE, mtu=mtu, queue_packets=_QUEUE_PACKETS)
    add_address(DEVICE, address)
    add_route(DEVICE, peer, congestion)


def overruns() -> int:
    """Packets for which this thread's namespace had no room in the device's queue."""
    for line in Path("/proc/thread-self/net/dev").read_text().splitlines():
        name, _, numbers = line.partition(":")
        if name.strip() == DEVICE:
            return int(numbers.split()[11])
    return 0
