"""Orders from another thread."""

from __future__ import annotations

import threading
from typing import Any, cast

import pytest

from testbed.errors import UsageError
from testbed.orchestrator.conductor import Conductor
from testbed.orchestrator.desk import Desk, RunOver


def opened() -> tuple[Desk, list[Any]]:
    desk, done = Desk(), []
    desk.open(cast(Conductor, done))
    return desk, done


def test_orders_are_carried_out_in_turn_on_the_thread_that_works() -> None:
    desk, done = opened()
    results: list[int] = []

    def put() -> None:
        futures = [desk.put(lambda run, i=i: cast(Any, run).append((i, threading.get_ident())) or i) for i in range(5)]
        results.extend(future.result(10) for future in futures)

    other = threading.Thread(target=put)
    other.start()
    while other.is_alive():
        desk.wait(0.01)
    assert results == [0, 1, 2, 3, 4]
    assert done == [(i, threading.get_ident()) for i in range(5)]


def test_an_error_goes_to_who_gave_the_order() -> None:
    desk, _ = opened()

    def refuse(_: Conductor) -> None:
        raise UsageError("got 3; allowed: 4")

    future, after = desk.put(refuse), desk.put(lambda _: "done")
    desk.work()
    with pytest.raises(UsageError, match="got 3; allowed: 4"):
        future.result(0)
    assert after.result(0) == "done"


def test_nothing_is_left_waiting_when_the_run_is_over() -> None:
    desk, done = opened()
    woken: list[int] = []
    desk.wake = lambda: woken.append(1)
    before = desk.put(lambda run: cast(Any, run).append("before"))
    assert woken == [1]
    desk.close()
    for future in (before, desk.put(lambda run: cast(Any, run).append("after"))):
        with pytest.raises(RunOver, match="the run is over"):
            future.result(0)
    assert (done, woken) == ([], [1])
