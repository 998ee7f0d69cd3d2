"""Bit errors of IP packets: behind the IP header, so that they travel, and the checksum there finds them."""

from __future__ import annotations

from testbed.channel.flips import flipped


def with_flipped_bit(packet: bytes, flip: int) -> bytes:
    """The packet with bit ``flip`` mod (number of bits behind the IP header) flipped; bit 0 is the first byte's lowest.

    A packet of nothing but its header stays as it is.
    """
    head = 40 if packet[0] >> 4 == 6 else 4 * (packet[0] & 0x0F)
    return flipped(packet, flip, head)
