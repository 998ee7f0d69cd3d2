"""One direction of a link over real sockets: its pipeline, and the packets that are on their way."""

from __future__ import annotations

from collections.abc import Callable

from testbed.channel.flips import flipped
from testbed.channel.pipeline import Pipeline
from testbed.channel.schedule import Schedule
from testbed.channel.sockets.loop import OVERDUE_NS
from testbed.channel.sockets.tracing import TraceWriter

Send = Callable[[bytes], object]
"""Hands a packet to a socket. Raises OSError."""

_PACKET_BYTES = 512  # what a packet on its way needs besides its content


class Way:
    """Takes packets, and hands each to its socket when the pipeline says, in the books of the pipeline.

    Causes of drops beyond those of the pipeline: "overflow", when more is on its way than ``held_max`` bytes;
    "socket", when the socket refuses the packet; "corrupt", where checksums are looked at.
    unreachable: how often the system reported that nobody listened. overdue: copies handed on more than 1 ms late.
    """

    def __init__(self, pipeline: Pipeline, trace: TraceWriter | None, held_max: int, checksummed: bool = False) -> None:
        self.pipeline, self.trace = pipeline, trace
        self.unreachable = self.overdue = 0
        self._schedule: Schedule[tuple[int, int, bytes, Send]] = Schedule()
        self._held, self._held_max = 0, held_max
        self._checksummed = checksummed

    @property
    def held_packets(self) -> int:
        return len(self._schedule)

    def take(self, data: bytes, send: Send, now_ns: int) -> None:
        """A packet that came now, to be handed to ``send``."""
        pipeline = self.pipeline
        number = pipeline.sent
        copies = pipeline.send(len(data), now_ns)
        if not copies and self.trace is not None:
            self.trace.lost(number, now_ns)
        for copy in copies:
            if self._checksummed and copy.flip is not None:
                self._drop("corrupt", number, now_ns)
                continue
            content = data if copy.flip is None else flipped(data, copy.flip)
            at_ns, next_ns = copy.at_ns, self._schedule.next_ns
            if at_ns <= now_ns and (next_ns is None or at_ns < next_ns):
                self._deliver(number, now_ns, content, send, now_ns)
            elif self._held > self._held_max:
                self._drop("overflow", number, now_ns)
            else:
                self._held += len(content) + _PACKET_BYTES
                self._schedule.push(at_ns, (number, now_ns, content, send))

    def due(self, now_ns: int) -> int | None:
        """Deliver what is due; when the next packet is, None if there is none."""
        schedule = self._schedule
        next_ns = schedule.next_ns
        if next_ns is None or next_ns > now_ns:
            return next_ns
        for at_ns, (number, sent_ns, data, send) in schedule.due(now_ns):
            self.overdue += now_ns - at_ns > OVERDUE_NS
            self._held -= len(data) + _PACKET_BYTES
            self._deliver(number, sent_ns, data, send, now_ns)
        return schedule.next_ns

    def end(self) -> None:
        """Leave what is in flight in flight; the trace has it as delivered when it would have been."""
        if self.trace is None:
            return
        for at_ns, (number, sent_ns, _, _) in self._schedule.due(_FOREVER_NS):
            self.trace.delivered(number, sent_ns, at_ns)

    def _deliver(self, number: int, sent_ns: int, data: bytes, send: Send, now_ns: int) -> None:
        try:
            try:
                send(data)
            except ConnectionRefusedError:  # of an earlier packet: this one was not tried yet
                self.unreachable += 1
                send(data)
        except OSError:
            self._drop("socket", number, sent_ns)
            return
        self.pipeline.books.delivered += 1
        if self.trace is not None:
            self.trace.delivered(number, sent_ns, now_ns)

    def _drop(self, cause: str, number: int, sent_ns: int) -> None:
        self.pipeline.books.drop(cause)
        if self.trace is not None:
            self.trace.lost(number, sent_ns)


_FOREVER_NS = 2**65
