"""Datagrams: which messages arrive follows from the fates of their packets."""

from __future__ import annotations

from itertools import product

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from channel.scripted import MS, Scripted
from testbed.channel.pipeline import Copy, Pipeline
from testbed.channel.udp import UdpCarrier
from testbed.scenario.carriers import UdpTransport
from testbed.scenario.links import Impairments

PERIOD = 10 * MS


def _link(**keys: object) -> Impairments:
    return Impairments.model_validate(keys)


def _run(carrier: UdpCarrier, messages: int, size: int, period: int = PERIOD) -> list[tuple[int, int]]:
    got = []
    for number in range(messages):
        carrier.send(number, size, number * period)
        got += carrier.advance(number * period)
    while carrier.next_ns is not None:
        got += carrier.advance(carrier.next_ns)
    assert carrier.books.in_flight == 0
    return got


def test_a_message_of_10_kb_is_seven_packets_of_at_most_the_mtu() -> None:
    carrier = UdpCarrier(Scripted(0), UdpTransport())
    sizes = carrier.fragments(10_000)
    assert len(sizes) == 7
    assert max(sizes) <= 1500
    assert sum(sizes) == 10_000 + 13 + 8 + 7 * 20


@given(size=st.integers(0, 70_000), mtu=st.integers(68, 9000), framing=st.integers(0, 100))
def test_fragments_carry_the_message_once_in_multiples_of_eight(size: int, mtu: int, framing: int) -> None:
    sizes = UdpCarrier(Scripted(0), UdpTransport(mtu=mtu, framing_bytes=framing)).fragments(size)
    payloads = [packet - 20 for packet in sizes]
    assert sum(payloads) == size + framing + 8
    assert max(sizes) <= mtu
    assert all(payload % 8 == 0 and payload > 0 for payload in payloads[:-1])
    assert payloads[-1] > 0
    if len(payloads) > 2:  # no packet less would do
        assert (len(payloads) - 1) * ((mtu - 20) // 8 * 8) < size + framing + 8


def test_a_message_arrives_if_and_only_if_all_its_fragments_do() -> None:
    for fates in product((False, True), repeat=3):
        pipeline = Scripted(5 * MS, {place for place, arrives in enumerate(fates) if not arrives})
        carrier = UdpCarrier(pipeline, UdpTransport())
        got = _run(carrier, 1, 4000)
        assert got == ([(5 * MS, 0)] if all(fates) else [])
        assert carrier.books.dropped["loss"] == (not all(fates))


def test_message_loss_is_that_of_any_of_its_fragments() -> None:
    link = _link(loss={"kind": "bernoulli", "loss": 0.05}, delay={"kind": "constant", "by": "1 ms"})
    twin = Pipeline(link, 7, "link")
    fates = [bool(twin.send(1500, 0)) for _ in range(7 * 4000)]
    whole = [all(fates[7 * k : 7 * k + 7]) for k in range(4000)]
    carrier = UdpCarrier(Pipeline(link, 7, "link"), UdpTransport())
    assert [number for _, number in _run(carrier, 4000, 10_000)] == [k for k, arrives in enumerate(whole) if arrives]
    loss = 1 - 0.95**7
    assert carrier.books.dropped["loss"] / 4000 == pytest.approx(loss, abs=4 * (loss * (1 - loss) / 4000) ** 0.5)


@pytest.mark.parametrize("late", ["drop", "deliver"])
def test_late_messages_are_those_that_a_newer_one_overtook(late: str) -> None:
    link = _link(delay={"kind": "uniform", "low": "0 s", "high": "30 ms"})
    twin = Pipeline(link, 3, "link")
    arrivals = [twin.send(93, k * PERIOD)[0].at_ns for k in range(3000)]
    overtaken = {k for k, at in enumerate(arrivals) if min(arrivals[k + 1 : k + 5], default=at) < at}
    carrier = UdpCarrier(Pipeline(link, 3, "link"), UdpTransport.model_validate({"late": late}))
    got = _run(carrier, 3000, 64)
    assert carrier.books.late == len(overtaken)
    assert 0.2 < len(overtaken) / 3000 < 0.3
    wanted = set(range(3000)) - (overtaken if late == "drop" else set())
    assert {number for _, number in got} == wanted
    assert all(at == arrivals[number] for at, number in got)
    assert carrier.books.dropped["late"] == (len(overtaken) if late == "drop" else 0)


class _Copies(Scripted):
    """Each packet arrives as the script says: (delay, flipped) of each copy."""

    def __init__(self, script: list[list[tuple[int, bool]]]) -> None:
        super().__init__(0)
        self._script = iter(script)

    def send(self, size: int, now_ns: int) -> tuple[Copy, ...]:
        copies = next(self._script)
        self.books.sent += 1
        self.books.duplicated += max(len(copies) - 1, 0)
        self.cause = None if copies else "queue"
        if not copies:
            self.books.drop("queue")
        return tuple(Copy(now_ns + delay, 1 if flipped else None) for delay, flipped in copies)


@pytest.mark.parametrize(
    ("copies", "got", "dropped", "repeated"),
    [
        ([[(1, False), (2, False)]], [(1, 0)], {}, 1),
        ([[(1, True)]], [], {"corrupt": 1}, 0),
        ([[(1, True), (3, False)]], [(3, 0)], {}, 0),
        ([[(1, False), (3, True)]], [(1, 0)], {}, 0),
        ([[]], [], {"queue": 1}, 0),
    ],
)
def test_copies_and_bit_errors(
    copies: list[list[tuple[int, bool]]], got: list[tuple[int, int]], dropped: dict[str, int], repeated: int
) -> None:
    pipeline = _Copies(copies)
    carrier = UdpCarrier(pipeline, UdpTransport())
    assert _run(carrier, 1, 64) == got
    assert dict(carrier.books.dropped) == dropped
    assert carrier.books.repeated == repeated
    assert pipeline.books.in_flight == 0


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32),
    loss=st.floats(0, 0.5),
    size=st.integers(1, 5000),
    corrupt=st.floats(0, 0.5),
    copies=st.floats(0, 0.5),
    period=st.integers(0, 20 * MS),
)
def test_books_balance_at_all_times(
    seed: int, loss: float, size: int, corrupt: float, copies: float, period: int
) -> None:
    link = _link(
        loss={"kind": "bernoulli", "loss": loss},
        delay={"kind": "uniform", "low": "1 ms", "high": "30 ms"},
        duplicate={"chance": copies, "after": "5 ms"},
        corrupt={"chance": corrupt},
    )
    pipeline = Pipeline(link, seed, "link")
    carrier = UdpCarrier(pipeline, UdpTransport())
    numbers = set()
    for number in range(60):
        carrier.send(number, size, number * period)
        for at, arrived in carrier.advance(number * period):
            assert arrived not in numbers
            assert at >= arrived * period + MS
            numbers.add(arrived)
        books = carrier.books
        assert books.sent == books.delivered + books.dropped.total() + books.in_flight == number + 1
        assert books.in_flight >= 0
        assert (books.in_flight > 0) <= (carrier.next_ns is not None)
    carrier.advance(10**12)
    assert carrier.books.in_flight == 0
    assert pipeline.books.in_flight == 0
