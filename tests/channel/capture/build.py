"""Captures byte by byte, as the formats say: to write what the reader reads, without it."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from ipaddress import ip_address

MS = 1_000_000


@dataclass(frozen=True)
class Taken:
    """A frame with its time."""

    at_ns: int
    data: bytes


def pcap(frames: Iterable[Taken], *, link: int = 1, order: str = "<", nano: bool = True, snap: int = 65535) -> bytes:
    unit = 1 if nano else 1000
    out = struct.pack(order + "IHHiIII", 0xA1B23C4D if nano else 0xA1B2C3D4, 2, 4, 0, 0, snap, link)
    for frame in frames:
        seconds, fraction = divmod(frame.at_ns, 10**9)
        kept = frame.data[:snap]
        out += struct.pack(order + "IIII", seconds, fraction // unit, len(kept), len(frame.data)) + kept
    return out


def block(kind: int, body: bytes, order: str = "<") -> bytes:
    body += b"\0" * (-len(body) % 4)
    return struct.pack(order + "II", kind, 12 + len(body)) + body + struct.pack(order + "I", 12 + len(body))


def section(order: str = "<") -> bytes:
    return block(0x0A0D0D0A, struct.pack(order + "IHHq", 0x1A2B3C4D, 1, 0, -1), order)


def interface(link: int, *, order: str = "<", resolution: int | None = None, offset_s: int = 0) -> bytes:
    options = b""
    if resolution is not None:
        options += struct.pack(order + "HHB3x", 9, 1, resolution)
    if offset_s:
        options += struct.pack(order + "HHq", 14, 8, offset_s)
    return block(1, struct.pack(order + "HHI", link, 0, 0) + options + struct.pack(order + "HH", 0, 0), order)


def packet(frame: Taken, *, units: int = 10**6, number: int = 0, order: str = "<") -> bytes:
    time = frame.at_ns * units // 10**9
    head = struct.pack(order + "IIIII", number, time >> 32, time & 0xFFFFFFFF, len(frame.data), len(frame.data))
    return block(6, head + frame.data, order)


def pcapng(frames: Iterable[Taken], *, link: int = 1, order: str = "<", resolution: int = 9) -> bytes:
    out = section(order) + interface(link, order=order, resolution=resolution)
    units = 2 ** (resolution & 127) if resolution & 128 else 10**resolution
    return out + b"".join(packet(frame, units=units, order=order) for frame in frames)


def udp(payload: bytes, source: int = 4000, destination: int = 5000) -> bytes:
    return struct.pack(">HHHH", source, destination, 8 + len(payload), 0) + payload


def tcp(payload: bytes, sequence: int, source: int = 4000, destination: int = 5000) -> bytes:
    return struct.pack(">HHIIBBHHH", source, destination, sequence, 0, 5 << 4, 0x18, 1000, 0, 0) + payload


def echo(sequence: int, *, reply: bool = False, identifier: int = 77, v6: bool = False) -> bytes:
    kind = (129 if reply else 128) if v6 else (0 if reply else 8)
    return struct.pack(">BBHHH", kind, 0, 0, identifier, sequence) + b"0123456789"


def ip4(body: bytes, protocol: int, *, number: int = 0, ends: tuple[str, str] = ("10.0.0.1", "10.0.0.2")) -> bytes:
    source, destination = (ip_address(end).packed for end in ends)
    head = struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(body), number & 0xFFFF, 0x4000, 64, protocol, 0)
    return head + source + destination + body


def ip6(body: bytes, protocol: int, *, ends: tuple[str, str] = ("fd00::1", "fd00::2"), before: bytes = b"") -> bytes:
    """before: extension headers; the first one is hop by hop."""
    source, destination = (ip_address(end).packed for end in ends)
    following = 0 if before else protocol
    return struct.pack(">IHBB", 6 << 28, len(before + body), following, 64) + source + destination + before + body


LINKS: dict[int, Callable[[bytes], bytes]] = {
    0: lambda p: struct.pack("<I", 2) + p,
    1: lambda p: b"\2" * 12 + _kind(p) + p,
    101: lambda p: p,
    113: lambda p: b"\0" * 14 + _kind(p) + p,
    276: lambda p: _kind(p) + b"\0" * 18 + p,
}


def _kind(packet: bytes) -> bytes:
    return b"\x86\xdd" if packet[0] >> 4 == 6 else b"\x08\0"


def ethernet(packet: bytes) -> bytes:
    return LINKS[1](packet)
