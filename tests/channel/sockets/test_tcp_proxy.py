"""The TCP proxy: every byte arrives in order, not before its time; stalls, resets, back-pressure, books."""

from __future__ import annotations

import csv
import errno
import os
import socket
import struct
import threading
import time
from contextlib import closing

import pytest

from channel.sockets.ends import (
    Server,
    exactly,
    impairments,
    open_files,
    settled,
    tcp_client,
    until,
)
from testbed.channel.pipeline import Pipeline
from testbed.channel.sockets.outages import Outage, outage
from testbed.channel.sockets.tcp_proxy import TcpProxy
from testbed.errors import UsageError

JITTER = impairments(delay={"kind": "uniform", "low": "0 s", "high": "5 ms"})
MS = 1_000_000


def carried(client: socket.socket, data: bytes) -> bytes:
    """What comes back while ``data`` is sent; the sender ends its stream."""

    def send() -> None:
        client.sendall(data)
        client.shutdown(socket.SHUT_WR)

    sender = threading.Thread(target=send)
    sender.start()
    back = exactly(client, len(data))
    assert client.recv(1) == b""
    sender.join(20)
    return back


def refused_with(address: tuple[str, int]) -> int | None:
    try:
        with tcp_client(address):
            return None
    except OSError as error:
        return error.errno


def first_byte(address: tuple[str, int]) -> bytes:
    with tcp_client(address) as client:
        return client.recv(1)


def test_bytes_arrive_intact_and_in_order_under_jitter_and_rate():
    data = os.urandom(2_000_000)
    narrow = impairments(delay={"kind": "uniform", "low": "0 s", "high": "3 ms"}, rate={"bits_per_second": 4e7})
    with Server() as server, TcpProxy(server.address, forward=narrow, backward=JITTER, seed=1) as proxy:
        begun = time.monotonic()
        with tcp_client(proxy.address) as client:
            assert carried(client, data) == data
        assert time.monotonic() - begun >= 8 * len(data) / 4e7
        until(lambda: proxy.figures().around["connections"] == 0, "closed at both ends")
        figures = proxy.figures()
    for books in figures.directions.values():
        assert books["sent"] == books["delivered"] >= len(data) / 1448
        assert books["in_flight"] == books["dropped"] == 0
    around = {**figures.around, "overdue": 0}
    assert around == {"connections": 0, "accepted": 1, "refused": 0, "unreachable": 0, "resets": 0, "overdue": 0}


def test_no_chunk_arrives_before_the_pipeline_says(tmp_path):
    trace = tmp_path / "t.csv"
    alone = Pipeline(JITTER, 3, "link.relay.forward")
    with (
        Server() as server,
        TcpProxy(server.address, forward=JITTER, seed=3, traces={"forward": trace}) as proxy,
        tcp_client(proxy.address) as client,
    ):
        for number in range(100):
            delay_ns, begun = alone.send(1, 0)[0].at_ns, time.monotonic_ns()
            client.sendall(bytes([number]))
            assert exactly(client, 1) == bytes([number])
            assert time.monotonic_ns() - begun >= delay_ns
    rows = [[int(field) for field in row] for row in list(csv.reader(trace.open()))[1:]]
    alone = Pipeline(JITTER, 3, "link.relay.forward")
    assert [row[0] for row in rows] == list(range(100))
    assert all(arrived - sent >= alone.send(1, 0)[0].at_ns for _, sent, arrived in rows)


def test_a_stall_holds_the_bytes_back_and_loses_none():
    with Server() as server, TcpProxy(server.address) as proxy, tcp_client(proxy.address) as client:
        begun = time.monotonic_ns()
        proxy.stall(200 * MS)
        client.sendall(b"patience")
        assert exactly(client, 8) == b"patience"
        assert time.monotonic_ns() - begun >= 200 * MS


