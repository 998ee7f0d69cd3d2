"""Several small messages in one payload: moving them one by one costs more than what is in them.

Layout: ``NCSB``, uint32 number of messages, then each message behind its length as a uint64, all little-endian.
"""

from __future__ import annotations

from collections.abc import Sequence

MAGIC = b"NCSB"


def bundle(messages: Sequence[bytes]) -> bytes:
    """One payload of the messages in order; a single one stays as it is."""
    if len(messages) == 1:
        return messages[0]
    pieces = [MAGIC, len(messages).to_bytes(4, "little")]
    for message in messages:
        pieces += (len(message).to_bytes(8, "little"), message)
    return b"".join(pieces)


def unbundle(payload: bytes) -> list[bytes]:
    """The messages of a payload. What is not a whole bundle comes back as it is, for the codec to refuse."""
    if payload[:4] != MAGIC:
        return [payload]
    messages, offset = [], 8
    for _ in range(int.from_bytes(payload[4:8], "little")):
        begin = offset + 8
        offset = begin + int.from_bytes(payload[offset:begin], "little")
        if begin > len(payload) or offset > len(payload):
            return [payload]
        messages.append(payload[begin:offset])
    return messages if messages and offset == len(payload) else [payload]
