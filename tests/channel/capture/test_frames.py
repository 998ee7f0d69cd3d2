"""Capture files: every form gives the same frames, a cut one what is whole, a corrupt one a line."""

from __future__ import annotations

import io
import struct
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from channel.capture import build
from channel.capture.build import Taken
from testbed.channel.capture.frames import Capture, is_capture
from testbed.errors import UsageError

TAKEN = [Taken(1_700_000_000 * 10**9 + k * 1_234_567_000, bytes(range(k + 20))) for k in range(5)]


def read(data: bytes) -> tuple[list[Taken], Capture]:
    capture = Capture(io.BytesIO(data), "x.pcap")
    return [Taken(frame.at_ns, frame.data) for frame in capture], capture


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("nano", [True, False])
def test_pcap(order: str, nano: bool) -> None:
    data = build.pcap(TAKEN, order=order, nano=nano)
    assert is_capture(data)
    assert read(data)[0] == TAKEN


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("resolution", [6, 9])
def test_pcapng(order: str, resolution: int) -> None:
    data = build.pcapng(TAKEN, order=order, resolution=resolution)
    assert is_capture(data)
    assert read(data)[0] == TAKEN


def test_pcapng_in_binary_fractions_of_a_second() -> None:
    frames, _ = read(build.pcapng(TAKEN, resolution=0x80 | 20))
    assert [frame.data for frame in frames] == [frame.data for frame in TAKEN]
    assert all(0 <= a.at_ns - b.at_ns < 10**9 / 2**20 for a, b in zip(TAKEN, frames, strict=True))


def test_pcapng_with_all_it_may_hold() -> None:
    """An offset of the clock, microseconds where nothing is said, two interfaces, other blocks, a second section."""
    first, second, third = TAKEN[:3]
    data = (
        build.section()
        + build.block(0x0BAD, b"something else")
        + build.interface(1, offset_s=1000)
        + build.interface(101, resolution=9)
        + build.packet(Taken(first.at_ns - 1000 * 10**9, first.data))
        + build.packet(second, units=10**9, number=1)
        + build.block(3, struct.pack("<I", 4) + b"abcd")
        + build.section(">")
        + build.interface(1, order=">")
        + build.packet(third, order=">")
    )
    frames, capture = read(data)
    assert frames == [first, second, third]
    assert (capture.untimed, capture.cut) == (1, False)


def test_the_obsolete_packet_block() -> None:
    head = struct.pack("<HHIIII", 0, 9, 0, 5_000_000, 3, 3)
    frames, _ = read(build.section() + build.interface(1) + build.block(2, head + b"abc"))
    assert frames == [Taken(5 * 10**9, b"abc")]


@pytest.mark.parametrize("data", [build.pcap(TAKEN), build.pcapng(TAKEN)], ids=["pcap", "pcapng"])
def test_a_cut_file_gives_what_is_whole(data: bytes) -> None:
    seen = set()
    for end in range(48, len(data)):
        frames, capture = read(data[:end])
        assert frames == TAKEN[: len(frames)]
        seen.add((len(frames), capture.cut))
    assert seen >= {(count, True) for count in range(5)}


@pytest.mark.parametrize(
    ("data", "error"),
    [
        (b"", "got a file that begins with nothing; allowed: pcap or pcapng"),
        (b"hello", "got a file that begins with 68656c6c"),
        (build.pcap(TAKEN)[:20], "got a pcap header of less than 24 bytes"),
        (build.pcap([]) + struct.pack("<IIII", 0, 0, 2**31, 0), "got a frame of 2147483648 bytes; allowed: 1048576"),
        (build.pcap([]) + struct.pack("<IIII", 0, 2**31, 0, 0), "beyond the second; allowed: less than"),
        (build.section() + build.packet(TAKEN[0]), "got a packet of interface 0; allowed: 0 … of 0"),
        (build.section() + struct.pack("<II", 6, 2**30), "got a block of 1073741816 bytes; allowed: 16777216"),
        (build.section() + struct.pack("<III", 6, 13, 13), "got a block of 13 bytes; allowed: a multiple of 4"),
        (build.section() + struct.pack("<III", 6, 12, 16), "got a block whose two lengths differ"),
        (build.section() + build.block(1, b"abcd"), "got an interface block of 16 bytes"),
        (build.section() + build.interface(1, resolution=30), "got times in units of 0x1e"),
        (build.section() + build.interface(1) + build.block(6, b"abcd"), "got a packet block of 16 bytes"),
        (struct.pack("<III", 0x0A0D0D0A, 28, 7), "got a section with the byte order 07000000"),
    ],
)
def test_a_corrupt_file_is_a_line(data: bytes, error: str) -> None:
    with pytest.raises(UsageError, match=r"^x\.pcap: ") as raised:
        read(data)
    assert error in str(raised.value)
    assert "\n" not in str(raised.value)


@given(st.sampled_from([build.pcap(TAKEN), build.pcapng(TAKEN)]), st.data())
def test_flipped_bytes_raise_nothing_else(data: bytes, draw: st.DataObject) -> None:
    changed = bytearray(data)
    for _ in range(draw.draw(st.integers(1, 6))):
        changed[draw.draw(st.integers(0, len(data) - 1))] = draw.draw(st.integers(0, 255))
    with suppress(UsageError):
        frames, _ = read(bytes(changed))
        assert sum(len(frame.data) for frame in frames) <= len(data)
