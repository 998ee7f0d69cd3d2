"""Bit errors of IP packets."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from testbed.channel.kernel.bits import with_flipped_bit


def ipv4(words: int, payload: bytes) -> bytes:
    return bytes([0x40 | words]) + bytes(4 * words - 1) + payload


@given(words=st.integers(5, 15), payload=st.binary(min_size=1, max_size=80), flip=st.integers(0, 2**53 - 1))
def test_one_bit_behind_the_header_differs(words: int, payload: bytes, flip: int) -> None:
    packet = ipv4(words, payload)
    broken = with_flipped_bit(packet, flip)
    assert broken[: 4 * words] == packet[: 4 * words]
    difference = int.from_bytes(broken, "big") ^ int.from_bytes(packet, "big")
    assert len(broken) == len(packet)
    assert difference.bit_count() == 1
    assert with_flipped_bit(broken, flip) == packet


def test_every_bit_of_the_payload_can_be_flipped_and_each_by_one_number() -> None:
    packet = ipv4(5, b"\x0f\xf0\x55")
    assert len({with_flipped_bit(packet, flip) for flip in range(24)}) == 24
    assert with_flipped_bit(packet, 24) == with_flipped_bit(packet, 0) == ipv4(5, b"\x0e\xf0\x55")


@pytest.mark.parametrize("packet", [ipv4(5, b""), ipv4(15, b""), bytes([0x60]) + bytes(39)])
def test_a_packet_without_payload_stays_as_it_is(packet: bytes) -> None:
    assert with_flipped_bit(packet, 3) == packet


def test_of_ipv6_the_header_has_40_bytes() -> None:
    packet = bytes([0x60]) + bytes(39) + b"\0\0"
    assert with_flipped_bit(packet, 8) == packet[:41] + b"\x01"