def test_a_stalled_sender_is_held_back_and_goes_on_afterwards():
    data = os.urandom(40_000_000)
    with Server() as server, TcpProxy(server.address, held_max=100_000) as proxy, tcp_client(proxy.address) as client:
        proxy.stall(60_000 * MS, ("forward",))
        client.setblocking(False)
        sent, since = 0, time.monotonic()
        while time.monotonic() - since < 0.5:  # until nothing more fits into the buffers of proxy and system
            try:
                sent += client.send(data[sent : sent + 65536])
                since = time.monotonic()
            except BlockingIOError:
                time.sleep(0.01)
        assert sent < len(data)
        held = proxy.figures().directions["forward"]["in_flight"]
        assert 0 < held * 1448 <= 100_000 + 65536
        proxy._loop.call(lambda: proxy._stalled_ns.update(forward=0))
        client.settimeout(20)
        assert exactly(client, sent) == data[:sent]
        books = settled(proxy, 1)
        assert books["sent"] == books["delivered"]


def test_a_reset_is_seen_at_both_ends_new_connections_are_refused_and_later_accepted():
    with Server() as server, TcpProxy(server.address) as proxy, tcp_client(proxy.address) as client:
        client.sendall(b"x")
        assert exactly(client, 1) == b"x"
        proxy.reset(60_000 * MS)
        with pytest.raises(ConnectionResetError):
            client.recv(1)
        until(lambda: len(server.errors) == 1, "the server's end is reset")
        assert server.errors[0].errno == errno.ECONNRESET
        assert refused_with(proxy.address) == errno.ECONNREFUSED
        proxy._loop.call(lambda: setattr(proxy, "_closed_ns", 0))
        until(lambda: refused_with(proxy.address) is None, "listens again on the same port")
        with tcp_client(proxy.address) as again:
            again.sendall(b"y")
            assert exactly(again, 1) == b"y"
        assert proxy.figures().around["resets"] == 1


def test_what_a_reset_destroys_is_counted():
    slow = impairments(delay={"kind": "constant", "by": "1 min"})
    with Server() as server, TcpProxy(server.address, forward=slow) as proxy, tcp_client(proxy.address) as client:
        client.sendall(bytes(3000))
        until(lambda: proxy.figures().directions["forward"]["sent"] >= 3, "read")
        proxy.reset()
        books = proxy.figures().directions["forward"]
    assert books["dropped_reset"] == books["sent"] >= 3
    assert books["in_flight"] == 0


def test_what_is_in_flight_at_the_end_is_in_the_books():
    slow = impairments(delay={"kind": "constant", "by": "1 min"})
    with Server() as server, TcpProxy(server.address, forward=slow) as proxy, tcp_client(proxy.address) as client:
        client.sendall(bytes(3000))
        until(lambda: proxy.figures().directions["forward"]["sent"] >= 3, "read")
    books = proxy.figures().directions["forward"]
    assert books["in_flight"] == books["sent"] >= 3


def test_outages_come_at_their_time():
    outages = (Outage("stall", 0, 150 * MS), Outage("reset", 300 * MS, 0))
    begun = time.monotonic_ns()
    with Server() as server, TcpProxy(server.address, outages=outages) as proxy, tcp_client(proxy.address) as client:
        client.sendall(b"x")
        assert exactly(client, 1) == b"x"
        assert time.monotonic_ns() - begun >= 150 * MS
        with pytest.raises(ConnectionResetError):
            client.recv(1)
        assert time.monotonic_ns() - begun >= 300 * MS


def test_an_end_that_resets_resets_the_other():
    with Server() as server, TcpProxy(server.address) as proxy:
        client = tcp_client(proxy.address)
        client.sendall(b"x")
        assert exactly(client, 1) == b"x"
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        client.close()
        until(lambda: len(server.errors) == 1, "the server's end is reset")
        until(lambda: proxy.figures().around["connections"] == 0, "forgotten")
        assert proxy.figures().around["resets"] == 1


def test_half_a_stream_may_end_before_the_other():
    with (
        closing(socket.create_server(("127.0.0.1", 0))) as listener,
        TcpProxy(listener.getsockname()) as proxy,
        tcp_client(proxy.address) as client,
    ):
        server, _ = listener.accept()
        with server:
            server.settimeout(20)
            client.shutdown(socket.SHUT_WR)
            assert server.recv(10) == b""
            for number in range(20):
                server.sendall(bytes([number]))
                assert exactly(client, 1) == bytes([number])
        assert client.recv(10) == b""


