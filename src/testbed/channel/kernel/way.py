"""One way between two TUN devices: packets are read from one, and written to the other when their pipeline says so."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import TextIO

from testbed.channel.kernel.bits import with_flipped_bit
from testbed.channel.pipeline import Pipeline
from testbed.channel.schedule import Schedule
from testbed.scenario.trace_file import HEADER

_BATCH = 64
_OVERDUE_NS = 1_000_000


class Way:
    """source, sink: the devices, not blocking. clock: ns since the start of the link. trace: where the rows go.

    overdue: copies that were written more than 1 ms after they were due.
    """

    def __init__(
        self, pipeline: Pipeline, source: int, sink: int, mtu: int, clock: Callable[[], int], trace: TextIO | None
    ) -> None:
        self.pipeline, self.overdue = pipeline, 0
        self._source, self._sink, self._mtu, self._clock = source, sink, mtu, clock
        self._schedule: Schedule[tuple[bytes, int, int]] = Schedule()
        self._trace = trace
        if trace is not None:
            trace.write(",".join(HEADER) + "\n")

    @property
    def next_ns(self) -> int | None:
        """When something is to be written."""
        return self._schedule.next_ns

    def take(self) -> None:
        """Read what has come, a batch at most, and write what is due at once."""
        read, clock, source, mtu, schedule = os.read, self._clock, self._source, self._mtu, self._schedule
        pipeline, trace = self.pipeline, self._trace
        send = pipeline.send
        for _ in range(_BATCH):
            try:
                packet = read(source, mtu)
            except BlockingIOError:
                return
            now_ns = clock()
            copies = send(len(packet), now_ns)
            if trace is not None and not copies:
                trace.write(f"{pipeline.sent - 1},{now_ns},\n")
            for copy in copies:
                arriving = packet if copy.flip is None else with_flipped_bit(packet, copy.flip)
                at_ns = copy.at_ns
                if at_ns <= now_ns and (not schedule or at_ns < (schedule.next_ns or 0)):
                    self._write(arriving, pipeline.sent - 1, now_ns, now_ns)
                else:
                    schedule.push(at_ns, (arriving, pipeline.sent - 1, now_ns))

    def release(self) -> None:
        """Write what is due."""
        now_ns = self._clock()
        for at_ns, (packet, number, sent_ns) in self._schedule.due(now_ns):
            if now_ns - at_ns > _OVERDUE_NS:
                self.overdue += 1
            self._write(packet, number, sent_ns, now_ns)

    def end(self) -> None:
        """Complete the trace: a packet in flight gets the time at which it would have arrived."""
        if self._trace is not None:
            for at_ns, (_, number, sent_ns) in self._schedule.due(2**63):
                self._trace.write(f"{number},{sent_ns},{at_ns}\n")
            self._trace.close()

    def _write(self, packet: bytes, number: int, sent_ns: int, now_ns: int) -> None:
        books = self.pipeline.books
        try:
            os.write(self._sink, packet)
        except OSError:  # the host has taken its device down, or the packet is broken
            books.drop("refused")
            if self._trace is not None:
                self._trace.write(f"{number},{sent_ns},\n")
            return
        books.delivered += 1
        if self._trace is not None:
            self._trace.write(f"{number},{sent_ns},{now_ns}\n")


def clock_from_now() -> Callable[[], int]:
    """ns of the monotonic clock since this call."""
    monotonic_ns = time.monotonic_ns
    start_ns = monotonic_ns()
    return lambda: monotonic_ns() - start_ns
