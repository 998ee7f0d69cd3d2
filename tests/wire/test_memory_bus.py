"""The in-process bus: order, patterns, questions, presence, closing."""

from __future__ import annotations

from collections import defaultdict

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from testbed.wire.bus import BusError
from testbed.wire.memory_bus import MemoryNetwork, matches

Heard = list[tuple[str, bytes]]
schedules = st.one_of(st.none(), st.integers(0, 2**32))


def drain(network: MemoryNetwork) -> int:
    count = 0
    while network.step():
        count += 1
    return count


@pytest.mark.parametrize(
    ("pattern", "key", "expected"),
    [
        ("a/b", "a/b", True),
        ("a/b", "a/c", False),
        ("a/*", "a/b", True),
        ("a/*", "a", False),
        ("a/*", "a/b/c", False),
        ("*/b", "a/b", True),
        ("*", "a", True),
        ("*", "a/b", False),
        ("a/*/c", "a/b/c", True),
        ("a/*/c", "a/b/d", False),
        ("a*", "ab", False),
        ("a/b", "*/b", False),
    ],
)
def test_a_star_stands_for_one_part(pattern: str, key: str, expected: bool) -> None:
    assert matches(pattern, key) is expected


@settings(deadline=None, max_examples=150)
@given(
    schedule=schedules,
    sent=st.lists(st.tuples(st.integers(0, 2), st.sampled_from(["x/a", "x/b", "y/a"])), max_size=40),
    steps=st.lists(st.integers(0, 3), max_size=40),
)
def test_every_receiver_gets_all_of_its_own_in_the_order_sent(
    schedule: int | None, sent: list[tuple[int, str]], steps: list[int]
) -> None:
    network = MemoryNetwork(schedule)
    patterns = {"one": ["x/a"], "both": ["x/*"], "several": ["x/b", "y/a"], "none": ["z"]}
    heard: dict[str, Heard] = defaultdict(list)
    for name, own in patterns.items():
        bus = network.bus()
        for pattern in own:
            bus.subscribe(pattern, lambda key, payload, name=name: heard[name].append((key, payload)))
    senders = [network.bus() for _ in range(3)]
    publishers = {(i, key): bus.publisher(key) for i, bus in enumerate(senders) for key in ("x/a", "x/b", "y/a")}
    for number, (sender, key) in enumerate(sent):
        publishers[sender, key](str(number).encode())
        for _ in range(steps[number] if number < len(steps) else 0):
            network.step()
    drain(network)
    for name, own in patterns.items():
        expected = [(key, str(i).encode()) for i, (_, key) in enumerate(sent) if any(matches(p, key) for p in own)]
        assert heard[name] == expected


def orders(schedule: int | None) -> list[str]:
    """Who heard, in what order, of three receivers with four messages each."""
    network, heard = MemoryNetwork(schedule), []
    for name in "abc":
        network.bus().subscribe("k", lambda _, __, name=name: heard.append(name))
    publish = network.bus().publisher("k")
    for _ in range(4):
        publish(b"")
    assert drain(network) == 12
    return heard


def test_without_a_seed_delivery_is_in_the_order_of_publication() -> None:
    assert orders(None) == list("abc") * 4


def test_a_seed_is_a_schedule() -> None:
    assert orders(5) == orders(5)
    assert len({tuple(orders(seed)) for seed in range(20)}) > 10


def test_what_a_handler_publishes_comes_after_what_is_waiting() -> None:
    network, heard = MemoryNetwork(), []
    bus = network.bus()
    publish = bus.publisher("k")

    def take(_: str, payload: bytes) -> None:
        heard.append(payload)
        if payload == b"1":
            publish(b"3")

    bus.subscribe("k", take)
    publish(b"1")
    publish(b"2")
    drain(network)
    assert heard == [b"1", b"2", b"3"]


def test_two_handlers_of_one_bus_both_hear() -> None:
    network, heard = MemoryNetwork(), []
    bus = network.bus()
    bus.subscribe("k", lambda _, __: heard.append(1))
    bus.subscribe("*", lambda _, __: heard.append(2))
    network.bus().publisher("k")(b"")
    drain(network)
    assert heard == [1, 2]


def test_who_subscribes_late_hears_what_is_published_later() -> None:
    network, heard = MemoryNetwork(), []
    publish = network.bus().publisher("k")
    publish(b"1")
    network.bus().subscribe("k", lambda _, payload: heard.append(payload))
    publish(b"2")
    drain(network)
    assert heard == [b"2"]


def test_questions_are_answered() -> None:
    network = MemoryNetwork()
    one, other = network.bus(), network.bus()
    one.answer("question", lambda question: question + b"!")
    assert other.ask("question", b"really") == b"really!"
    assert other.ask("question") == b"!"
    with pytest.raises(BusError, match="nobody answers on another"):
        other.ask("another")


def test_presence_is_told_to_those_who_watch() -> None:
    network, seen = MemoryNetwork(), []
    one, other, third = network.bus(), network.bus(), network.bus()
    one.announce("presence/one")
    other.watch("presence/*", lambda key, alive: seen.append((key, alive)))
    third.announce("presence/third")
    third.announce("elsewhere/third")
    drain(network)
    assert seen == [("presence/one", True), ("presence/third", True)]
    one.close()
    drain(network)
    assert seen[2:] == [("presence/one", False)]


def test_who_closes_hears_and_answers_no_more() -> None:
    network, heard = MemoryNetwork(1), []
    leaving, staying = network.bus(), network.bus()
    for bus in (leaving, staying):
        bus.subscribe("k", lambda _, payload, bus=bus: heard.append((bus, payload)))
        bus.watch("p", lambda key, _, bus=bus: heard.append((bus, key.encode())))
    leaving.answer("question", lambda _: b"")
    publish = network.bus().publisher("k")
    publish(b"1")
    leaving.close()
    publish(b"2")
    network.bus().announce("p")
    drain(network)
    assert heard == [(staying, b"1"), (staying, b"2"), (staying, b"p")]
    with pytest.raises(BusError):
        staying.ask("question")


def test_run_ends_when_told_or_when_nothing_is_left() -> None:
    network, heard = MemoryNetwork(), []
    network.bus().subscribe("k", lambda _, payload: heard.append(payload))
    publish = network.bus().publisher("k")
    for number in range(3):
        publish(bytes([number]))
    assert network.run(lambda: len(heard) == 2)
    assert len(heard) == 2
    assert not network.run(lambda: len(heard) == 4)
    assert len(heard) == 3
    assert not network.step()
