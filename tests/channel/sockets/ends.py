"""The two ends of a link over real sockets, on loopback; every wait has a deadline."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from testbed.scenario.links import Impairments

PATIENCE_S = 20.0


def impairments(**keys: Any) -> Impairments:
    return Impairments.model_validate(keys)


def udp_socket(to: tuple[str, int] | None = None) -> socket.socket:
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    made.settimeout(PATIENCE_S)
    made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2**23)
    if to is None:
        made.bind(("127.0.0.1", 0))
    else:
        made.connect(to)
    return made


@contextmanager
def udp_ends(relay_to: Callable[[tuple[str, int]], Any]) -> Iterator[tuple[Any, socket.socket, socket.socket]]:
    """(relay, client, target), with the relay begun."""
    with (
        closing(udp_socket()) as target,
        relay_to(target.getsockname()) as relay,
        closing(udp_socket(relay.address)) as client,
    ):
        yield relay, client, target


def datagram(number: int, size: int = 64) -> bytes:
    return number.to_bytes(8, "little") + bytes(size - 8)


def number_of(data: bytes) -> int:
    return int.from_bytes(data[:8], "little")


def until(true: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not true():
        assert time.monotonic() < deadline, f"not within {PATIENCE_S:g} s: {what}"
        time.sleep(0.005)


def received(target: socket.socket, count: int) -> list[bytes]:
    return [target.recv(65535) for _ in range(count)]


def settled(relay: Any, sent: int, direction: str = "forward") -> dict[str, int]:
    """The books once ``sent`` packets have come and none is on its way."""

    def books() -> dict[str, int]:
        return dict(relay.figures().directions[direction])

    until(lambda: books()["sent"] >= sent and books()["in_flight"] == 0, f"{sent} packets settled")
    return books()


class Server:
    """A TCP server that gives back what it gets, a thread for each connection; ``errors`` has what broke them."""

    def __init__(self) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address: tuple[str, int] = self._listener.getsockname()
        self.errors: list[OSError] = []
        self._threads = [threading.Thread(target=self._accept, daemon=True)]
        self._threads[0].start()

    def __enter__(self) -> Server:
        return self

    def __exit__(self, *_: object) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        for thread in self._threads:
            thread.join(PATIENCE_S)
            assert not thread.is_alive()

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            thread = threading.Thread(target=self._echo, args=(connection,), daemon=True)
            self._threads.append(thread)
            thread.start()

    def _echo(self, connection: socket.socket) -> None:
        with connection:
            connection.settimeout(PATIENCE_S)
            try:
                while data := connection.recv(65536):
                    connection.sendall(data)
            except OSError as error:
                self.errors.append(error)


def tcp_client(address: tuple[str, int]) -> socket.socket:
    return socket.create_connection(address, timeout=PATIENCE_S)


def exactly(connection: socket.socket, count: int) -> bytes:
    parts, left = [], count
    while left:
        data = connection.recv(min(left, 65536))
        assert data, f"the stream ended {left} bytes too early"
        parts.append(data)
        left -= len(data)
    return b"".join(parts)


def open_files() -> set[str]:
    """What this process has open, but for the folder that is being listed."""
    links = set()
    for name in os.listdir("/proc/self/fd"):
        try:
            links.add(os.readlink(Path("/proc/self/fd", name)))
        except OSError:
            continue
    return {link for link in links if not link.startswith("/proc/")}
