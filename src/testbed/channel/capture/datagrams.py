"""From a frame to what its IP packet carries: UDP, TCP or ICMP echo. What cannot be used has a name, to be counted."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from ipaddress import AddressValueError, IPv4Address, IPv6Address

from testbed.channel.capture.frames import Frame

_ICMP, _TCP, _UDP, _ICMP6 = 1, 6, 17, 58
PROTOCOLS = {_ICMP: "icmp", _TCP: "tcp", _UDP: "udp", _ICMP6: "icmp"}
_ECHO = {(_ICMP, 8): "request", (_ICMP, 0): "reply", (_ICMP6, 128): "request", (_ICMP6, 129): "reply"}
_VLAN = {0x8100, 0x88A8, 0x9100}
_IP4, _IP6 = 0x0800, 0x86DD
_EXTENSIONS = {0, 43, 60}  # hop by hop, routing, destination options
_FRAGMENT = 44
_EXTENSIONS_MAX = 16


@dataclass(frozen=True, slots=True)
class Datagram:
    """An IP packet of a capture.

    source, destination: addresses as text. ports: of UDP and TCP; for ICMP echo its identifier, twice. echo: "request"
    or "reply", "" for the rest. sequence: of ICMP echo or TCP. identification: of IPv4, -1 for IPv6. payload: what
    UDP, TCP or the echo carries, or the first bytes of it where the capture did not keep the whole packet.
    """

    at_ns: int
    source: str
    destination: str
    protocol: str
    ports: tuple[int, int]
    echo: str
    sequence: int
    identification: int
    payload: bytes
    whole: bool

    @property
    def flow(self) -> str:
        """From where to where, as text."""
        if self.protocol == "icmp":
            return f"icmp {self.source} → {self.destination}"
        return f"{self.protocol} {self.source} port {self.ports[0]} → {self.destination} port {self.ports[1]}"


def datagram_of(frame: Frame) -> Datagram | str:
    """The datagram of a frame, or why there is none, in a few words."""
    strip = _LINKS.get(frame.link)
    if strip is None:
        return f"of link type {frame.link}"
    try:
        packet = strip(frame.data)
        if not packet:
            return "not IP"
        version = packet[0] >> 4
        if version == 4:
            return _ip4(frame.at_ns, packet)
        return _ip6(frame.at_ns, packet) if version == 6 else "not IP"
    except (struct.error, IndexError, AddressValueError):
        return "cut short"


def _ethernet(data: bytes) -> bytes:
    at = 12
    (kind,) = struct.unpack_from(">H", data, at)
    while kind in _VLAN:
        at += 4
        (kind,) = struct.unpack_from(">H", data, at)
    return data[at + 2 :] if kind in (_IP4, _IP6) else b""


def _cooked(kind_at: int, length: int) -> Callable[[bytes], bytes]:
    def strip(data: bytes) -> bytes:
        (kind,) = struct.unpack_from(">H", data, kind_at)
        return data[length:] if kind in (_IP4, _IP6) else b""

    return strip


def _raw(data: bytes) -> bytes:
    return data


def _loopback(data: bytes) -> bytes:
    return data[4:]


_LINKS: dict[int, Callable[[bytes], bytes]] = {
    0: _loopback,
    1: _ethernet,
    12: _raw,
    14: _raw,
    101: _raw,
    108: _loopback,
    113: _cooked(14, 16),
    228: _raw,
    229: _raw,
    276: _cooked(0, 20),
}
"""By LINKTYPE: BSD loopback, Ethernet, raw IP (of three systems), OpenBSD loopback,
Linux cooked, IPv4, IPv6, Linux cooked 2."""


@lru_cache(4096)
def _address4(packed: bytes) -> str:
    return str(IPv4Address(packed))


@lru_cache(4096)
def _address6(packed: bytes) -> str:
    return str(IPv6Address(packed))


def _ip4(at_ns: int, packet: bytes) -> Datagram | str:
    length, identification, fragment, protocol = struct.unpack_from(">2xHHHxB", packet)
    header = 4 * (packet[0] & 15)
    if header < 20:
        return "cut short"
    if fragment & 0x3FFF:
        return "fragments"
    source, destination = _address4(packet[12:16]), _address4(packet[16:20])
    body = packet[header : length or None]  # a length of 0: segments joined by the network card
    whole = not length or len(packet) >= length
    return _body(at_ns, source, destination, protocol, identification, body, whole)


def _ip6(at_ns: int, packet: bytes) -> Datagram | str:
    length, following = struct.unpack_from(">4xHB", packet)
    source, destination = _address6(packet[8:24]), _address6(packet[24:40])
    whole = not length or len(packet) >= 40 + length
    body = packet[40 : 40 + length if length else None]
    for _ in range(_EXTENSIONS_MAX):
        if following == _FRAGMENT:
            return "fragments"
        if following not in _EXTENSIONS:
            return _body(at_ns, source, destination, following, -1, body, whole)
        following, body = body[0], body[8 + 8 * body[1] :]
    return "not UDP, TCP or ICMP echo"


def _body(
    at_ns: int, source: str, destination: str, protocol: int, identification: int, body: bytes, whole: bool
) -> Datagram | str:
    if protocol not in PROTOCOLS:
        return "not UDP, TCP or ICMP echo"
    echo, sequence = "", 0
    first, second = struct.unpack_from(">HH", body)
    if protocol == _UDP:
        if len(body) < 8:
            return "cut short"
        payload = body[8:]
    elif protocol == _TCP:
        (sequence,) = struct.unpack_from(">4xI", body)
        payload = body[4 * (body[12] >> 4) :]
    else:
        echo = _ECHO.get((protocol, body[0]), "")
        if not echo:
            return "not UDP, TCP or ICMP echo"
        first, sequence = struct.unpack_from(">4xHH", body)
        second, payload = first, body[8:]
    return Datagram(
        at_ns,
        source,
        destination,
        PROTOCOLS[protocol],
        (first, second),
        echo,
        sequence,
        identification,
        payload,
        whole,
    )
