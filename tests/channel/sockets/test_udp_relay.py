"""The UDP relay against its pipeline: the same fates, real copies, real bit errors, delays, books."""

from __future__ import annotations

import csv
import socket
import threading
import time
from contextlib import closing
from functools import partial
from pathlib import Path

import pytest

from channel.sockets.ends import (
    datagram,
    impairments,
    number_of,
    open_files,
    received,
    settled,
    udp_ends,
    udp_socket,
    until,
)
from testbed.channel.pipeline import Pipeline
from testbed.channel.sockets.udp_relay import UdpRelay
from testbed.channel.sockets.way import flipped
from testbed.errors import UsageError
from testbed.scenario.trace_file import read_fates

PACKETS = 2000
BURSTY = {"kind": "markov", "recovery": 0.25, "failure": 0.05}
GILBERT_ELLIOTT = {"kind": "gilbert-elliott", "to_bad": 0.02, "to_good": 0.2, "loss_good": 0.01, "loss_bad": 0.6}


@pytest.mark.parametrize("loss", [BURSTY, GILBERT_ELLIOTT, {"kind": "bernoulli", "loss": 0.2}])
def test_the_same_seed_drops_the_same_packets_as_the_pipeline(loss):
    alone = Pipeline(impairments(loss=loss), 7, "link.a")
    kept = [number for number in range(PACKETS) if alone.send(64, 0)]
    relay = partial(UdpRelay, forward=impairments(loss=loss), seed=7, components=("link.a", "link.b"))
    with udp_ends(relay) as (link, client, target):
        for number in range(PACKETS):
            client.send(datagram(number))
        assert [number_of(data) for data in received(target, len(kept))] == kept
        books = settled(link, PACKETS)
    assert books["dropped_loss"] == PACKETS - len(kept)
    assert link.figures().around["kernel_dropped"] == 0


def test_answers_return_to_their_client_and_meet_the_losses_of_the_way_back():
    back = impairments(loss=BURSTY)
    alone = Pipeline(back, 7, "link.b")
    kept = [number for number in range(500) if alone.send(64, 0)]
    with udp_ends(partial(UdpRelay, backward=back, seed=7, components=("link.a", "link.b"))) as (link, client, target):
        client.send(datagram(0))
        _, seen_as = target.recvfrom(100)
        for number in range(500):
            target.sendto(datagram(number), seen_as)
        assert [number_of(data) for data in received(client, len(kept))] == kept
        assert settled(link, 500, "backward")["dropped"] == 500 - len(kept)


def test_packets_of_several_clients_are_numbered_together_and_answers_are_not_mixed_up():
    relay = partial(UdpRelay, forward=impairments(loss=BURSTY), seed=3, components=("link.a", "link.b"))
    alone = Pipeline(impairments(loss=BURSTY), 3, "link.a")
    kept = [number for number in range(300) if alone.send(64, 0)]
    with udp_ends(relay) as (link, first, target), closing(udp_socket(link.address)) as second:
        for number in range(300):
            (first, second)[number % 2].send(datagram(number))
            settled(link, number + 1)
        sources: dict[int, set[object]] = {0: set(), 1: set()}
        for number in kept:
            data, source = target.recvfrom(100)
            assert number_of(data) == number
            sources[number % 2].add(source)
            target.sendto(data, source)
        assert [len(found) for found in sources.values()] == [1, 1]
        assert sources[0] != sources[1]
        for client, rest in ((first, 0), (second, 1)):
            mine = [number for number in kept if number % 2 == rest]
            assert [number_of(data) for data in received(client, len(mine))] == mine


