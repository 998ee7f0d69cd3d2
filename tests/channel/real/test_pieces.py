"""The small parts of real links: frames, the messages under way, the account of what is missing, the timer."""

from __future__ import annotations

import io
import queue
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from testbed.channel.real.books import accounted
from testbed.channel.real.frames import framed, messages
from testbed.channel.real.outstanding import Outstanding
from testbed.channel.real.timer import Timer


@given(st.lists(st.binary(max_size=300)), st.integers(1, 40))
def test_frames_come_back_whole_and_a_torn_one_does_not_come(sent: list[bytes], torn: int) -> None:
    pipe = b"".join(map(framed, sent))
    assert list(messages(io.BytesIO(pipe))) == sent
    cut = framed(bytes(40))[:torn]
    assert list(messages(io.BytesIO(pipe + cut))) == sent


def test_only_what_was_sent_is_known_and_the_oldest_is_forgotten() -> None:
    under_way: Outstanding[int] = Outstanding(bytes_max=250)
    for number in range(3):
        under_way.add(bytes([number]) * 100, number)
    assert [under_way.find(bytes([number]) * 100) for number in range(4)] == [None, 1, 2, None]
    altered = bytearray(bytes([1]) * 100)
    altered[50] ^= 1
    assert under_way.find(bytes(altered)) is None


@given(
    st.integers(0, 60),
    st.integers(1, 4),
    st.dictionaries(
        st.sampled_from(["in_flight", "dropped_loss", "dropped_queue", "dropped_corrupt", "corrupted", "sent"]),
        st.integers(0, 20),
    ),
    st.integers(0, 5),
    st.none() | st.integers(0, 10),
)
def test_all_that_is_missing_is_accounted_for_once(
    missing: int, each: int, packets: dict[str, int], refused: int, in_flight: int | None
) -> None:
    parts = accounted(missing, each, packets, refused=refused, in_flight=in_flight)
    assert sum(parts.values()) == missing
    assert all(count > 0 for count in parts.values())
    for name, count in parts.items():
        if name in packets and in_flight is None:
            assert count <= each * packets[name]


def test_the_causes_are_those_of_the_packets_and_the_rest_is_elsewhere() -> None:
    packets = {"in_flight": 1, "dropped_loss": 5, "dropped_queue": 2, "corrupted": 3}
    parts = accounted(26, 2, packets, refused=1, in_flight=None)
    assert parts == {
        "dropped_full": 2,
        "in_flight": 2,
        "dropped_loss": 10,
        "dropped_queue": 4,
        "dropped_corrupt": 6,
        "dropped_elsewhere": 2,
    }
    over_tcp = accounted(10, 1, packets, refused=0, in_flight=7)
    assert over_tcp == {"in_flight": 7, "dropped_elsewhere": 3}


def test_orders_are_handed_over_in_the_order_of_time_and_then_of_giving() -> None:
    done: queue.SimpleQueue[int] = queue.SimpleQueue()
    now_ns = time.monotonic_ns()
    with Timer(lambda order: order()) as timer:
        for number, after_ms in ((3, 60), (1, 30), (4, 60), (2, 45), (0, -5)):
            timer.at(now_ns + after_ms * 1_000_000, lambda number=number: done.put((number, time.monotonic_ns())))
        got = [done.get(timeout=10) for _ in range(5)]
    assert [number for number, _ in got] == [0, 1, 2, 3, 4]
    assert all(at_ns >= now_ns + due * 1_000_000 for (_, at_ns), due in zip(got[1:], (30, 45, 60, 60), strict=True))
    with pytest.raises(queue.Empty):
        done.get_nowait()
