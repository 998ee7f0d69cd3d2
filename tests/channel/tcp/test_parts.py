"""Round trips, windows and the receiving end, each from its definition."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from channel.scripted import MS
from testbed.channel.tcp.congestion import Cubic, Reno, Window
from testbed.channel.tcp.receiver import Receiver
from testbed.channel.tcp.rtt import RoundTrips
from testbed.channel.tcp.scoreboard import News, Scoreboard
from testbed.channel.tcp.segment import Ack, Data, Segment


def test_the_first_round_trip_gives_the_time_out_of_rfc_6298() -> None:
    trips = RoundTrips()
    assert trips.timeout_ns == 1000 * MS
    trips.sample(600 * MS, 1, 2)
    assert trips.timeout_ns == 600 * MS + 4 * 300 * MS


def test_a_constant_round_trip_ends_at_the_least_variance() -> None:
    trips = RoundTrips()
    for k in range(2000):
        trips.sample(50 * MS, k + 1, k + 2)
    assert trips.smoothed_ns == 50 * MS
    assert trips.timeout_ns == pytest.approx(250 * MS, rel=1e-6)


@given(st.lists(st.integers(1, 10**10), min_size=1, max_size=60))
def test_the_time_out_covers_the_smoothed_round_trip_and_200_ms(samples: list[int]) -> None:
    trips = RoundTrips()
    exact = float(samples[0])
    for k, sample in enumerate(samples):
        trips.sample(sample, k + 1, k + 2)
        if k:
            exact += (sample - exact) / 8
        assert trips.smoothed_ns == pytest.approx(exact, abs=10)
        assert min(trips.smoothed_ns + 200 * MS, 120_000 * MS) <= trips.timeout_ns <= 120_000 * MS
    before = trips.timeout_ns
    trips.back_off()
    assert trips.timeout_ns == min(2 * before, 120_000 * MS)


def test_reno_grows_by_one_segment_a_round_trip_and_halves() -> None:
    window, reno = Window(), Reno()
    window.size = window.threshold = 20
    for _ in range(5):
        for _ in range(window.size):
            reno.grow(window, 1, 0)
    assert window.size == 25
    assert reno.threshold(25) == 12
    assert reno.threshold(3) == 2


def test_slow_start_doubles_the_window_each_round_trip_up_to_the_threshold() -> None:
    window, reno = Window(), Reno()
    window.threshold = 32
    for expected in (20, 32):
        for _ in range(window.size):
            if window.slow_start:
                reno.grow(window, 1, 0)
        assert window.size == expected


def test_cubic_follows_its_curve() -> None:
    # RFC 9438: W(t) = 0.4 (t - K)^3 + W_max, K = ((W_max - W) / 0.4)^(1/3), from W = 0.7 W_max. Round trip 100 ms.
    window, cubic = Window(), Cubic()
    window.size = 1000
    window.size = window.threshold = cubic.threshold(1000)
    assert window.size == 700
    k = (300 / 0.4) ** (1 / 3)
    for step in range(int(1.5 * k * 10)):
        cubic.grow(window, window.size, step * 100 * MS)
        curve = 1000 + 0.4 * (step / 10 - k) ** 3
        assert window.size == pytest.approx(curve, rel=0.04)


class _Acks:
    def __init__(self, delay_ns: int = 0, keep_alive_ns: int = 0) -> None:
        self.all: list[Ack] = []
        self.receiver = Receiver(delay_ns, lambda ack, now_ns: self.all.append(ack), keep_alive_ns)


@given(st.lists(st.tuples(st.integers(0, 40), st.integers(1, 10)), min_size=1, max_size=40))
def test_the_receiver_reports_what_has_arrived(ranges: list[tuple[int, int]]) -> None:
    acks, arrived = _Acks(), set[int]()
    for now, (start, length) in enumerate(ranges):
        new = set(range(start, start + length))
        again = new & arrived
        arrived |= new
        moved = acks.receiver.segment(Data(start, start + length, now), now)
        ack = acks.all[-1]
        assert len(acks.all) == now + 1
        assert ack.upto == acks.receiver.expected == next(k for k in range(60) if k not in arrived)
        assert moved == (ack.upto > (acks.all[-2].upto if now else 0))
        assert len(ack.blocks) + (ack.duplicate is not None) <= 3
        for low, high in ack.blocks:  # whole runs of what has arrived
            assert low > ack.upto
            assert set(range(low, high)) <= arrived
            assert low - 1 not in arrived
            assert high not in arrived
        assert len(set(ack.blocks)) == len(ack.blocks)
        if start > ack.upto:
            assert ack.blocks[0][0] <= start
            assert start + length <= ack.blocks[0][1]
        if ack.duplicate is not None:
            assert set(range(*ack.duplicate)) <= again
        assert (ack.duplicate is not None) == bool(again)


@pytest.mark.parametrize("times", [[5, 9, 14], [5]])
def test_the_echo_is_of_the_segment_that_moved_the_left_edge(times: list[int]) -> None:
    acks = _Acks()
    for k, at in enumerate(times):
        acks.receiver.segment(Data(k, k + 1, at), at)
    acks.receiver.segment(Data(10, 11, 99), 99)  # beyond a gap: does not count
    assert [ack.echo for ack in acks.all] == [*times, times[-1]]


def test_the_echo_is_not_of_a_segment_from_before_the_last_acknowledgement() -> None:
    """RFC 9293, 3.10.7.4: it is answered, and nothing else in it is looked at. One that ends there is acceptable."""
    acks = _Acks()
    acks.receiver.segment(Data(0, 10, 5), 5)
    acks.receiver.segment(Data(10, 20, 6), 6)
    acks.receiver.segment(Data(0, 10, 300), 300)
    acks.receiver.segment(Data(10, 20, 400), 400)
    assert [(ack.echo, ack.duplicate) for ack in acks.all] == [(5, None), (6, None), (6, (0, 10)), (400, (10, 20))]


def test_acknowledgements_are_delayed_from_a_keep_alive_until_a_segment_comes_twice() -> None:
    """At 25 ms something is sent back, as at every other multiple of 25 ms. The first 16 are never delayed."""
    acks = _Acks(40 * MS, keep_alive_ns=25 * MS)

    def prompt(number: int, at_ms: int) -> bool:
        """Whether this segment, in order, is acknowledged as it arrives."""
        before = len(acks.all)
        acks.receiver.segment(Data(number, number + 1, at_ms), at_ms * MS)
        return len(acks.all) > before

    assert all(prompt(number, 1 + number) for number in range(24))
    assert [prompt(number, 1 + number) for number in range(24, 28)] == [False, True, False, True]
    acks.receiver.segment(Data(3, 4, 29), 29 * MS)
    assert all(prompt(number, 2 + number) for number in range(28, 48))  # 30 … 49 ms
    assert [prompt(number, 2 + number) for number in range(48, 52)] == [False, True, False, True]


def test_the_round_trip_of_rack_is_that_of_the_last_segment_acknowledged_in_order() -> None:
    """Sent at 0, 10 and 20 ms; at 23 ms the first is acknowledged, late, and the third reported beyond the second. RACK
    then allows the second the round trip of the first, 23 ms, of which 13 are over; with the first acknowledged before,
    3 ms, which are over."""

    def left_ms(first_ack_ms: int) -> tuple[float, int]:
        board = Scoreboard(1448)
        for number, at_ms in enumerate((0, 10, 20)):
            board.queue.append(Segment(number, number + 1, at_ms * MS))
        board.next = 3
        if first_ack_ms < 23:
            board.una = 1
            board.clean(Ack(1, 0, ()), 0, 3 * MS, first_ack_ms * MS, News())
        ack = Ack(1, 0, ((2, 3),))
        board.una = 1
        board.take_sacks(ack, 0, 3 * MS, 23 * MS, News())
        board.clean(ack, 0, 3 * MS, 23 * MS, News())
        wait_ns = board.detect(0, 23 * MS)[1]
        return wait_ns / MS, board.lost

    assert left_ms(23) == (10, 0)
    assert left_ms(3) == (0, 1)