@pytest.mark.parametrize(
    "delay", [{"kind": "constant", "by": "3 ms"}, {"kind": "uniform", "low": "0 s", "high": "9 ms"}]
)
def test_no_packet_arrives_before_the_pipeline_says(tmp_path, delay):
    alone = Pipeline(impairments(delay=delay), 5, "link.relay.forward")
    trace = tmp_path / "t.csv"
    relay = partial(UdpRelay, forward=impairments(delay=delay), seed=5, traces={"forward": trace})
    sent_ns: dict[int, int] = {}
    taken_ns: dict[int, int] = {}
    with udp_ends(relay) as (link, client, target):
        reader = threading.Thread(
            target=lambda: taken_ns.update((number_of(target.recv(100)), time.monotonic_ns()) for _ in range(200))
        )
        reader.start()
        for number in range(200):
            sent_ns[number] = time.monotonic_ns()
            client.send(datagram(number))
            time.sleep(0.0005)
        reader.join(20)
        settled(link, 200)
    least_ns = [alone.send(64, 0)[0].at_ns for _ in range(200)]
    assert len(taken_ns) == 200
    assert all(taken_ns[number] - sent_ns[number] >= least_ns[number] for number in range(200))
    rows = list(csv.reader(trace.open()))[1:]
    assert sorted(int(row[0]) for row in rows) == list(range(200))
    assert all(int(arrived) - int(sent) >= least_ns[int(seq)] for seq, sent, arrived in rows)
    assert [int(row[2]) for row in rows] == sorted(int(row[2]) for row in rows)


def test_a_duplicate_is_sent_twice():
    twice = impairments(duplicate={"chance": 1.0, "after": "2 ms"})
    with udp_ends(partial(UdpRelay, forward=twice)) as (link, client, target):
        for number in range(50):
            client.send(datagram(number))
        numbers = [number_of(data) for data in received(target, 100)]
        books = settled(link, 50)
    assert sorted(numbers) == sorted([*range(50), *range(50)])
    assert (books["sent"], books["duplicated"], books["delivered"]) == (50, 50, 100)


def test_corruption_flips_exactly_one_bit_the_one_that_the_pipeline_names():
    corrupt = impairments(corrupt={"chance": 0.5})
    alone = Pipeline(corrupt, 2, "link.relay.forward")
    sent = bytes(range(100))
    with udp_ends(partial(UdpRelay, forward=corrupt, seed=2)) as (link, client, target):
        for _ in range(100):
            client.send(sent)
        arrived = received(target, 100)
        books = settled(link, 100)
    for data in arrived:
        flip = alone.send(100, 0)[0].flip
        changed = int.from_bytes(data, "little") ^ int.from_bytes(sent, "little")
        assert changed == (0 if flip is None else 1 << flip % 800)
    assert books["corrupted"] == sum(data != sent for data in arrived) > 0


def test_a_flipped_bit_of_nothing_is_nothing():
    assert flipped(b"", 12345) == b""


def test_reordered_packets_are_overtaken():
    held = impairments(reorder={"chance": 0.2, "by": "100 ms"})
    alone = Pipeline(held, 1, "link.relay.forward")
    late = [number for number in range(50) if alone.send(64, 0)[0].at_ns > 0]
    with udp_ends(partial(UdpRelay, forward=held, seed=1)) as (_link, client, target):
        for number in range(50):
            client.send(datagram(number))
        numbers = [number_of(data) for data in received(target, 50)]
    assert sorted(numbers) == list(range(50))
    last = late[-1]
    assert set(range(last)) - set(late) <= set(numbers[: numbers.index(last)])


def test_a_full_queue_drops_and_the_books_say_so():
    slow = impairments(rate={"bits_per_second": 64 * 8 * 1000, "queue_packets": 10})
    with udp_ends(partial(UdpRelay, forward=slow)) as (link, client, _target):
        for number in range(1000):
            client.send(datagram(number))
        books = settled(link, 1000)
    assert books["dropped_queue"] > 0
    assert books["delivered"] + books["dropped_queue"] == books["sent"] == 1000


