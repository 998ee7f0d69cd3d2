"""Frames of a capture file, pcap or pcapng, in the order of the file. Nothing is trusted: lengths are bounded.

Formats: draft-ietf-opsawg-pcap and draft-ietf-opsawg-pcapng. The two are read here rather than by a library, for exact
nanoseconds, for errors of one line, and because what a trace needs of them is small.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

from testbed.errors import UsageError

_PCAP = {0xA1B2C3D4: 1000, 0xA1B23C4D: 1}
"""Magic numbers, and the nanoseconds of a unit of the fraction."""
_SECTION, _INTERFACE, _OLD_PACKET, _SIMPLE, _PACKET = 0x0A0D0D0A, 1, 2, 3, 6
_ORDER_MAGIC = 0x1A2B3C4D
_TSRESOL, _TSOFFSET = 9, 14
_FRAME_MAX = 2**20
_BLOCK_MAX = 2**24
_SECONDS_MAX = 2**33


@dataclass(frozen=True, slots=True)
class Frame:
    """When it was captured, what its first bytes are (a LINKTYPE), and as many of its bytes as were kept."""

    at_ns: int
    link: int
    data: bytes


@dataclass(frozen=True)
class _Interface:
    link: int
    units: int
    """Of time in a second."""
    offset_s: int


def is_capture(head: bytes) -> bool:
    """Whether a file that begins with these four bytes or more is a capture."""
    if len(head) < 4:
        return False
    numbers = {struct.unpack(order + "I", head[:4])[0] for order in "<>"}
    return bool(numbers & {*_PCAP, _SECTION})


class Capture:
    """The frames of a file, once.

    cut: whether the file ends within a frame, as when the capture was killed. untimed: frames without a time, which
    are left out.
    """

    def __init__(self, file: BinaryIO, name: str) -> None:
        self._file, self._name = file, name
        self.cut = False
        self.untimed = 0

    def __iter__(self) -> Iterator[Frame]:
        """Raises UsageError where the file is no capture or contradicts itself."""
        head = self._file.read(4)
        if not is_capture(head):
            raise self._error(f"got a file that begins with {head.hex() or 'nothing'}; allowed: pcap or pcapng")
        order, number = _order(head, (*_PCAP, _SECTION))
        yield from self._sections() if number == _SECTION else self._records(order, _PCAP[number])

    def _records(self, order: str, unit_ns: int) -> Iterator[Frame]:
        """The frames of a pcap file, after its magic number."""
        rest = self._file.read(20)
        if len(rest) < 20:
            raise self._error("got a pcap header of less than 24 bytes; allowed: a whole one")
        (link,) = struct.unpack(order + "16xI", rest)
        while head := self._file.read(16):
            if len(head) < 16:
                self.cut = True
                return
            seconds, fraction, kept, _ = struct.unpack(order + "IIII", head)
            data = self._bytes(kept, _FRAME_MAX, "a frame")
            if data is None:
                return
            if fraction * unit_ns >= 10**9:
                raise self._error(f"got a time with {fraction * unit_ns} ns beyond the second; allowed: less than 10^9")
            yield Frame(seconds * 10**9 + fraction * unit_ns, link & 0xFFFF, data)

    def _sections(self) -> Iterator[Frame]:
        """The frames of a pcapng file, after the type of its first block."""
        order, interfaces, head = "<", list[_Interface](), struct.pack("<I", _SECTION)
        while head:
            if len(head) < 4:
                self.cut = True
                return
            (kind,) = struct.unpack(order + "I", head)
            length = self._file.read(4)
            if kind == _SECTION:
                magic = self._file.read(4)
                if len(length) < 4 or len(magic) < 4:
                    self.cut = True
                    return
                order = self._section_order(magic)
                interfaces = []
            if len(length) < 4:
                self.cut = True
                return
            (total,) = struct.unpack(order + "I", length)
            read = 12 if kind == _SECTION else 8
            if total % 4 or total < read + 4:
                raise self._error(f"got a block of {total} bytes; allowed: a multiple of 4, {read + 4} or more")
            body = self._bytes(total - read, _BLOCK_MAX, "a block")
            if body is None:
                return
            if body[-4:] != length:
                raise self._error("got a block whose two lengths differ; allowed: the same at both ends")
            yield from self._block(kind, body[:-4], order, interfaces)
            head = self._file.read(4)

    def _block(self, kind: int, body: bytes, order: str, interfaces: list[_Interface]) -> Iterator[Frame]:
        if kind == _INTERFACE:
            interfaces.append(self._interface(body, order))
        elif kind == _SIMPLE:
            self.untimed += 1
        elif kind in (_PACKET, _OLD_PACKET):
            if len(body) < 20:
                raise self._error(f"got a packet block of {len(body) + 12} bytes; allowed: 32 or more")
            number, high, low, kept, _ = struct.unpack(order + "IIIII", body[:20])
            if kind == _OLD_PACKET:
                (number,) = struct.unpack(order + "H", body[:2])
            if number >= len(interfaces):
                raise self._error(f"got a packet of interface {number}; allowed: 0 … of {len(interfaces)}")
            if kept > len(body) - 20:
                raise self._error(f"got a frame of {kept} bytes in a block of {len(body) + 12}; allowed: what fits")
            at = interfaces[number]
            seconds, fraction = divmod(high << 32 | low, at.units)
            if seconds + at.offset_s > _SECONDS_MAX or seconds + at.offset_s < 0:
                raise self._error(f"got a time of {seconds + at.offset_s} s; allowed: 0 … {_SECONDS_MAX}")
            at_ns = (seconds + at.offset_s) * 10**9 + fraction * 10**9 // at.units
            yield Frame(at_ns, at.link, body[20 : 20 + kept])

    def _interface(self, body: bytes, order: str) -> _Interface:
        if len(body) < 8:
            raise self._error(f"got an interface block of {len(body) + 12} bytes; allowed: 20 or more")
        (link,) = struct.unpack(order + "H", body[:2])
        units, offset_s, at = 10**6, 0, 8
        while at + 4 <= len(body):
            code, length = struct.unpack(order + "HH", body[at : at + 4])
            value = body[at + 4 : at + 4 + length]
            if code == 0 or len(value) < length:
                break
            if code == _TSRESOL and length == 1:
                units = 2 ** (value[0] & 0x7F) if value[0] & 0x80 else 10 ** value[0]
                if units > 2**63:
                    raise self._error(f"got times in units of {value[0]:#x}; allowed: 10^-18 s or 2^-63 s at best")
            elif code == _TSOFFSET and length == 8:
                (offset_s,) = struct.unpack(order + "q", value)
            at += 4 + length + -length % 4
        return _Interface(link, units, offset_s)

    def _section_order(self, magic: bytes) -> str:
        try:
            return _order(magic, (_ORDER_MAGIC,))[0]
        except ValueError:
            raise self._error(f"got a section with the byte order {magic.hex()}; allowed: 1a2b3c4d, 4d3c2b1a") from None

    def _bytes(self, number: int, most: int, noun: str) -> bytes | None:
        """The next bytes; None where the file ends before."""
        if number > most:
            raise self._error(f"got {noun} of {number} bytes; allowed: {most} or less; the file may be corrupt")
        data = self._file.read(number)
        if len(data) < number:
            self.cut = True
            return None
        return data

    def _error(self, text: str) -> UsageError:
        return UsageError(f"{self._name}: {text}")


def _order(head: bytes, numbers: tuple[int, ...]) -> tuple[str, int]:
    """The byte order in which four bytes are one of these numbers, and the number."""
    for order in "<>":
        (number,) = struct.unpack(order + "I", head)
        if number in numbers:
            return order, number
    raise ValueError(head)
