"""Messages over a pipeline, and their arrival from step to step: against the arrivals that the pipeline announces."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from channel.impaired import MS, NAME, link, pipeline, times_of
from testbed.channel.carrier import Datagrams
from testbed.channel.carriers import carriers_of
from testbed.channel.pipeline import Pipeline
from testbed.channel.schedule import Schedule
from testbed.channel.steps import SteppedLink

SEED, SIZE, LANES, PACKETS = 3, 100, 5, 120
MANY: dict[str, Any] = {
    "loss": {"kind": "markov", "recovery": 0.5, "failure": 0.2},
    "rate": {"bits_per_second": 1.2e5, "burst_bytes": 300, "queue_packets": 3},
    "delay": {"kind": "uniform", "low": "2 ms", "high": "35 ms"},
    "reorder": {"chance": 0.2, "by": "20 ms"},
    "duplicate": {"chance": 0.4, "after": "9 ms"},
    "corrupt": {"chance": 0.3},
}
LINKS: dict[str, dict[str, Any]] = {
    "many": MANY,
    "whole periods": {"delay": {"kind": "constant", "by": "20 ms"}, "loss": MANY["loss"]},
    "slots": {"clock": "time", "slot": "3 ms", "loss": MANY["loss"], "delay": MANY["delay"]},
}


def test_the_books_of_messages_balance_at_all_times() -> None:
    carrier, twin = Datagrams(pipeline(**MANY)), pipeline(**MANY)
    sent = times_of(200)
    sent = [4 * at for at in sent]
    copies = [(copy.at_ns, number, copy.flip is None) for number, at in enumerate(sent) for copy in twin.send(SIZE, at)]
    arrivals = sorted(copies)  # two copies of one message never arrive at one time here
    taken: list[tuple[int, int]] = []
    for number, at in enumerate([*sent, sent[-1] + 1000 * MS]):
        taken += carrier.advance(at)
        if number < len(sent):
            carrier.send(number, SIZE, at)
        seen: dict[int, int] = {}
        causes: Counter[str] = Counter()
        for when, own, intact in arrivals:
            if when <= at and own < number + (when == at and own == number):
                if not intact:
                    causes["corrupt"] += 1
                elif own in seen:
                    causes["duplicate"] += 1
                else:
                    seen[own] = when
        books = carrier.books
        assert sorted(taken) == sorted((when, own) for own, when in seen.items())
        assert {cause: books.dropped[cause] for cause in ("corrupt", "duplicate")} == {
            cause: causes[cause] for cause in ("corrupt", "duplicate")
        }
        assert books.delivered == len(seen)
        assert books.sent == min(number + 1, len(sent))
        assert books.sent + books.duplicated == books.delivered + books.dropped.total() + books.in_flight
        under_way = [when for when, own, _ in arrivals if own <= number and (when > at or own == number)]
        assert books.in_flight == len(under_way)
        assert carrier.next_ns == (min(under_way) if under_way else None)
    assert books.in_flight == 0
    assert min(books.dropped[cause] for cause in ("loss", "queue", "corrupt", "duplicate")) > 0


@given(st.lists(st.tuples(st.integers(0, 5), st.booleans()), max_size=30))
@settings(deadline=None, max_examples=50)
def test_a_schedule_is_sorted_by_time_then_by_order_of_coming(moves: list[tuple[int, bool]]) -> None:
    schedule: Schedule[int] = Schedule()
    waiting: list[tuple[int, int]] = []
    for i, (at, out) in enumerate(moves):
        if out:
            due = sorted(pair for pair in waiting if pair[0] <= at)
            assert list(schedule.due(at)) == due
            waiting = [pair for pair in waiting if pair[0] > at]
        else:
            schedule.push(at, i)
            waiting.append((at, i))
        assert len(schedule) == len(waiting)
        assert schedule.next_ns == (min(waiting)[0] if waiting else None)


def first_arrivals(keys: dict[str, Any], lane: int, period: int) -> list[int | None]:
    """When each packet, sent a period after the one before, first arrives intact; None: never."""
    pipe = Pipeline(link(**keys), SEED, NAME, lane)
    sent = [pipe.send(SIZE, number * period) for number in range(PACKETS)]
    times = [[copy.at_ns for copy in copies if copy.flip is None] for copies in sent]
    return [min(own) if own else None for own in times]


@pytest.mark.parametrize("name", LINKS)
@pytest.mark.parametrize("deadline", [10 * MS, 4 * MS])
@pytest.mark.parametrize("blocks", [(5,), (1, 1, 3), (2, 3)])
def test_a_packet_is_in_time_or_belongs_to_a_later_one(name: str, deadline: int, blocks: tuple[int, ...]) -> None:
    period = 10 * MS
    expected = [first_arrivals(LINKS[name], lane, period) for lane in range(LANES)]
    lane, late_ones = 0, 0
    for lanes in blocks:
        stepped = SteppedLink(carriers_of(link(**LINKS[name]), SEED, NAME, lane, lanes), SIZE, period, deadline)
        for number in range(PACKETS):
            arrivals = stepped.send(number)
            begin, end = (number - 1) * period + deadline, number * period + deadline
            for i in range(lanes):
                own = expected[lane + i]
                at = own[number]
                assert bool(arrivals.in_time[i]) == (at is not None and at <= end)
                late = {
                    j
                    for j in range(number)
                    if (at := own[j]) is not None and max(begin, j * period + deadline) < at <= end
                }
                assert {j for j, mask in arrivals.late if mask[i]} == late
                late_ones += len(late)
            assert [j for j, _ in arrivals.late] == sorted({j for j, _ in arrivals.late})
            assert all(mask.any() for _, mask in arrivals.late)
        lane += lanes
    assert late_ones > 20


def test_a_change_is_for_the_packets_from_then_on() -> None:
    period, by = 10 * MS, {"delay": {"kind": "constant", "by": "25 ms"}}
    stepped = SteppedLink(carriers_of(link(**by), SEED, NAME, 0, 2), SIZE, period, period)
    found = []
    for number in range(8):
        if number == 4:
            stepped.change(link())
        arrivals = stepped.send(number)
        found.append((arrivals.in_time.tolist(), [j for j, _ in arrivals.late]))
    no, yes = [False] * 2, [True] * 2
    assert found == [(no, []), (no, []), (no, [0]), (no, [1]), (yes, [2]), (yes, [3]), (yes, []), (yes, [])]
    assert (stepped.books.sent, stepped.books.delivered, stepped.books.in_flight) == (16, 16, 0)


def test_lanes_are_different_links() -> None:
    masks = [first_arrivals(MANY, lane, 10 * MS) for lane in range(LANES)]
    assert len({tuple(at is None for at in mask) for mask in masks}) == LANES
    assert np.ptp([sum(at is None for at in mask) for mask in masks]) < PACKETS / 2
