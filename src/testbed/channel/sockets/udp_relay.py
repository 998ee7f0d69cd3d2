"""A link as a UDP relay: between clients and a target, one thread, what the pipelines say in wall time."""

from __future__ import annotations

import socket
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from testbed.channel.sockets.buffers import dropped_by_kernel, enlarge
from testbed.channel.sockets.endpoints import Endpoint
from testbed.channel.sockets.link import COMPONENTS, DIRECTIONS, Direction, SocketLink
from testbed.channel.sockets.listening import listening
from testbed.channel.sockets.way import Send, Way
from testbed.scenario.links import Impairments

_BATCH = 64  # packets read from one socket before the others and the time get their turn
_SIZE_MAX = 65535
_HELD_MAX = 256 * 2**20  # bytes on their way in a direction


@dataclass(slots=True)
class _Client:
    """A source address, and the socket through which the target knows it."""

    upstream: socket.socket
    up: Send
    down: Send
    last_ns: int


class UdpRelay(SocketLink):
    """Relays datagrams from any client to ``target`` and back; each client gets a socket and port of its own.

    The packets of a direction are numbered over all clients. Beyond ``clients_max`` clients a new one takes the place
    of the one that was silent longest, if that was ``idle_ns`` or longer; else its packets are refused and counted.
    checksummed: a corrupted packet is dropped, as the UDP of its receiver would, instead of handed on.

    Raises UsageError where the address cannot be had.
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
        clients_max: int = 64,
        idle_ns: int = 60_000_000_000,
        checksummed: bool = False,
        traces: dict[Direction, Path] | None = None,
    ) -> None:
        self._family, self._target = Endpoint("udp", *target).resolve()
        self._listener = listening(Endpoint("udp", *listen), socket.SOCK_DGRAM)
        self.address = self._listener.getsockname()[:2]
        enlarge(self._listener)
        self._clients: dict[Any, _Client] = {}
        self._clients_max, self._idle_ns = clients_max, idle_ns
        self._refused = self._replaced = self._kernel_dropped = 0
        try:
            super().__init__(
                "udp relay", (forward or Impairments(), backward or Impairments()), seed, components, traces
            )
        except BaseException:
            self._listener.close()
            raise
        self._ways = {
            way: Way(self._pipelines[way], self._traces.get(way), _HELD_MAX, checksummed) for way in DIRECTIONS
        }
        self._forward, self._backward = self._ways["forward"], self._ways["backward"]
        self._loop.watch(self._listener.fileno(), self._from_clients)

    def limit_clients(self, clients_max: int) -> None:
        """Let so many in from now on; those that are in stay. From any thread."""

        def limit() -> None:
            self._clients_max = clients_max

        self._loop.call(limit)

    def begin(self, forward: Impairments, backward: Impairments) -> None:
        """These impairments from the next packet on, which is number 0, with empty books. From any thread.

        What was in flight before is counted as delivered when it is: call it when nothing is.
        """

        def begin() -> None:
            for direction, settings in zip(DIRECTIONS, (forward, backward), strict=True):
                self._pipelines[direction] = self._ways[direction].pipeline = self._pipeline(direction, settings)

        self._loop.call(begin)

    def _from_clients(self, _: int) -> None:
        receive, clients, loop, way = self._listener.recvfrom, self._clients, self._loop, self._forward
        for _ in range(_BATCH):
            try:
                data, address = receive(_SIZE_MAX)
            except BlockingIOError:
                return
            client = clients.get(address) or self._admit(address)
            if client is None:
                self._refused += 1
                continue
            client.last_ns = now_ns = loop.now_ns
            way.take(data, client.up, now_ns)

    def _admit(self, address: Any) -> _Client | None:
        """A new client; None where there are too many or the system has no socket left."""
        if len(self._clients) >= self._clients_max:
            silent, other = min(self._clients.items(), key=lambda item: item[1].last_ns)
            if self._loop.now_ns - other.last_ns < self._idle_ns:
                return None
            self._replaced += 1
            self._dismiss(self._clients.pop(silent))
        upstream: socket.socket | None = None
        try:
            upstream = socket.socket(self._family, socket.SOCK_DGRAM)
            upstream.setblocking(False)
            upstream.connect(self._target)
        except OSError:
            if upstream is not None:
                upstream.close()
            return None
        enlarge(upstream)
        client = _Client(upstream, upstream.send, self._sender(address), 0)
        self._clients[address] = client
        self._loop.watch(upstream.fileno(), self._from_target(upstream, client))
        return client

    def _sender(self, address: Any) -> Send:
        send = self._listener.sendto
        return lambda data: send(data, address)

    def _from_target(self, upstream: socket.socket, client: _Client) -> Callable[[int], None]:
        receive, loop, way, send = upstream.recv, self._loop, self._backward, client.down

        def handler(_: int) -> None:
            for _ in range(_BATCH):
                try:
                    data = receive(_SIZE_MAX)
                except BlockingIOError:
                    return
                except OSError:  # the target's port or host cannot be reached
                    self._forward.unreachable += 1
                    continue
                client.last_ns = now_ns = loop.now_ns
                way.take(data, send, now_ns)

        return handler

    def _dismiss(self, client: _Client) -> None:
        self._loop.forget(client.upstream.fileno())
        self._kernel_dropped += dropped_by_kernel(client.upstream)
        client.upstream.close()

    def _due(self, now_ns: int) -> int | None:
        forward_ns, backward_ns = self._forward.due(now_ns), self._backward.due(now_ns)
        if forward_ns is None or backward_ns is None:
            return backward_ns if forward_ns is None else forward_ns
        return min(forward_ns, backward_ns)

    def _around(self) -> dict[str, int]:
        sockets = [self._listener, *(client.upstream for client in self._clients.values())]
        lost = sum(dropped_by_kernel(each) for each in sockets if each.fileno() >= 0)
        return {
            "clients": len(self._clients),
            "replaced": self._replaced,
            "refused": self._refused,
            "unreachable": self._forward.unreachable + self._backward.unreachable,
            "kernel_dropped": self._kernel_dropped + lost,
            "overdue": self._forward.overdue + self._backward.overdue,
        }

    def _held(self, direction: Direction) -> int:
        return self._ways[direction].held_packets

    def _close_sockets(self) -> None:
        for client in self._clients.values():
            self._kernel_dropped += dropped_by_kernel(client.upstream)
            client.upstream.close()
        self._kernel_dropped += dropped_by_kernel(self._listener)
        self._listener.close()

    def _end(self) -> None:
        for way in self._ways.values():
            way.end()
