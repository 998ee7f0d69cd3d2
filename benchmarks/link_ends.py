"""The two ends of a link in processes of their own: a source and a sink, over bare sockets or over zenoh.

A message of 64 bytes has its number and the time at which it was sent, by the machine's monotonic clock. The sink
tells how far it is through a shared file, so that a flood has a window whatever lies in between.
"""

from __future__ import annotations

import argparse
import json
import mmap
import queue
import socket
import statistics
import struct
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import zenoh

KINDS = ("udp socket", "tcp socket", "zenoh udp/", "zenoh tcp/")
SIZE = 64
_HEAD = struct.Struct("<QQQ")  # number, time, number again: where a bit is flipped on the way, they may differ
_SHARED = struct.Struct("<QQQ")  # one more than the highest number that arrived; 1: the source has ended; window
_WINDOW_ZENOH, _WINDOW_SOCKET = 128, 2048
_BUFFER_BYTES, _SO_RCVBUFFORCE = 2**22, 33
_PACKET_BYTES = 1024  # of a socket's buffer that a small packet takes, at most
_PATIENCE_S = 30.0
_SILENCE_S = 1.0  # after which nothing more is expected
_NAP_S, _BURST = 2e-4, 16
_KEY = "bench/link"


@dataclass(frozen=True)
class Work:
    """Messages at 100 Hz, then at 1 kHz, then a flood of so many seconds; 0: none of that."""

    slow: int
    fast: int
    flood_s: float


@dataclass(frozen=True)
class Found:
    """Microseconds from put to arrival, and messages/s of the flood with the share of them that was lost."""

    slow_us: list[float]
    fast_us: list[float]
    rate: float
    lost: float


class Shared:
    """What both processes see."""

    def __init__(self, path: Path) -> None:
        with path.open("r+b") as file:
            self._map = mmap.mmap(file.fileno(), _SHARED.size)

    @staticmethod
    def make(path: Path) -> None:
        path.write_bytes(bytes(_SHARED.size))

    @property
    def arrived(self) -> int:
        return int(_SHARED.unpack_from(self._map)[0])

    @arrived.setter
    def arrived(self, number: int) -> None:
        struct.pack_into("<Q", self._map, 0, number)

    @property
    def ended(self) -> bool:
        return bool(_SHARED.unpack_from(self._map)[1])

    @property
    def window(self) -> int:
        """Messages that may be on their way in a flood; the sink says it before it is ready."""
        return int(_SHARED.unpack_from(self._map)[2])

    @window.setter
    def window(self, messages: int) -> None:
        struct.pack_into("<Q", self._map, 16, messages)

    def end(self) -> None:
        struct.pack_into("<Q", self._map, 8, 1)


def scheme(kind: str) -> str:
    return "udp" if "udp" in kind else "tcp"


@contextmanager
def _session(mode: str, side: str, endpoint: str) -> Iterator[zenoh.Session]:
    config = zenoh.Config()
    settings = {
        "mode": mode,
        "listen/endpoints": [],
        "connect/endpoints": [],
        f"{side}/endpoints": [endpoint],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
    }
    for path, value in settings.items():
        config.insert_json5(path, json.dumps(value))
    with zenoh.open(config) as session:
        yield session


@contextmanager
def _taker(kind: str, host: str, port: int, shared: Shared) -> Iterator[Callable[[], bytes | None]]:
    """What gives the next message, or None if none came for a while; says that it is ready."""
    if kind.startswith("zenoh"):
        inbox: queue.SimpleQueue[Any] = queue.SimpleQueue()
        with _session("router", "listen", f"{scheme(kind)}/{host}:{port}") as session:
            subscriber = session.declare_subscriber(_KEY, zenoh.handlers.Callback(inbox.put, indirect=False))
            shared.window = _WINDOW_ZENOH
            print("ready", flush=True)

            def from_zenoh() -> bytes | None:
                try:
                    return bytes(inbox.get(timeout=0.2).payload.to_bytes())
                except queue.Empty:
                    return None

            yield from_zenoh
            subscriber.undeclare()
        return
    with socket.socket(type=socket.SOCK_DGRAM if scheme(kind) == "udp" else socket.SOCK_STREAM) as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, port))
        shared.window = _WINDOW_SOCKET
        if scheme(kind) == "udp":
            listener.settimeout(0.2)
            shared.window = min(_WINDOW_SOCKET, _buffer(listener) // _PACKET_BYTES)
            print("ready", flush=True)
            yield _packets(listener)
            return
        listener.listen()
        print("ready", flush=True)
        listener.settimeout(_PATIENCE_S)
        connection, _ = listener.accept()
        with connection:
            connection.settimeout(0.2)
            yield _pieces(connection)


def _buffer(packets: socket.socket) -> int:
    """Bytes of the receive buffer, made as large as we may."""
    try:
        packets.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _BUFFER_BYTES)
    except OSError:
        packets.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
    return packets.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)