def test_a_target_that_is_not_there_breaks_the_connection():
    with closing(socket.create_server(("127.0.0.1", 0))) as probe:
        address = probe.getsockname()
    with TcpProxy(address) as proxy:
        with pytest.raises(ConnectionResetError):
            first_byte(proxy.address)
        assert proxy.figures().around["unreachable"] == 1


def test_connections_beyond_the_bound_are_reset_and_garbage_is_only_bytes():
    with Server() as server, TcpProxy(server.address, connections_max=1) as proxy:
        with tcp_client(proxy.address) as client:
            client.sendall(b"\0garbage\xff")
            assert exactly(client, 9) == b"\0garbage\xff"
            with pytest.raises(ConnectionResetError):
                first_byte(proxy.address)
            assert proxy.figures().around["refused"] == 1
        until(lambda: proxy.figures().around["connections"] == 0, "closed")
        with tcp_client(proxy.address) as again:
            again.sendall(b"z")
            assert exactly(again, 1) == b"z"


def test_change_delays_what_comes_after_it_and_order_is_kept():
    slow = impairments(delay={"kind": "constant", "by": "200 ms"})
    with Server() as server, TcpProxy(server.address, forward=slow) as proxy, tcp_client(proxy.address) as client:
        begun = time.monotonic_ns()
        client.sendall(b"a")
        until(lambda: proxy.figures().directions["forward"]["sent"] == 1, "read")
        proxy.change("forward", impairments())
        client.sendall(b"b")
        assert exactly(client, 2) == b"ab"
        assert time.monotonic_ns() - begun >= 200 * MS


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("loss", {"kind": "bernoulli", "loss": 0.1}),
        ("reorder", {"chance": 0.1, "by": "1 ms"}),
        ("duplicate", {"chance": 0.1}),
        ("corrupt", {"chance": 0.1}),
        ("rate", {"bits_per_second": 1e6, "queue_packets": 10}),
        ("rate", {"bits_per_second": 1e6, "queue_bytes": 10}),
    ],
)
def test_what_a_proxy_cannot_express_is_refused_and_the_line_says_what_can(key, value):
    threads, files = set(threading.enumerate()), open_files()
    with pytest.raises(UsageError, match=rf"^{key}.*the tcp model, or the kernel backend$"):
        TcpProxy(("127.0.0.1", 1), forward=impairments(**{key: value}))
    assert (set(threading.enumerate()), open_files()) == (threads, files)
    with Server() as server, TcpProxy(server.address) as proxy, pytest.raises(UsageError, match=f"^{key}"):
        proxy.change("backward", impairments(**{key: value}))


def test_no_thread_and_no_socket_is_left():
    threads, files = set(threading.enumerate()), open_files()
    with Server() as server, TcpProxy(server.address) as proxy, tcp_client(proxy.address) as client:
        client.sendall(b"x")
        exactly(client, 1)
    assert set(threading.enumerate()) == threads
    assert open_files() == files


def test_outages_are_read_from_text():
    assert outage("stall", "5 s + 500 ms") == Outage("stall", 5000 * MS, 500 * MS)
    assert outage("reset", "0 s+0 s") == Outage("reset", 0, 0)
    for wrong in ("5 s", "5+5", "5 s + 0 s", "5 s + 1 s + 1 s"):
        with pytest.raises(UsageError, match="allowed: AT"):
            outage("stall", wrong)


def test_one_connection_does_not_wait_for_another_that_is_not_read():
    with (
        closing(socket.create_server(("127.0.0.1", 0))) as listener,
        TcpProxy(listener.getsockname(), held_max=50_000) as proxy,
        tcp_client(proxy.address) as stuck,
        tcp_client(proxy.address) as other,
    ):
        ends = [listener.accept()[0] for _ in range(2)]
        stuck.setblocking(False)
        for _ in range(2000):
            try:
                stuck.send(bytes(65536))
            except BlockingIOError:
                time.sleep(0.001)
        other.sendall(b"x")
        for end in ends:
            end.settimeout(20)
        assert sorted(end.recv(1) for end in ends) == [b"\0", b"x"]
        for end in ends:
            end.close()
