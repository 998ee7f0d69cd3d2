"""A bottleneck: token bucket and tail drop, packet by packet in simulated time."""

from __future__ import annotations

from collections import deque

from testbed.scenario.impairments import Rate

_NS_BITS = 8_000_000_000


class Bottleneck:
    """The bucket holds B bytes and fills at r bits/s; a packet of s bytes leaves when the bucket has s, in order.

    Kept is T, the time at which the bucket will be full if nothing more comes: a packet at a makes it
    max(T, a) + 8 s / r, and leaves at T − 8 B / r, but not before a. With B = 0 that is a line of rate r, and the
    packet has left when its last bit has. A packet that comes when the queue is full is dropped and takes no tokens.
    """

    def __init__(self, rate: Rate) -> None:
        self._full_ns = 0
        self._left_ns = 0
        self._queue: deque[tuple[int, int]] = deque()
        self._queued_bytes = 0
        self.change(rate)

    def change(self, rate: Rate) -> None:
        """Another rate, bucket or queue from now on; when what is queued leaves is settled."""
        self._rate = rate
        self._bits, per = rate.bits_per_second.as_integer_ratio()
        self._ns = _NS_BITS * per
        self._depth_ns = self._duration(rate.burst_bytes)
        self._packets = rate.queue_packets
        self._bytes = rate.queue_bytes

    def _duration(self, size: int) -> int:
        """ns in which tokens for ``size`` bytes come, rounded up."""
        return -(-size * self._ns // self._bits)

    def leave(self, size: int, now_ns: int) -> int | None:
        """When a packet that comes now leaves; None if it is dropped."""
        queue = self._queue
        while queue and queue[0][0] <= now_ns:
            self._queued_bytes -= queue.popleft()[1]
        size += self._rate.overhead_bytes
        full_ns = max(self._full_ns, now_ns) + self._duration(size)
        at_ns = max(now_ns, full_ns - self._depth_ns, self._left_ns)
        if at_ns > now_ns:
            if self._packets is not None and len(queue) >= self._packets:
                return None
            if self._bytes is not None and self._queued_bytes + size > self._bytes:
                return None
            queue.append((at_ns, size))
            self._queued_bytes += size
        self._full_ns = full_ns
        self._left_ns = at_ns
        return at_ns
