"""Fates told in order, against what the order of arrivals and deadlines says by definition."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from testbed.channel.real.fates import Fates

LANES = 3


@st.composite
def histories(draw: st.DrawFn) -> list[tuple[str, int]]:
    """Events of n packets: each is sent, in order; later given up, in order; and arrives up to twice, or never."""
    count = draw(st.integers(1, 8))
    times = []
    for number in range(count):
        times.append((10.0 * number, "sent", number))
        times.append((10.0 * number + 25.0, "give up", number))
        for delay in draw(st.lists(st.floats(0.5, 80.0), max_size=2)):
            times.append((10.0 * number + delay, "arrived", number))
    return [(what, number) for _, what, number in sorted(times)]


@given(histories())
def test_each_packet_is_told_once_in_order_and_late_ones_once_with_a_later_one(history: list[tuple[str, int]]) -> None:
    fates = Fates(LANES)
    in_time: dict[int, bool] = {}
    late: list[int] = []
    for what, number in history:
        if what == "sent":
            assert fates.sent() == number
        elif what == "arrived":
            fates.arrived(number)
        else:
            fates.give_up(number)
        while fates.ready:
            told = fates.next
            arrivals = fates.send(told)
            assert told == len(in_time)
            assert set(arrivals.in_time) == {bool(arrivals.in_time[0])}
            in_time[told] = bool(arrivals.in_time[0])
            assert all(one < told and lanes.all() for one, lanes in arrivals.late)
            late += [one for one, _ in arrivals.late]
    place = {}
    for at, event in enumerate(history):
        place.setdefault(event, at)
    sent = [number for what, number in history if what == "sent"]
    expected = {n: ("arrived", n) in place and place["arrived", n] < place["give up", n] for n in sent}
    assert in_time == expected
    never = [n for n in sent if ("arrived", n) not in place]
    arrivals_in_all = sum(what == "arrived" for what, _ in history)
    too_late = [n for n in sent if not expected[n] and n not in never]
    assert len(late) == len(set(late))
    assert len(late) + fates.waiting_late // LANES == len(too_late)
    assert set(late) <= set(too_late)
    assert fates.repeated == arrivals_in_all - (len(sent) - len(never))
    books = fates.books
    assert (books.sent, books.delivered) == (LANES * len(sent), LANES * (sum(expected.values()) + len(late)))
    assert books.in_flight == fates.waiting_late + LANES * len(never)
