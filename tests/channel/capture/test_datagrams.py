"""What frames carry: the same datagram under every link layer and IP version; what cannot be used has a name."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from channel.capture import build
from testbed.channel.capture.datagrams import Datagram, datagram_of
from testbed.channel.capture.frames import Frame


def of(packet: bytes, link: int = 101) -> Datagram | str:
    return datagram_of(Frame(5, link, packet))


@pytest.mark.parametrize("link", sorted(build.LINKS))
@pytest.mark.parametrize("version", [4, 6])
def test_udp_under_every_link_layer(link: int, version: int) -> None:
    if version == 4:
        packet, ends, number = build.ip4(build.udp(b"hello"), 17, number=9), ("10.0.0.1", "10.0.0.2"), 9
    else:
        packet, ends, number = build.ip6(build.udp(b"hello"), 17), ("fd00::1", "fd00::2"), -1
    padded = build.LINKS[link](packet) + b"\0" * 7  # Ethernet pads short frames
    found = of(padded, link)
    assert found == Datagram(5, *ends, "udp", (4000, 5000), "", 0, number, b"hello", True)
    assert found.flow == f"udp {ends[0]} port 4000 → {ends[1]} port 5000"


def test_tcp_and_echo() -> None:
    found = of(build.ip4(build.tcp(b"abc", 12345), 6))
    assert isinstance(found, Datagram)
    assert (found.protocol, found.sequence, found.payload) == ("tcp", 12345, b"abc")
    for v6, make, protocol in ((False, build.ip4, 1), (True, build.ip6, 58)):
        for reply in (False, True):
            found = of(make(build.echo(300, reply=reply, v6=v6), protocol))
            assert isinstance(found, Datagram)
            assert (found.protocol, found.echo) == ("icmp", "reply" if reply else "request")
            assert (found.sequence, found.ports) == (300, (77, 77))


def test_tags_and_extension_headers_are_passed_over() -> None:
    frame = build.ethernet(build.ip4(build.udp(b"x"), 17))
    tagged = frame[:12] + struct.pack(">HHHH", 0x88A8, 5, 0x8100, 6) + frame[12:]
    found = of(tagged, 1)
    assert isinstance(found, Datagram)
    assert found.payload == b"x"
    extensions = struct.pack(">BB6x", 60, 0) + struct.pack(">BB14x", 17, 1)
    found = of(build.ip6(build.udp(b"y"), 17, before=extensions))
    assert isinstance(found, Datagram)
    assert found.payload == b"y"


def test_a_packet_that_was_not_kept_whole() -> None:
    found = of(build.ip4(build.udp(b"0123456789"), 17)[:-4])
    assert isinstance(found, Datagram)
    assert (found.payload, found.whole) == (b"012345", False)


FRAGMENT = bytearray(build.ip4(build.udp(b"x"), 17))
FRAGMENT[6:8] = b"\x20\x00"


@pytest.mark.parametrize(
    ("packet", "link", "reason"),
    [
        (b"\x45", 101, "cut short"),
        (b"", 101, "not IP"),
        (b"\x99" * 40, 101, "not IP"),
        (build.ethernet(b"\x45")[:13], 1, "cut short"),
        (b"\2" * 12 + b"\x08\x06" + b"x" * 28, 1, "not IP"),
        (build.ip4(build.udp(b"x"), 17), 147, "of link type 147"),
        (bytes(FRAGMENT), 101, "fragments"),
        (build.ip6(b"x" * 20, 44), 101, "fragments"),
        (build.ip4(b"x" * 20, 47), 101, "not UDP, TCP or ICMP echo"),
        (build.ip4(struct.pack(">BBHHH", 3, 1, 0, 0, 0), 1), 101, "not UDP, TCP or ICMP echo"),
        (build.ip4(b"\0\0\0\0\0", 17), 101, "cut short"),
        (build.ip4(b"\0" * 8, 6), 101, "cut short"),
    ],
)
def test_what_cannot_be_used_has_a_name(packet: bytes, link: int, reason: str) -> None:
    assert of(packet, link) == reason


@given(st.sampled_from(sorted([*build.LINKS, 12, 108, 228, 999])), st.binary(max_size=120))
def test_no_bytes_raise(link: int, data: bytes) -> None:
    assert isinstance(of(data, link), (Datagram, str))


@given(st.integers(0, 60), st.integers(0, 255))
def test_no_changed_byte_raises(at: int, value: int) -> None:
    for packet in (build.ip4(build.tcp(b"abcdef", 1), 6), build.ip6(build.echo(1, v6=True), 58)):
        changed = bytearray(packet)
        changed[at % len(packet)] = value
        assert isinstance(of(bytes(changed)), (Datagram, str))
