"""One direction of one TCP connection through the proxy: chunks on their way from a source to a sink, in order."""

from __future__ import annotations

import socket
from collections import deque
from dataclasses import dataclass

from testbed.channel.pipeline import Pipeline
from testbed.channel.sockets.loop import OVERDUE_NS
from testbed.channel.sockets.tracing import TraceWriter

_SEGMENT = 1448  # bytes that one packet of a connection over Ethernet carries
_CHUNK_BYTES = 512  # what a chunk on its way needs besides its content
_READ = 64 * 1024
_BUFFERS_MAX = 64


@dataclass(slots=True)
class Chunk:
    """Bytes that are one packet to the pipeline; no bytes: the end of the stream."""

    number: int
    sent_ns: int
    data: memoryview
    at_ns: int


class Stream:
    """Chunks from ``source``: on their way until they are due, then ``out`` until the system took them for ``sink``.

    It reads no more while it holds ``held_max`` bytes, so that the sender is held back.
    """

    def __init__(
        self,
        source: socket.socket,
        sink: socket.socket,
        pipeline: Pipeline,
        trace: TraceWriter | None,
        held_max: int,
    ) -> None:
        self.source, self.sink = source, sink
        self._pipeline, self._trace = pipeline, trace
        self._held, self._held_max = 0, held_max
        self._latest_ns = 0
        self._way: deque[Chunk] = deque()
        self._out: deque[Chunk] = deque()
        self.overdue = 0
        """Chunks handed on more than 1 ms late."""
        self.ended = False
        """The source sent the end of its stream."""
        self.shut = False
        """The sink was told."""

    @property
    def reads(self) -> bool:
        """Whether it takes more from the source."""
        return not self.ended and self._held < self._held_max

    @property
    def writes(self) -> bool:
        """Whether it waits for the sink to take more."""
        return bool(self._out)

    @property
    def next_ns(self) -> int | None:
        return self._way[0].at_ns if self._way else None

    @property
    def held_packets(self) -> int:
        return sum(len(chunk.data) > 0 for chunks in (self._way, self._out) for chunk in chunks)

    def read(self, now_ns: int) -> None:
        """Take what the source has. Raises OSError where the connection is broken."""
        try:
            data = memoryview(self.source.recv(_READ))
        except BlockingIOError:
            return
        if not data:
            self.ended = True
            self._latest_ns = max(now_ns, self._latest_ns)
            self._way.append(Chunk(-1, now_ns, data, self._latest_ns))
            return
        for start in range(0, len(data), _SEGMENT):
            chunk = data[start : start + _SEGMENT]
            number = self._pipeline.sent
            (copy,) = self._pipeline.send(len(chunk), now_ns)
            self._latest_ns = max(copy.at_ns, self._latest_ns)
            self._way.append(Chunk(number, now_ns, chunk, self._latest_ns))
            self._held += len(chunk) + _CHUNK_BYTES

    def move(self, now_ns: int, stalled_ns: int) -> bool:
        """Hand on what is due, with a stall until ``stalled_ns`` behind us; whether there was any."""
        if not self._way or self._way[0].at_ns > now_ns:
            return False
        while self._way and self._way[0].at_ns <= now_ns:
            chunk = self._way.popleft()
            self.overdue += now_ns - max(chunk.at_ns, stalled_ns) > OVERDUE_NS
            self._out.append(chunk)
        return True

    def write(self, now_ns: int) -> None:
        """Give the sink what it takes. Raises OSError where the connection is broken."""
        out = self._out
        while out:
            if not out[0].data:
                out.popleft()
                self.sink.shutdown(socket.SHUT_WR)
                self.shut = True
                return
            try:
                taken = self.sink.sendmsg([chunk.data for chunk, _ in zip(out, range(_BUFFERS_MAX), strict=False)])
            except BlockingIOError:
                return
            while taken:
                chunk = out[0]
                if taken < len(chunk.data):
                    chunk.data = chunk.data[taken:]
                    self._held -= taken
                    return
                taken -= len(chunk.data)
                self._held -= len(chunk.data) + _CHUNK_BYTES
                out.popleft()
                self._pipeline.books.delivered += 1
                if self._trace is not None:
                    self._trace.delivered(chunk.number, chunk.sent_ns, now_ns)

    def discard(self) -> None:
        """Drop all that is held, since the connection was reset."""
        for chunk in (*self._out, *self._way):
            if chunk.data:
                self._pipeline.books.drop("reset")
                if self._trace is not None:
                    self._trace.lost(chunk.number, chunk.sent_ns)
        self._out.clear()
        self._way.clear()
        self._held = 0

    def end(self) -> None:
        """Write what is in flight into the trace, as delivered when it would have been."""
        for chunk in (*self._out, *self._way):
            if chunk.data and self._trace is not None:
                self._trace.delivered(chunk.number, chunk.sent_ns, chunk.at_ns)
