"""The receiving end: puts the stream in order and acknowledges it."""

from __future__ import annotations

from collections.abc import Callable

from testbed.channel.tcp.segment import Ack, Data

BLOCKS_MAX = 3  # of a SACK option beside a time stamp
_QUICK = 16  # acknowledgements that are not delayed when a connection is new, or a segment came twice


class Receiver:
    """acknowledge: called with each `Ack` and the time.

    A segment out of order, one that came before and one that fills a gap are acknowledged at once (RFC 5681, 4.2).
    Others, with ``delay_ns`` = 0, too: Linux does that when the application reads each small segment at once and sends
    nothing back. Else every second one is, or what is there when ``delay_ns`` is over.

    With ``keep_alive_ns`` they are delayed only as long as Linux takes the connection for a conversation: it does when
    data is sent back, which happens so often, and no longer does when a segment came that had been acknowledged before.

    The time stamp that is echoed is the latest of a segment that touches the last acknowledgement (RFC 7323, 4.3). One
    that ends before it is refused unread (RFC 9293, 3.10.7.4): its acknowledgement has an older stamp, and the sender
    measures a round trip as long as the silence before it.
    """

    def __init__(self, delay_ns: int, acknowledge: Callable[[Ack, int], None], keep_alive_ns: int = 0) -> None:
        self.expected = 0
        self.deadline_ns: int | None = None
        self._delay_ns, self._keep_alive_ns, self._send = delay_ns, keep_alive_ns, acknowledge
        self._talks_ns: int | None = None  # when data is sent back next; until then nothing is delayed
        self._ranges: list[tuple[int, int]] = []  # beyond `expected`, the one that changed last first
        self._told = 0
        self._stamp = 0
        self._waiting = 0
        self._quick = _QUICK

    def segment(self, data: Data, now_ns: int) -> bool:
        """Take in a segment; True if more of the stream is in order now."""
        start, end, stamp = data
        expected = self.expected
        if start <= self._told <= end and stamp > self._stamp:
            self._stamp = stamp
        duplicate: tuple[int, int] | None = None
        if start > expected:
            self._acknowledge(now_ns, self._insert(start, end))
            return False
        if end <= expected:
            self._quick, self._talks_ns = _QUICK, None
            self._acknowledge(now_ns, (start, end))
            return False
        if start < expected:
            duplicate = (start, expected)
        self.expected = end
        gap = bool(self._ranges)
        if gap:
            duplicate = self._join() or duplicate
        if gap or duplicate is not None or not self._delay_ns:
            self._acknowledge(now_ns, duplicate)
        else:
            self._delay(now_ns)
        return True

    def timeout(self, now_ns: int) -> None:
        """The delay of an acknowledgement is over."""
        self._acknowledge(now_ns, None)

    def _delay(self, now_ns: int) -> None:
        self._waiting += 1
        if self._keep_alive_ns and self._talks_ns is None:
            self._talks_ns = (now_ns // self._keep_alive_ns + 1) * self._keep_alive_ns
        if self._quick > 0 or self._waiting >= 2 or now_ns < (self._talks_ns or 0):
            self._quick -= 1
            self._acknowledge(now_ns, None)
        else:
            self.deadline_ns = now_ns + self._delay_ns

    def _acknowledge(self, now_ns: int, duplicate: tuple[int, int] | None) -> None:
        self._told = self.expected
        self._waiting, self.deadline_ns = 0, None
        blocks = self._ranges[: BLOCKS_MAX - (duplicate is not None)] if self._ranges else ()
        self._send(Ack(self.expected, self._stamp, tuple(blocks), duplicate), now_ns)

    def _insert(self, start: int, end: int) -> tuple[int, int] | None:
        """Keep a range beyond a gap; returns what of it had come before."""
        duplicate: tuple[int, int] | None = None
        kept = []
        for low, high in self._ranges:
            if high < start or low > end:
                kept.append((low, high))
                continue
            if max(low, start) < min(high, end):
                duplicate = (max(low, start), min(high, end))
            start, end = min(low, start), max(high, end)
        self._ranges = [(start, end), *kept]
        return duplicate

    def _join(self) -> tuple[int, int] | None:
        """Ranges that the stream in order has reached become part of it; returns what of the first came twice."""
        duplicate: tuple[int, int] | None = None
        for low, high in sorted(self._ranges):
            if low > self.expected:
                break
            if low < self.expected and duplicate is None:
                duplicate = (low, min(high, self.expected))
            self.expected = max(self.expected, high)
        self._ranges = [block for block in self._ranges if block[0] > self.expected]
        return duplicate
