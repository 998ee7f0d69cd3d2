"""A link as a TCP proxy: it delays, limits the rate, stalls and resets; it cannot lose."""

from __future__ import annotations

import socket
from collections.abc import Sequence
from pathlib import Path

from testbed.channel.schedule import Schedule
from testbed.channel.sockets.connection import LINGER_NOT, Connection
from testbed.channel.sockets.endpoints import Endpoint
from testbed.channel.sockets.link import COMPONENTS, DIRECTIONS, Direction, SocketLink
from testbed.channel.sockets.listening import listening
from testbed.channel.sockets.outages import Outage
from testbed.errors import UsageError
from testbed.scenario.links import Impairments

_BACKLOG = 128
_PAUSE_NS = 100_000_000
_INSTEAD = (
    "a TCP proxy carries bytes that must all arrive, once and in order; "
    "allowed: rate without a queue's limits, delay; what TCP makes of the rest: the tcp model, or the kernel backend"
)


class TcpProxy(SocketLink):
    """Carries the bytes of each connection to ``target`` and back, every chunk of up to 1448 bytes as one packet.

    Order is kept: a chunk waits for those before it. Packets are numbered over all connections, and share one rate.
    A connection that holds more than ``held_max`` bytes in a direction is not read from, so that its sender waits.
    Connections beyond ``connections_max`` are reset and counted.

    Raises UsageError where the address cannot be had, or for impairments that a proxy cannot express.
    """

    def __init__(
        self,
        target: tuple[str, int],
        *,
        forward: Impairments | None = None,
        backward: Impairments | None = None,
        seed: int = 0,
        components: tuple[str, str] = COMPONENTS,
        listen: tuple[str, int] = ("127.0.0.1", 0),
        outages: Sequence[Outage] = (),
        connections_max: int = 64,
        held_max: int = 2**20,
        traces: dict[Direction, Path] | None = None,
    ) -> None:
        self._family, self._target = Endpoint("tcp", *target).resolve()
        self._listener = listening(Endpoint("tcp", *listen), socket.SOCK_STREAM)
        self.address = self._listener.getsockname()[:2]
        self._connections: list[Connection] = []
        self._connections_max, self._held_max = connections_max, held_max
        self._accepted = self._refused = self._resets = self._unreachable = self._overdue = 0
        self._stalled_ns: dict[Direction, int] = dict.fromkeys(DIRECTIONS, 0)
        self._closed_ns: int | None = None
        self._outages: Schedule[Outage] = Schedule()
        for outage in outages:
            self._outages.push(outage.at_ns, outage)
        try:
            super().__init__(
                "tcp proxy", (forward or Impairments(), backward or Impairments()), seed, components, traces
            )
        except BaseException:
            self._listener.close()
            raise
        self._open()

    @staticmethod
    def check(settings: Impairments) -> None:
        if settings.loss.kind != "none":
            raise UsageError(f"loss: got {settings.loss.kind!r}; {_INSTEAD}")
        if not settings.up:
            raise UsageError(f"up: got false; {_INSTEAD}")
        for key in ("reorder", "duplicate", "corrupt"):
            if getattr(settings, key) is not None:
                raise UsageError(f"{key}: {_INSTEAD}")
        rate = settings.rate
        for key in ("queue_packets", "queue_bytes"):
            if rate is not None and getattr(rate, key) is not None:
                raise UsageError(f"rate.{key}: got {getattr(rate, key)}; {_INSTEAD}")

    def stall(self, for_ns: int, directions: Sequence[Direction] = DIRECTIONS) -> None:
        """Hand nothing on for so long; senders are held back once the buffers are full. From any thread."""
        self._loop.call(lambda: self._stall(for_ns, directions))

    def reset(self, refuse_ns: int = 0) -> None:
        """Reset every connection at both ends, and refuse new ones for so long. From any thread."""
        self._loop.call(lambda: self._reset(refuse_ns))

    def _stall(self, for_ns: int, directions: Sequence[Direction]) -> None:
        until_ns = self._loop.now_ns + for_ns
        for direction in directions:
            self._stalled_ns[direction] = max(until_ns, self._stalled_ns[direction])

    def _reset(self, refuse_ns: int) -> None:
        for connection in tuple(self._connections):
            connection.reset()
        if refuse_ns <= 0:
            return
        until_ns = self._loop.now_ns + refuse_ns
        if self._closed_ns is None:
            self._loop.forget(self._listener.fileno())
            self._listener.shutdown(socket.SHUT_RD)  # it listens no more, and keeps its port
            self._closed_ns = until_ns
        self._closed_ns = max(until_ns, self._closed_ns)

    def _open(self) -> None:
        self._listener.listen(_BACKLOG)
        self._closed_ns = None
        self._loop.watch(self._listener.fileno(), self._accept)

    def _accept(self, _: int) -> None:
        try:
            client, _ = self._listener.accept()
        except BlockingIOError:
            return
        except OSError:
            self._pause()
            return
        try:
            upstream = socket.socket(self._family, socket.SOCK_STREAM)
        except OSError:
            self._refuse(client)
            self._pause()
            return
        if len(self._connections) >= self._connections_max:
            upstream.close()
            self._refuse(client)
            return
        for each in (client, upstream):
            each.setblocking(False)
        connection = Connection(client, upstream, self._loop, self._pipelines, self._traces, self._held_max, self._gone)
        self._connections.append(connection)
        self._accepted += 1
        connection.connect(self._target)

    def _refuse(self, client: socket.socket) -> None:
        self._refused += 1
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, LINGER_NOT)
        client.close()

    def _pause(self) -> None:
        """The system has no socket left: try again soon, and do not spin."""
        self._loop.forget(self._listener.fileno())
        self._closed_ns = self._loop.now_ns + _PAUSE_NS

    def _gone(self, connection: Connection, reset: bool) -> None:
        self._connections.remove(connection)
        self._overdue += _overdue(connection)
        if not connection.connected:
            self._unreachable += 1
        elif reset:
            self._resets += 1

    def _due(self, now_ns: int) -> int | None:
        for _, outage in self._outages.due(now_ns):
            if outage.kind == "stall":
                self._stall(outage.for_ns, DIRECTIONS)
            else:
                self._reset(outage.for_ns)
        if self._closed_ns is not None and self._closed_ns <= now_ns:
            self._open()
        times = [self._outages.next_ns, self._closed_ns]
        for direction in DIRECTIONS:
            stalled_ns = self._stalled_ns[direction]
            for connection in tuple(self._connections):
                if stalled_ns <= now_ns:
                    connection.move(direction, now_ns, stalled_ns)
                next_ns = connection.streams[direction].next_ns
                times.append(None if next_ns is None else max(next_ns, stalled_ns))
        return min((at_ns for at_ns in times if at_ns is not None), default=None)

    def _around(self) -> dict[str, int]:
        return {
            "connections": len(self._connections),
            "accepted": self._accepted,
            "refused": self._refused,
            "unreachable": self._unreachable,
            "resets": self._resets,
            "overdue": self._overdue + sum(map(_overdue, self._connections)),
        }

    def _held(self, direction: Direction) -> int:
        return sum(connection.streams[direction].held_packets for connection in self._connections)

    def _close_sockets(self) -> None:
        self._listener.close()
        for connection in self._connections:
            connection.close()

    def _end(self) -> None:
        for connection in self._connections:
            for stream in connection.streams.values():
                stream.end()


def _overdue(connection: Connection) -> int:
    return sum(stream.overdue for stream in connection.streams.values())
