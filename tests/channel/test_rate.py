"""The bottleneck against a bucket that is filled and emptied token by token, in exact fractions."""

from __future__ import annotations

from collections import deque
from fractions import Fraction
from math import ceil
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from testbed.channel.rate import Bottleneck
from testbed.scenario.impairments import Rate

check = settings(deadline=None, max_examples=120)
Arrivals = list[tuple[int, int]]
"""(time of coming in ns, size in bytes)"""


class Bucket:
    """Packets wait in a queue; the first takes token after token, a byte each, and has left with its last one."""

    def __init__(self, rate: Rate) -> None:
        self.rate, self.speed = rate, Fraction(rate.bits_per_second) / 8_000_000_000
        self.tokens, self.now = Fraction(rate.burst_bytes), Fraction(0)
        self.waiting: deque[tuple[int, int]] = deque()
        self.missing = Fraction(0)
        self.left: dict[int, Fraction] = {}

    def until(self, at: Fraction) -> None:
        while self.waiting:
            done = self.now + self.missing / self.speed
            if done > at:
                self.missing -= (at - self.now) * self.speed
                self.now = at
                return
            self.now = done
            number, _ = self.waiting.popleft()
            self.left[number] = done
            self.missing = Fraction(self.waiting[0][1]) if self.waiting else Fraction(0)
        full = Fraction(self.rate.burst_bytes)
        self.tokens = min(full, self.tokens + (at - self.now) * self.speed)
        self.now = at

    def come(self, number: int, at: int, size: int) -> bool:
        """Whether it was taken."""
        self.until(Fraction(at))
        size += self.rate.overhead_bytes
        if self.waiting:
            limit, most = self.rate.queue_packets, self.rate.queue_bytes
            if limit is not None and len(self.waiting) >= limit:
                return False
            if most is not None and sum(waiting for _, waiting in self.waiting) + size > most:
                return False
        elif self.tokens < size and self.rate.queue_bytes is not None and size > self.rate.queue_bytes:
            return False
        self.waiting.append((number, size))
        if len(self.waiting) == 1:
            taken = min(self.tokens, Fraction(size))
            self.tokens -= taken
            self.missing = size - taken
            self.until(Fraction(at))
        return True


def simulated(rate: Rate, arrivals: Arrivals) -> list[Fraction | None]:
    bucket = Bucket(rate)
    taken = [bucket.come(i, at, size) for i, (at, size) in enumerate(arrivals)]
    bucket.until(Fraction(10) ** 30)
    return [bucket.left[i] if ok else None for i, ok in enumerate(taken)]


@st.composite
def cases(draw: st.DrawFn, whole: bool, queues: bool = True) -> tuple[Rate, Arrivals]:
    """whole: a byte takes a whole number of ns."""
    per_byte = draw(st.sampled_from([1, 2, 5, 8, 40]))
    speed = 8e9 / per_byte if whole else draw(st.floats(1e6, 8e9))
    limit = st.none() | st.integers(1, 5) if queues else st.none()
    most = st.none() | st.integers(1, 400) if queues else st.none()
    rate = Rate(
        bits_per_second=speed,
        burst_bytes=draw(st.sampled_from([0, 0, 50, 100, 300, 1000])),
        queue_packets=draw(limit),
        queue_bytes=draw(most),
        overhead_bytes=draw(st.sampled_from([0, 0, 28])),
    )
    gaps = st.sampled_from([0, 0, 1, 10, 100, 500, 3000]) | st.integers(0, 2000)
    packets = draw(st.lists(st.tuples(gaps, st.integers(1, 200)), min_size=1, max_size=30))
    at, arrivals = 0, []
    for gap, size in packets:
        at += gap
        arrivals.append((at, size))
    return rate, arrivals


def left(rate: Rate, arrivals: Arrivals) -> list[int | None]:
    line = Bottleneck(rate)
    return [line.leave(size, at) for at, size in arrivals]


@check
@given(cases(whole=True))
def test_packets_leave_and_are_dropped_as_from_the_bucket(case: tuple[Rate, Arrivals]) -> None:
    assert left(*case) == simulated(*case)


@check
@given(cases(whole=False, queues=False))
def test_times_are_rounded_up_by_less_than_a_nanosecond_a_packet(case: tuple[Rate, Arrivals]) -> None:
    for i, (found, exact) in enumerate(zip(left(*case), simulated(*case), strict=True)):
        assert found is not None
        assert exact is not None
        assert exact - 1 <= found <= ceil(exact) + i + 1


