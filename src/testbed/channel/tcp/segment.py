"""What the two ends of a connection send each other. Offsets count the bytes of the stream from 0."""

from __future__ import annotations

from typing import NamedTuple


class Segment:
    """Bytes ``start`` … ``end`` − 1 that were sent and not yet acknowledged, as the sender keeps them.

    sacked: the receiver has reported it. lost: it is taken for lost. resent: a retransmission of it is on its way.
    ever: it was retransmitted at some time, so that its round trip is ambiguous. sent_ns: when it was last sent.
    """

    __slots__ = ("end", "ever", "lost", "resent", "sacked", "sent_ns", "start")

    def __init__(self, start: int, end: int, sent_ns: int) -> None:
        self.start, self.end, self.sent_ns = start, end, sent_ns
        self.sacked = self.lost = self.resent = self.ever = False


class Data(NamedTuple):
    """A data segment on its way. stamp: the sender's clock, ms (RFC 7323)."""

    start: int
    end: int
    stamp: int


class Ack(NamedTuple):
    """An acknowledgement on its way.

    upto: all bytes before it have arrived. echo: the stamp that it echoes, ms. blocks: ranges that arrived beyond, the
    one that changed last first (RFC 2018). duplicate: a range that arrived again (RFC 2883).
    """

    upto: int
    echo: int
    blocks: tuple[tuple[int, int], ...] = ()
    duplicate: tuple[int, int] | None = None


def stamp(now_ns: int) -> int:
    """The clock of the time stamps: whole milliseconds."""
    return now_ns // 1_000_000