def test_change_takes_over_between_two_packets_with_the_same_draws_and_leaves_what_is_in_flight():
    before = impairments(loss={"kind": "bernoulli", "loss": 0.1}, delay={"kind": "constant", "by": "50 ms"})
    after = impairments(loss={"kind": "bernoulli", "loss": 0.6})
    alone = Pipeline(before, 9, "link.relay.forward")
    kept = [number for number in range(200) if alone.send(64, 0)]
    alone.change(after)
    later = [number for number in range(200, 400) if alone.send(64, 0)]
    with udp_ends(partial(UdpRelay, forward=before, seed=9)) as (link, client, target):
        for number in range(200):
            client.send(datagram(number))
        until(lambda: link.figures().directions["forward"]["sent"] == 200, "all read")
        link.change("forward", after)
        for number in range(200, 400):
            client.send(datagram(number))
        numbers = [number_of(data) for data in received(target, len(kept) + len(later))]
        settled(link, 400)
    assert [number for number in numbers if number < 200] == kept
    assert [number for number in numbers if number >= 200] == later


def test_change_refuses_an_unknown_direction():
    with udp_ends(UdpRelay) as (link, _, _), pytest.raises(UsageError, match="did you mean 'forward'"):
        link.change("forwards", impairments())


def test_what_is_in_flight_at_the_end_is_in_the_books_and_in_the_trace(tmp_path):
    slow = impairments(loss=BURSTY, delay={"kind": "constant", "by": "1 min"})
    trace = tmp_path / "t.csv"
    with udp_ends(partial(UdpRelay, forward=slow, traces={"forward": trace})) as (link, client, _):
        for number in range(100):
            client.send(datagram(number))
        until(lambda: link.figures().directions["forward"]["sent"] == 100, "all read")
    books = link.figures().directions["forward"]
    assert books["delivered"] == 0
    assert books["in_flight"] == 100 - books["dropped"] > 0
    assert read_fates(trace).arrived.sum() == books["in_flight"]


def test_the_trace_has_the_fates_of_the_pipeline(tmp_path):
    alone = Pipeline(impairments(loss=BURSTY), 4, "link.relay.forward")
    trace = tmp_path / "t.csv"
    relay = partial(UdpRelay, forward=impairments(loss=BURSTY), seed=4, traces={"forward": trace})
    with udp_ends(relay) as (link, client, _):
        for number in range(500):
            client.send(datagram(number))
        settled(link, 500)
    assert read_fates(trace).arrived.tolist() == [bool(alone.send(64, 0)) for _ in range(500)]


def test_more_than_the_relay_holds_is_dropped_with_a_cause(monkeypatch):
    monkeypatch.setattr("testbed.channel.sockets.udp_relay._HELD_MAX", 10_000)
    with udp_ends(partial(UdpRelay, forward=impairments(delay={"kind": "constant", "by": "1 min"}))) as (
        link,
        client,
        _,
    ):
        for number in range(100):
            client.send(datagram(number))
        until(lambda: link.figures().directions["forward"]["sent"] == 100, "all read")
    books = link.figures().directions["forward"]
    assert books["in_flight"] * 64 <= 10_000 + 64
    assert books["dropped_overflow"] == 100 - books["in_flight"] > 0


def test_strangers_beyond_the_bound_are_refused_and_an_idle_client_makes_room():
    with udp_ends(partial(UdpRelay, clients_max=2)) as (link, client, target):
        client.send(b"first")
        settled(link, 1)
        for _ in range(5):
            with closing(udp_socket(link.address)) as stranger:
                stranger.send(b"garbage")
        until(lambda: link.figures().around["refused"] == 4, "four refused")
        client.send(b"second")
        assert received(target, 3) == [b"first", b"garbage", b"second"]
    with udp_ends(partial(UdpRelay, clients_max=1, idle_ns=0)) as (link, client, target):
        for number in range(5):
            with closing(udp_socket(link.address)) as other:
                other.send(datagram(number))
                assert number_of(target.recv(100)) == number
        assert link.figures().around["replaced"] == 4


def test_garbage_for_the_sockets_towards_the_target_and_empty_datagrams_do_no_harm():
    with udp_ends(UdpRelay) as (_link, client, target):
        client.send(b"")
        data, seen_as = target.recvfrom(100)
        assert data == b""
        with closing(udp_socket()) as third:
            third.sendto(b"not from the target", seen_as)
        target.sendto(b"from the target", seen_as)
        assert client.recv(100) == b"from the target"
        client.send(bytes(65507))
        assert target.recv(65535) == bytes(65507)