def flow(rate: Rate, arrivals: Arrivals) -> list[tuple[int, int]]:
    """(time of leaving, size on the line) of the packets that are not dropped."""
    pairs = zip(left(rate, arrivals), arrivals, strict=True)
    return [(at, size + rate.overhead_bytes) for at, (_, size) in pairs if at is not None]


@check
@given(cases(whole=True) | cases(whole=False))
def test_no_interval_has_more_than_the_bucket_and_what_comes_in_it(case: tuple[Rate, Arrivals]) -> None:
    rate, _ = case
    speed = Fraction(rate.bits_per_second) / 8_000_000_000
    packets = flow(*case)
    assert [at for at, _ in packets] == sorted(at for at, _ in packets)
    for i, (begin, first) in enumerate(packets):
        size = 0
        for end, more in packets[i + 1 :]:
            size += more
            tokens = rate.burst_bytes + speed * (end - begin + len(packets))
            assert size <= tokens
            if first <= rate.burst_bytes:
                assert size + first <= tokens


@check
@given(cases(whole=True))
def test_nothing_leaves_before_it_came_and_what_is_dropped_changes_nothing(case: tuple[Rate, Arrivals]) -> None:
    rate, arrivals = case
    found = left(rate, arrivals)
    kept = [pair for pair, at in zip(arrivals, found, strict=True) if at is not None]
    assert left(rate, kept) == [at for at in found if at is not None]
    assert all(at is None or at >= came for at, (came, _) in zip(found, arrivals, strict=True))


def test_a_line_without_a_bucket_sends_bit_after_bit() -> None:
    rate = Rate(bits_per_second=8e6)
    assert left(rate, [(0, 100), (0, 50), (1_000_000, 10), (1_005_000, 10)]) == [100_000, 150_000, 1_010_000, 1_020_000]


def test_a_full_bucket_leaves_at_once_and_is_full_again_after_a_pause() -> None:
    rate = Rate(bits_per_second=8e6, burst_bytes=300)
    together = [100] * 5
    expected = [0, 0, 0, 100_000, 200_000]
    for pause in (0, 500_000, 10**12):
        arrivals = [(0, size) for size in together] + [(pause + 200_000, size) for size in together]
        again = expected if pause >= 300_000 else [100_000 * (i + 1) for i in range(5)]
        assert left(rate, arrivals) == expected + [pause + 200_000 + at for at in again]


def test_the_slowest_line_and_the_deepest_bucket_are_exact() -> None:
    assert left(Rate(bits_per_second=2.0**-60), [(0, 1)]) == [8 * 2**60 * 10**9]
    rate = Rate(bits_per_second=3e15 / 7, burst_bytes=2**40)
    exact = simulated(rate, [(0, 2**40), (1, 1)])[1]
    assert exact is not None
    assert left(rate, [(0, 2**40), (1, 1)]) == [0, ceil(exact)]


def test_in_the_long_run_it_is_the_rate() -> None:
    rate = Rate(bits_per_second=1e6, burst_bytes=3000, queue_packets=10)
    packets = flow(rate, [(i * 100_000, 125) for i in range(50_000)])
    speed = sum(size for _, size in packets) * 8e9 / packets[-1][0]
    assert 1e6 < speed < 1e6 * 1.006


@pytest.mark.parametrize(
    ("after", "expected"),
    [
        ({"bits_per_second": 16e6}, [100_000, 200_000, 300_000, 350_000, 400_000]),
        ({"bits_per_second": 4e6}, [100_000, 200_000, 300_000, 500_000, 700_000]),
    ],
)
def test_a_change_leaves_what_is_queued_as_it_is(after: dict[str, Any], expected: list[int]) -> None:
    line = Bottleneck(Rate(bits_per_second=8e6))
    found = [line.leave(100, 0) for _ in range(3)]
    line.change(Rate(**after))
    assert found + [line.leave(100, 0) for _ in range(2)] == expected


def test_a_change_to_the_same_changes_nothing() -> None:
    rate = Rate(bits_per_second=8e6, burst_bytes=250, queue_packets=4, queue_bytes=350)
    arrivals = [(i * 70_000, 100) for i in range(40)]
    line, found = Bottleneck(rate), []
    for at, size in arrivals:
        line.change(rate)
        found.append(line.leave(size, at))
    assert found == left(rate, arrivals)
    assert None in found
