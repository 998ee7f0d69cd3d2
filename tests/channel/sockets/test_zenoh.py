"""Two real zenoh sessions with a link over real sockets between them."""

from __future__ import annotations

import json
import math
import queue
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import zenoh

from channel.sockets.ends import PATIENCE_S, impairments, until
from testbed.channel.chains import chain_of
from testbed.channel.sockets.tcp_proxy import TcpProxy
from testbed.channel.sockets.udp_relay import UdpRelay

pytestmark = pytest.mark.processes
MESSAGES = 2000


def session(mode: str, side: str, endpoint: str) -> zenoh.Session:
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
    return zenoh.open(config)


def free_port(kind: socket.SocketKind) -> int:
    with socket.socket(type=kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Inbox:
    """Numbers of the messages in the order of their arrival."""

    def __init__(self, listener: zenoh.Session) -> None:
        self._samples: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
        handler = zenoh.handlers.Callback(self._samples.put, indirect=False)
        self._subscriber = listener.declare_subscriber("relay/test", handler)

    def next(self) -> int:
        return int(self._samples.get(timeout=PATIENCE_S).payload.to_bytes())

    def rest(self) -> list[int]:
        return [self.next() for _ in range(self._samples.qsize())]


@contextmanager
def ends(scheme: str, target: int, address: tuple[str, int]) -> Iterator[tuple[Inbox, zenoh.Publisher]]:
    """Inbox of the session at the target, and a publisher of one that connects through the link, once they match."""
    with session("router", "listen", f"{scheme}/127.0.0.1:{target}") as listener:
        inbox = Inbox(listener)
        with session("client", "connect", f"{scheme}/{address[0]}:{address[1]}") as talker:
            publisher = talker.declare_publisher(
                "relay/test", congestion_control=zenoh.CongestionControl.BLOCK, express=True
            )
            until(lambda: publisher.matching_status.matching, "the subscriber is known")
            yield inbox, publisher


def test_over_udp_messages_are_lost_as_the_chain_says():
    loss = impairments(loss={"kind": "markov", "recovery": 0.5, "failure": 0.1})
    port = free_port(socket.SOCK_DGRAM)
    with UdpRelay(("127.0.0.1", port), seed=1) as relay, ends("udp", port, relay.address) as (inbox, publisher):
        publisher.put("0")
        assert inbox.next() == 0
        relay.change("forward", loss)
        before = relay.figures().directions["forward"]
        for number in range(1, MESSAGES + 1):
            publisher.put(str(number))
            time.sleep(0.0003)
        until(lambda: relay.figures().directions["forward"]["sent"] - before["sent"] >= MESSAGES, "all sent")
        relay.change("forward", impairments())
        publisher.put(str(MESSAGES + 1))
        arrived = []
        while not arrived or arrived[-1] != MESSAGES + 1:
            arrived.append(inbox.next())
        books = relay.figures().directions["forward"]
    assert arrived == sorted(set(arrived))
    lost, dropped = MESSAGES + 1 - len(arrived), books["dropped"]
    assert dropped - (books["sent"] - before["sent"] - MESSAGES - 1) <= lost <= dropped
    chain = chain_of(loss.loss)
    wider = math.sqrt((1 + chain.memory) / (1 - chain.memory))
    error = wider * math.sqrt(chain.arrival * (1 - chain.arrival) / MESSAGES)
    assert abs(lost / MESSAGES - (1 - chain.arrival)) <= 4 * error


def test_over_tcp_every_message_arrives_in_order_under_delay_and_stall():
    slow = impairments(delay={"kind": "uniform", "low": "1 ms", "high": "5 ms"})
    port = free_port(socket.SOCK_STREAM)
    with (
        TcpProxy(("127.0.0.1", port), forward=slow, backward=slow) as proxy,
        ends("tcp", port, proxy.address) as (inbox, publisher),
    ):
        for number in range(MESSAGES):
            if number == MESSAGES // 2:
                proxy.stall(100_000_000)
            publisher.put(str(number))
        assert [inbox.next() for _ in range(MESSAGES)] == list(range(MESSAGES))


def test_over_tcp_the_client_finds_back_by_itself_after_a_reset():
    port = free_port(socket.SOCK_STREAM)
    with (
        TcpProxy(("127.0.0.1", port)) as proxy,
        ends("tcp", port, proxy.address) as (inbox, publisher),
    ):
        publisher.put("0")
        assert inbox.next() == 0
        proxy.reset(200_000_000)
        arrived: list[int] = []

        def put_again() -> bool:
            publisher.put("1")
            arrived.extend(inbox.rest())
            return bool(arrived)

        until(put_again, "a message arrives again")
        around = proxy.figures().around
    assert set(arrived) == {1}
    assert (around["resets"], around["accepted"]) == (1, 2)