def test_a_target_that_is_not_there_is_counted_and_may_come_later():
    with closing(udp_socket()) as probe:
        address = probe.getsockname()
    with UdpRelay(address) as relay, closing(udp_socket(relay.address)) as client:
        for number in range(5):
            client.send(datagram(number))
            settled(relay, number + 1)
        until(lambda: relay.figures().around["unreachable"] > 0, "reported")
        with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as target:
            target.bind(address)
            target.settimeout(20)
            client.send(b"now")
            assert target.recv(100) == b"now"


def test_packets_that_the_kernel_drops_are_counted():
    with udp_ends(UdpRelay) as (link, client, _target):
        link._listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
        held = threading.Event()
        holder = threading.Thread(target=lambda: link._loop.call(lambda: held.wait(20)))
        holder.start()
        for number in range(1000):
            client.send(datagram(number, 1000))
        held.set()
        holder.join(20)
        until(
            lambda: (
                sum((link.figures().directions["forward"]["sent"], link.figures().around["kernel_dropped"])) == 1000
            ),
            "all counted",
        )
        dropped = link.figures().around["kernel_dropped"]
    assert 0 < dropped == link.figures().around["kernel_dropped"]


def test_packets_that_the_relay_hands_on_too_late_are_counted():
    soon = impairments(delay={"kind": "constant", "by": "1 min"})
    with udp_ends(partial(UdpRelay, forward=soon)) as (link, client, target):
        for number in range(10):
            client.send(datagram(number))
        until(lambda: link.figures().directions["forward"]["sent"] == 10, "all read")
        loop = link._loop
        loop.call(lambda: setattr(loop, "_start_ns", loop._start_ns - 62 * 10**9))  # as if it had slept so long
        assert len(received(target, 10)) == 10
        settled(link, 10)
        assert link.figures().around["overdue"] == 10


def test_no_thread_and_no_socket_is_left():
    threads, files = set(threading.enumerate()), open_files()
    with udp_ends(UdpRelay) as (_, client, target):
        client.send(b"x")
        target.recv(100)
    assert set(threading.enumerate()) == threads
    assert open_files() == files


def test_an_address_in_use_is_refused_in_one_line(tmp_path):
    with closing(udp_socket()) as other:
        threads, files = set(threading.enumerate()), open_files()
        with pytest.raises(UsageError, match=r"cannot listen on udp/127\.0\.0\.1:\d+: address already in use"):
            UdpRelay(("127.0.0.1", 1), listen=other.getsockname())
        with pytest.raises(UsageError, match="cannot write"):
            UdpRelay(("127.0.0.1", 1), traces={"forward": Path(tmp_path, "none", "t.csv")})
        assert open_files() == files
        assert set(threading.enumerate()) == threads


def test_where_checksums_are_looked_at_a_corrupted_packet_does_not_arrive():
    corrupt = impairments(corrupt={"chance": 0.3})
    alone = Pipeline(corrupt, 7, "link.a")
    kept = [number for number in range(300) if all(copy.flip is None for copy in alone.send(64, 0))]
    relay = partial(UdpRelay, forward=corrupt, seed=7, components=("link.a", "link.b"), checksummed=True)
    with udp_ends(relay) as (link, client, target):
        for number in range(300):
            client.send(datagram(number))
        assert [number_of(data) for data in received(target, len(kept))] == kept
        assert settled(link, 300)["dropped_corrupt"] == 300 - len(kept)


def test_the_door_can_be_shut_behind_a_client():
    with udp_ends(UdpRelay) as (link, client, target):
        client.send(b"first")
        settled(link, 1)
        link.limit_clients(1)
        with closing(udp_socket(link.address)) as stranger:
            stranger.send(b"garbage")
            until(lambda: link.figures().around["refused"] == 1, "one refused")
        client.send(b"second")
        assert received(target, 2) == [b"first", b"second"]
