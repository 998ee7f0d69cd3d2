"""Devices, addresses and routes of this thread's network namespace, over rtnetlink; IPv4 only. No tool is needed."""

from __future__ import annotations

import errno
import os
import socket
import struct
from pathlib import Path

_NEWLINK, _NEWADDR, _NEWROUTE, _ERROR = 16, 20, 24, 2
_REQUEST_ACK, _CREATE = 0x1 | 0x4, 0x400
_IFF_UP = 0x1
_IFLA_MTU, _IFLA_TXQLEN = 4, 13
_IFA_ADDRESS, _IFA_LOCAL = 1, 2
_RT_TABLE_MAIN, _RTPROT_STATIC, _RT_SCOPE_LINK, _RTN_UNICAST = 254, 4, 253, 1
_RTA_DST, _RTA_OIF, _RTA_METRICS, _RTAX_CC_ALGO = 1, 4, 8, 16
_NO_IPV6 = Path("/proc/sys/net/ipv6/conf/all/disable_ipv6")


def only_ipv4() -> None:
    """No IPv6 on devices that come up from now on: so the kernel sends nothing of its own."""
    if _NO_IPV6.exists():
        _NO_IPV6.write_text("1")


def bring_up(device: str, *, mtu: int | None = None, queue_packets: int | None = None) -> None:
    """Set a device up. Raises OSError."""
    attributes = b""
    if mtu is not None:
        attributes += _attribute(_IFLA_MTU, struct.pack("=I", mtu))
    if queue_packets is not None:
        attributes += _attribute(_IFLA_TXQLEN, struct.pack("=I", queue_packets))
    head = struct.pack("=BxHiII", socket.AF_UNSPEC, 0, socket.if_nametoindex(device), _IFF_UP, _IFF_UP)
    _ask(_NEWLINK, _REQUEST_ACK, head + attributes)


def add_address(device: str, address: str) -> None:
    """Without a network around it. Raises OSError."""
    raw = socket.inet_aton(address)
    head = struct.pack("=BBBBI", socket.AF_INET, 32, 0, 0, socket.if_nametoindex(device))
    _ask(_NEWADDR, _REQUEST_ACK | _CREATE, head + _attribute(_IFA_LOCAL, raw) + _attribute(_IFA_ADDRESS, raw))


def add_route(device: str, peer: str, congestion: str | None = None) -> None:
    """To the one host behind a device. ``congestion``: TCP congestion control of the connections that take the route.

    As a property of the route, because in a namespace the kernel lets sysctl choose from few. Raises OSError.
    """
    attributes = _attribute(_RTA_DST, socket.inet_aton(peer))
    attributes += _attribute(_RTA_OIF, struct.pack("=i", socket.if_nametoindex(device)))
    if congestion is not None:
        attributes += _attribute(_RTA_METRICS, _attribute(_RTAX_CC_ALGO, congestion.encode() + b"\0"))
    route = (socket.AF_INET, 32, 0, 0, _RT_TABLE_MAIN, _RTPROT_STATIC, _RT_SCOPE_LINK, _RTN_UNICAST, 0)
    _ask(_NEWROUTE, _REQUEST_ACK | _CREATE, struct.pack("=BBBBBBBBI", *route) + attributes)


def _attribute(kind: int, value: bytes) -> bytes:
    size = 4 + len(value)
    return struct.pack("=HH", size, kind) + value + b"\0" * (-size % 4)


def _ask(kind: int, flags: int, body: bytes) -> None:
    """Raises OSError with what the kernel says."""
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE) as netlink:
        netlink.settimeout(5.0)
        netlink.send(struct.pack("=IHHII", 16 + len(body), kind, flags, 1, 0) + body)
        answer = netlink.recv(65536)
    (answered,) = struct.unpack_from("=H", answer, 4)
    code = -struct.unpack_from("=i", answer, 16)[0] if answered == _ERROR else errno.EPROTO
    if code:
        raise OSError(code, os.strerror(code))