def _packets(listener: socket.socket) -> Callable[[], bytes | None]:
    def take() -> bytes | None:
        try:
            return listener.recv(SIZE)
        except TimeoutError:
            return None

    return take


def _pieces(connection: socket.socket) -> Callable[[], bytes | None]:
    buffer = bytearray()

    def take() -> bytes | None:
        nonlocal buffer
        while len(buffer) < SIZE:
            try:
                data = connection.recv(65536)
            except TimeoutError:
                return None
            if not data:
                time.sleep(0.01)
                return None
            buffer += data
        message = bytes(buffer[:SIZE])
        del buffer[:SIZE]
        return message

    return take


@contextmanager
def _putter(kind: str, host: str, port: int) -> Iterator[Callable[[bytes], Any]]:
    if kind.startswith("zenoh"):
        with _session("client", "connect", f"{scheme(kind)}/{host}:{port}") as session:
            publisher = session.declare_publisher(_KEY, congestion_control=zenoh.CongestionControl.BLOCK, express=True)
            deadline = time.monotonic() + _PATIENCE_S
            while not publisher.matching_status.matching:
                assert time.monotonic() < deadline, "no subscriber"
                time.sleep(0.01)
            yield publisher.put
        return
    with socket.socket(type=socket.SOCK_DGRAM if scheme(kind) == "udp" else socket.SOCK_STREAM) as made:
        made.connect((host, port))
        if scheme(kind) == "tcp":
            made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        yield made.sendall


def sink(kind: str, host: str, port: int, shared: Shared, work: Work) -> Found:
    paced = work.slow + work.fast
    us: dict[int, float] = {}
    highest = flooded = 0
    first_ns = last_ns = 0
    with _taker(kind, host, port, shared) as take:
        deadline = time.monotonic() + _PATIENCE_S
        while True:
            message = take()
            now_ns = time.monotonic_ns()
            if message is None:
                assert highest or time.monotonic() < deadline, "nothing came"
                if shared.ended:
                    break
                continue
            number, sent_ns, again = _HEAD.unpack_from(message)
            if number != again:
                continue
            if number >= highest:
                highest = shared.arrived = number + 1
            if number < paced:
                us[number] = (now_ns - sent_ns) * 1e-3
                continue
            flooded += 1
            last_ns = now_ns
            first_ns = first_ns or now_ns
    slow = [us[number] for number in sorted(us) if number < work.slow]
    fast = [us[number] for number in sorted(us) if number >= work.slow]
    sent = highest - paced
    rate = (flooded - 1) * 1e9 / (last_ns - first_ns) if flooded > 1 else 0.0
    return Found(slow, fast, rate, 1 - flooded / sent if sent > 0 else 0.0)


def source(kind: str, host: str, port: int, shared: Shared, work: Work) -> None:
    padding = bytes(SIZE - _HEAD.size)
    with _putter(kind, host, port) as put:
        for number in range(work.slow + work.fast):
            put(_HEAD.pack(number, time.monotonic_ns(), number) + padding)
            time.sleep(0.01 if number < work.slow else 0.001)
        number, silent = work.slow + work.fast, time.monotonic()
        until = silent + work.flood_s
        seen, window = shared.arrived, shared.window
        while (now := time.monotonic()) < until or seen < number:
            arrived = shared.arrived
            if arrived != seen:
                seen, silent = arrived, now
            elif now > silent + _SILENCE_S:
                break
            if now >= until or number - seen >= window:
                time.sleep(_NAP_S)
                continue
            for _ in range(_BURST):
                put(_HEAD.pack(number, time.monotonic_ns(), number) + padding)
                number += 1
        shared.end()
        time.sleep(0.3)  # until the sink has seen it: over TCP it would take the end of the stream for silence


def main() -> int:
    options = argparse.ArgumentParser()
    options.add_argument("what", choices=["source", "sink"])
    options.add_argument("kind", choices=KINDS)
    options.add_argument("host")
    options.add_argument("port", type=int)
    options.add_argument("shared", type=Path)
    options.add_argument("work", type=lambda text: Work(**json.loads(text)))
    given = options.parse_args()
    at = (given.kind, given.host, given.port, Shared(given.shared), given.work)
    if given.what == "source":
        source(*at)
    else:
        print(json.dumps(asdict(sink(*at))), flush=True)
    return 0


def median(values: list[float]) -> float:
    return statistics.median(values) if values else float("nan")


if __name__ == "__main__":
    sys.exit(main())
