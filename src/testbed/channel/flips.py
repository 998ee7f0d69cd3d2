"""Bit errors of packets."""

from __future__ import annotations


def flipped(data: bytes, flip: int, head: int = 0) -> bytes:
    """``data`` with one bit behind its first ``head`` bytes flipped: bit number flip mod (number of bits there).

    Bit 0 is the lowest of the first byte there. Where there is none, ``data`` itself.
    """
    bits = 8 * (len(data) - head)
    if bits <= 0:
        return data
    byte, bit = divmod(flip % bits, 8)
    changed = bytearray(data)
    changed[head + byte] ^= 1 << bit
    return bytes(changed)
