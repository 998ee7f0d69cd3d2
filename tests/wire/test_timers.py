"""Calls at a time: in order, never early; and the clocks of the two buses."""

from __future__ import annotations

import time
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from orchestrator.wall_clock import TestClock
from testbed.wire.memory_bus import MemoryNetwork
from testbed.wire.timers import Timers, WallClock


@given(st.lists(st.integers(0, 50), max_size=20), st.lists(st.integers(1, 20), max_size=10))
def test_calls_are_made_in_order_and_not_before_their_time(due: list[int], sleeps: list[int]) -> None:
    clock = TestClock()
    timers, made, start = Timers(clock), [], clock.now_ns

    def noted(number: int) -> Any:
        return lambda: made.append((due[number], number, clock.now_ns - start))

    for number, at in enumerate(due):
        timers.at(start + at, noted(number))
    for duration in [0, *sleeps]:
        clock.now_ns += duration
        timers.fire()
        now = clock.now_ns - start
        assert [one[:2] for one in made] == sorted((at, n) for n, at in enumerate(due) if at <= now)
        left = [at - now for at in due if at > now]
        assert timers.wait_s == (min(left) / 1e9 if left else float("inf"))
    assert all(at <= when for at, _, when in made)


def test_what_a_call_adds_is_made_too_where_it_is_due() -> None:
    clock = TestClock()
    timers, made = Timers(clock), []

    def again() -> None:
        made.append(clock.now_ns)
        if len(made) < 3:
            timers.at(clock.now_ns - 1, again)

    timers.at(clock.now_ns, again)
    assert timers.fire()
    assert len(made) == 3
    assert not timers.fire()


def test_a_date_as_monotonic_time_is_never_early() -> None:
    clock = WallClock()
    for _ in range(200):
        date = time.time_ns() + 20_000
        due = clock.monotonic_of(date)
        while time.monotonic_ns() < due:
            pass
        assert time.time_ns() >= date


def test_messages_on_the_in_process_bus_carry_their_dates_and_calls_come_first() -> None:
    clock = TestClock()
    network = MemoryNetwork(timed=True, clock=clock)
    sender, receiver = network.bus(), network.bus()
    seen: list[Any] = []
    receiver.subscribe("a", lambda _, payload: seen.append((payload, receiver.published_ns, receiver.arrived_ns)))
    publish = sender.publisher("a")
    published = clock.date_ns()
    publish(b"1")
    clock.now_ns += 700
    receiver.at(clock.now_ns, lambda: seen.append("call"))
    receiver.at(clock.now_ns + 5_000, lambda: seen.append("later"))
    assert network.step()
    assert network.step()
    assert seen == ["call", (b"1", published, published + 700)]
    assert network.step()  # sleeps
    assert clock.date_ns() == published + 5_700
    assert network.step()
    assert seen[-1] == "later"
    assert not network.step()
