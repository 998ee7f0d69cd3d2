"""One TCP connection through the proxy: from a client to the proxy, and from the proxy to the target."""

from __future__ import annotations

import errno
import socket
import struct
from collections.abc import Callable
from functools import partial
from typing import Any

from testbed.channel.pipeline import Pipeline
from testbed.channel.sockets.link import Direction
from testbed.channel.sockets.loop import READ, WRITE, Loop
from testbed.channel.sockets.stream import Stream
from testbed.channel.sockets.tracing import TraceWriter

LINGER_NOT = struct.pack("ii", 1, 0)
"""A socket with this as SO_LINGER sends a RST when it is closed."""


class Connection:
    """Two streams between two sockets. ``gone(connection, reset)`` is called once, when it has ended."""

    def __init__(
        self,
        client: socket.socket,
        upstream: socket.socket,
        loop: Loop,
        pipelines: dict[Direction, Pipeline],
        traces: dict[Direction, TraceWriter],
        held_max: int,
        gone: Callable[[Connection, bool], None],
    ) -> None:
        self._client, self._upstream, self._loop, self._gone = client, upstream, loop, gone
        self.connected = False
        self.streams: dict[Direction, Stream] = {
            "forward": Stream(client, upstream, pipelines["forward"], traces.get("forward"), held_max),
            "backward": Stream(upstream, client, pipelines["backward"], traces.get("backward"), held_max),
        }
        forward, backward = self.streams["forward"], self.streams["backward"]
        self._ends = {client: (forward, backward), upstream: (backward, forward)}
        """Each socket with the stream that reads from it and the one that writes to it."""
        self._masks = {client: 0, upstream: 0}

    def connect(self, target: Any) -> None:
        """Begin to connect to the target; nothing is read from the client before that is done."""
        error = self._upstream.connect_ex(target)
        if error == 0:
            self._opened()
        elif error == errno.EINPROGRESS:
            self._loop.watch(self._upstream.fileno(), self._attempted, WRITE)
        else:
            self.reset()

    def move(self, direction: Direction, now_ns: int, stalled_ns: int) -> None:
        """Hand on what is due in a direction that was stalled until ``stalled_ns``."""
        stream = self.streams[direction]
        if stream.move(now_ns, stalled_ns):
            self._guarded(lambda: stream.write(now_ns))

    def reset(self) -> None:
        """Break off: both ends get a RST, and what is on its way is dropped."""
        for stream in self.streams.values():
            stream.discard()
        for each in (self._client, self._upstream):
            each.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, LINGER_NOT)
        self.close()
        self._gone(self, True)

    def close(self) -> None:
        """Close both ends; what is on its way stays in flight."""
        for each in (self._client, self._upstream):
            self._loop.forget(each.fileno())
            each.close()

    def _attempted(self, _: int) -> None:
        if self._upstream.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
            self.reset()
        else:
            self._opened()

    def _opened(self) -> None:
        self.connected = True
        for each in (self._client, self._upstream):
            each.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._rearm()

    def _ready(self, each: socket.socket, mask: int) -> None:
        reads, writes = self._ends[each]
        now_ns = self._loop.now_ns

        def act() -> None:
            if mask & WRITE:
                writes.write(now_ns)
            if mask & READ and reads.reads:
                reads.read(now_ns)

        self._guarded(act)

    def _guarded(self, act: Callable[[], None]) -> None:
        """A socket that broke breaks the whole connection; what is left decides what the sockets are watched for."""
        try:
            act()
        except OSError:
            self.reset()
            return
        if all(stream.shut for stream in self.streams.values()):
            self.close()
            self._gone(self, False)
            return
        self._rearm()

    def _rearm(self) -> None:
        """A socket from which nothing is wanted is not watched: its hang-up would be reported again and again."""
        for each, (reads, writes) in self._ends.items():
            mask = (READ if reads.reads else 0) | (WRITE if writes.writes else 0)
            if mask == self._masks[each]:
                continue
            self._masks[each] = mask
            if mask:
                self._loop.watch(each.fileno(), partial(self._ready, each), mask)
            else:
                self._loop.forget(each.fileno())
