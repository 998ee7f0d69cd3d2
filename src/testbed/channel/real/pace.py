"""The pace of a run in real time, kept where its packets begin: at the control link."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Any

from numpy.typing import NDArray

from testbed.channel.real.timer import Timer
from testbed.wire.messages import Packet
from testbed.wire.node import Node

Arrays = dict[str, NDArray[Any]]
Handler = Callable[[Any, Arrays], None]


class Pace:
    """A handler of packets that lets packet i + j through no earlier than j periods after packet i, the first to come.

    behind: packets that came through more than a period after their turn.
    """

    def __init__(self, node: Node, timer: Timer, period_ns: int, handler: Handler) -> None:
        self.behind = 0
        self._node, self._timer, self._period_ns, self._handler = node, timer, period_ns, handler
        self._queue: deque[tuple[Packet, Arrays, bytes]] = deque()
        self._start_ns: int | None = None

    def __call__(self, packet: Packet, arrays: Arrays) -> None:
        self._queue.append((packet, arrays, self._node.payload))
        if len(self._queue) == 1:
            self._let_through()

    def _let_through(self) -> None:
        """Those whose turn has come; for the next one, come back."""
        queue, now_ns = self._queue, time.monotonic_ns()
        if self._start_ns is None:
            first, _, _ = queue[0]
            self._start_ns = now_ns - (first.step - first.FIRST_STEP) * self._period_ns
        while queue:
            packet, arrays, message = queue[0]
            turn_ns = self._start_ns + (packet.step - packet.FIRST_STEP) * self._period_ns
            if turn_ns > now_ns:
                self._timer.at(turn_ns, self._let_through)
                return
            queue.popleft()
            self.behind += now_ns - turn_ns > self._period_ns
            self._node.payload = message
            self._handler(packet, arrays)
