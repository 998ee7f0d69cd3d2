"""A role's end of the bus: what it takes, what it refuses and counts, what it copies for the recording."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from testbed.wire.codec import Decoder, PacketEncoder, Sizes, encode
from testbed.wire.keys import Keys
from testbed.wire.memory_bus import MemoryNetwork
from testbed.wire.messages import ClockMessage, Command, Control, Observation, Status
from testbed.wire.node import ORCHESTRATOR, Gate, Node

RUN = "run0testrun1"
SIZES = Sizes(n=2, p=1, q=1, lanes=4, steps=10, lanes_per_packet=2)
KEYS = Keys(RUN)


class Bench:
    """A node that listens to observations, and a way to send it anything."""

    def __init__(self, sizes: Sizes = SIZES, **options: Any) -> None:
        self.network = MemoryNetwork()
        self.node = Node(self.network.bus(), RUN, "estimator.x", sizes)
        self.taken: list[tuple[int, int, int]] = []
        key = KEYS.delivered("observation")
        self.node.on(key, Observation, "link.observation", self._take, **options)
        self._publish = self.network.bus().publisher(key)

    def _take(self, packet: Observation, arrays: dict[str, Any]) -> None:
        self.taken.append((packet.seq, packet.step, packet.lane))

    def send(self, payload: bytes) -> Counter[str]:
        """Deliver a payload; what was refused because of it."""
        before = self.node.rejected.copy()
        self._publish(payload)
        self.network.run(lambda: False)
        return self.node.rejected - before


def packet(
    seq: int, step: int, lane: int = 0, lanes: int = 2, source: str = "link.observation", run: str = RUN
) -> bytes:
    arrays = {"y": np.zeros((lanes, 1)), "mask": np.ones(lanes, dtype=np.uint8)}
    return PacketEncoder(Observation, run, source).encode(seq, step, lane, lanes, arrays)


def test_packets_in_turn_are_taken() -> None:
    bench = Bench()
    sent = [(0, 1, 0), (1, 1, 2), (2, 2, 2), (3, 2, 0), (4, 3, 2), (5, 4, 2), (6, 3, 0)]
    for one in sent:
        assert not bench.send(packet(*one))
    assert bench.taken == sent


def test_gaps_are_refused_and_what_has_come_before_is_passed_over_both_counted() -> None:
    bench = Bench()
    bench.send(packet(0, 1))
    assert not bench.send(packet(0, 1))
    assert bench.send(packet(2, 3)) == {"sequence": 1}
    assert not bench.send(packet(1, 2))
    assert bench.taken == [(0, 1, 0), (1, 2, 0)]
    assert bench.node.rejected == {"sequence": 1}
    assert bench.node.repeated == 1


@pytest.mark.parametrize(
    ("expected", "payload"),
    [
        ("source", packet(0, 1, source="link.ack")),
        ("run", packet(0, 1, run="another0run0")),
        ("range", packet(0, 0)),
        ("range", packet(0, 11)),
        ("range", packet(0, 1, lane=4)),
        ("range", packet(0, 1, lane=1)),
        ("range", packet(0, 1, lanes=1)),
        ("range", packet(0, 1, lanes=4)),
        ("order", packet(0, 2)),
        ("order", packet(0, 10)),
        ("format", b""),
        ("format", b"NCS1"),
        ("schema", encode(Command(run=RUN, source="link.observation", seq=0, action="stop"))),
    ],
)
def test_what_does_not_fit_is_refused_and_counted(expected: str, payload: bytes) -> None:
    bench = Bench()
    assert bench.send(payload) == {expected: 1}
    assert bench.taken == []


@pytest.mark.parametrize(
    "wrong",
    [packet(0, 1, source="plant"), packet(0, 1, run="another0run0"), packet(1, 1), packet(0, 2), packet(0, 1, 1), b"x"],
)
def test_what_is_refused_takes_neither_a_number_nor_a_turn(wrong: bytes) -> None:
    bench = Bench()
    assert bench.send(wrong)
    assert not bench.send(packet(0, 1))


def test_a_step_is_taken_once() -> None:
    bench = Bench()
    bench.send(packet(0, 1))
    assert bench.send(packet(1, 1)) == {"order": 1}
    assert not bench.send(packet(1, 2))
    assert bench.taken == [(0, 1, 0), (1, 2, 0)]


def test_the_last_packet_of_a_step_may_be_smaller() -> None:
    bench = Bench(Sizes(n=2, p=1, q=1, lanes=5, steps=10, lanes_per_packet=2))
    assert not bench.send(packet(0, 1, lane=4, lanes=1))
    assert not bench.send(packet(1, 1, lane=0, lanes=2))


def test_needed_arrays_must_be_there() -> None:
    for needs in ((), ("y",), ("y", "mask")):
        assert not Bench(needs=needs).send(packet(0, 1))
    bench = Bench(needs=("y",))
    bare = PacketEncoder(Observation, RUN, "link.observation")
    assert bench.send(bare.encode(0, 1, 0, 2, {"mask": np.zeros(2, dtype=np.uint8)})) == {"arrays": 1}
    assert not bench.send(packet(0, 1))


def test_an_end_before_that_of_the_run() -> None:
    bench = Bench(last=2)
    for seq, step in enumerate((1, 2)):
        assert not bench.send(packet(seq, step))
    assert bench.send(packet(2, 3)) == {"range": 1}


@settings(deadline=None, max_examples=200)
@given(
    st.lists(
        st.one_of(
            st.binary(max_size=80),
            st.builds(
                packet,
                st.integers(0, 3),
                st.integers(0, 11),
                st.integers(0, 5),
                st.integers(1, 5),
                st.sampled_from(["link.observation", "plant"]),
                st.sampled_from([RUN, "another0run0"]),
            ),
        ),
        max_size=12,
    )
)
def test_nothing_raises_and_every_message_is_taken_or_counted(payloads: list[bytes]) -> None:
    bench = Bench()
    for payload in payloads:
        bench.send(payload)
    assert len(bench.taken) + sum(bench.node.rejected.values()) == len(payloads)
    for lane in (0, 2):
        steps = [step for _, step, of in bench.taken if of == lane]
        assert steps == list(range(1, len(steps) + 1))


def test_messages_that_are_no_packets_are_numbered_too() -> None:
    network, steps = MemoryNetwork(), []
    node = Node(network.bus(), RUN, "controller", SIZES)
    node.on(KEYS.clock, ClockMessage, ORCHESTRATOR, lambda clock, _: steps.append(clock.step))
    publish = network.bus().publisher(KEYS.clock)
    for seq, step in ((0, 4), (0, 5), (1, 4), (3, 9)):
        publish(encode(ClockMessage(run=RUN, source=ORCHESTRATOR, seq=seq, step=step)))
    network.run(lambda: False)
    assert steps == [4, 4]
    assert node.rejected == {"sequence": 1}
    assert node.repeated == 1


def test_only_the_orchestrator_stops_a_role() -> None:
    network = MemoryNetwork()
    node = Node(network.bus(), RUN, "plant", SIZES)
    publish = network.bus().publisher(KEYS.command)
    publish(encode(Command(run=RUN, source="controller", seq=0, action="stop")))
    network.run(lambda: False)
    assert not node.stopped
    publish(encode(Command(run=RUN, source=ORCHESTRATOR, seq=0, action="stop")))
    network.run(lambda: False)
    assert node.stopped
    assert node.rejected == {"source": 1}


def test_senders_number_their_packets_key_by_key() -> None:
    network, heard = MemoryNetwork(), []
    listener = network.bus()
    for link in ("control", "observation"):
        listener.subscribe(
            KEYS.sent(link),
            lambda key, payload: heard.append((key, Decoder(_MODELS[key], RUN, SIZES).decode(payload)[0].seq)),
        )
    node = Node(network.bus(), RUN, "plant", SIZES)
    observe = node.sender(KEYS.sent("observation"), Observation)
    control = node.sender(KEYS.sent("control"), Control)
    observe(1, 0, 2, {"y": np.zeros((2, 1))})
    control(0, 0, 2, {"u": np.zeros((2, 1))})
    observe(1, 2, 2, {"y": np.zeros((2, 1))})
    network.run(lambda: False)
    expected = [(KEYS.sent("observation"), 0), (KEYS.sent("control"), 0), (KEYS.sent("observation"), 1)]
    assert heard == expected


_MODELS = {KEYS.sent("control"): Control, KEYS.sent("observation"): Observation}


@pytest.mark.parametrize(
    ("tap", "expected"),
    [
        (0, []),
        (1, [(0, 1, [0.0]), (0, 1, [10.0])]),
        (2, [(0, 2, [0.0, 1.0]), (0, 2, [10.0, 11.0])]),
        (3, [(0, 2, [0.0, 1.0]), (2, 1, [2.0]), (0, 2, [10.0, 11.0]), (2, 1, [12.0])]),
        (4, []),  # the whole packets are recorded as they are
    ],
)
def test_recorded_lanes_are_copied(tap: int, expected: list[Any]) -> None:
    network, copies = MemoryNetwork(), []

    def record(_: str, payload: bytes) -> None:
        header, arrays = Decoder(Observation, RUN, SIZES).decode(payload)
        copies.append((header.lane, header.lanes, arrays["y"].ravel().tolist()))

    network.bus().subscribe(KEYS.tap(KEYS.sent("observation")), record)
    sent: list[bytes] = []
    network.bus().subscribe(KEYS.sent("observation"), lambda _, payload: sent.append(payload))
    node = Node(network.bus(), RUN, "plant", SIZES, tap=tap)
    send = node.sender(KEYS.sent("observation"), Observation, tap=True)
    for step in (1, 2):
        for lane in (0, 2):
            y = np.array([[lane], [lane + 1.0]]) + 10.0 * (step - 1)
            send(step, lane, 2, {"y": y})
    network.run(lambda: False)
    assert len(sent) == 4
    assert copies == expected


def test_the_report_says_what_was_refused() -> None:
    bench, reports = Bench(), []
    bench.network.bus().subscribe(KEYS.status("estimator.x"), lambda _, payload: reports.append(payload))
    bench.send(b"rubbish")
    bench.node.report("stopped", {"late_acks": 3})
    bench.node.report("failed", {}, "x" * 5000)
    bench.network.run(lambda: False)
    first, second = (Decoder(Status, RUN, SIZES).decode(payload)[0] for payload in reports)
    assert (first.seq, first.state, first.counters, first.rejected) == (0, "stopped", {"late_acks": 3}, {"format": 1})
    assert (second.seq, second.state, len(second.detail)) == (1, "failed", 2000)


def test_who_joins_at_a_step_passes_over_what_was_before() -> None:
    gate = Gate(None)
    bench = Bench(gate=gate)
    assert not bench.send(packet(0, 1))
    assert not bench.send(packet(5, 3, lane=2))
    gate.passed_over = 3
    assert not bench.send(packet(5, 3, lane=2))
    assert not bench.send(packet(6, 4, lane=2))
    assert not bench.send(packet(7, 5, lane=2))
    assert not bench.send(packet(8, 4))
    assert bench.taken == [(6, 4, 2), (7, 5, 2), (8, 4, 0)]
    assert bench.send(packet(9, 3)) == {"order": 1}
    assert bench.send(packet(10, 5)) == {"sequence": 1}


@pytest.mark.parametrize("first", [packet(7, 4), packet(5, 4), packet(6, 5), packet(6, 4, source="plant")])
def test_who_joins_knows_which_packet_must_come_first(first: bytes) -> None:
    bench = Bench(gate=Gate(3))
    assert sum(bench.send(first).values()) + bench.node.repeated == 1
    assert not bench.send(packet(6, 4))
    assert bench.taken == [(6, 4, 0)]


def test_numbers_go_on_from_one_sender_to_the_next() -> None:
    network, heard = MemoryNetwork(), []
    key = KEYS.delivered("observation")
    network.bus().subscribe(key, lambda _, payload: heard.append(Decoder(Observation, RUN, SIZES).decode(payload)[0]))
    gate, late = Gate(0), Gate(None)
    arrays = {"y": np.zeros((2, 1)), "mask": np.ones(2, dtype=np.uint8)}
    senders = [
        Node(network.bus(), RUN, name, SIZES).sender(key, Observation, gate=g)
        for name, g in zip("ab", (gate, late), strict=True)
    ]
    for step, lane in ((1, 0), (1, 2), (2, 2), (2, 0)):
        senders[0](step, lane, 2, arrays)
    late.passed_over = 2
    for step, lane in ((3, 2), (3, 0)):
        senders[1](step, lane, 2, arrays)
    network.run(lambda: False)
    assert [(packet.seq, packet.source) for packet in heard] == [(i, "a" if i < 4 else "b") for i in range(6)]
