"""The thread behind links over real sockets: orders, errors, the end."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import pytest

from channel.sockets.ends import datagram, udp_ends, until
from testbed.channel.sockets.loop import LinkFailed, Loop
from testbed.channel.sockets.tracing import TraceWriter
from testbed.channel.sockets.udp_relay import UdpRelay
from testbed.errors import RunFailed

FULL = Path("/dev/full")


def test_it_calls_at_the_time_asked_for_and_not_before():
    calls: list[int] = []

    def due(now_ns: int) -> int | None:
        calls.append(now_ns)
        return next((at_ns for at_ns in (300_000, 5_000_000) if at_ns > now_ns), None)

    loop = Loop("test", due)
    loop.start()
    until(lambda: bool(calls) and calls[-1] >= 5_000_000, "called")
    loop.stop()


def test_an_order_gives_back_what_it_returns_or_raises():
    loop = Loop("test", lambda _: None)
    loop.start()
    names: list[str] = []
    assert loop.call(lambda: names.append(threading.current_thread().name) or 7) == 7
    assert names == ["test"]
    with pytest.raises(ZeroDivisionError):
        loop.call(lambda: 1 // 0)
    assert loop.call(lambda: 8) == 8
    loop.stop()


def test_an_error_of_the_thread_reaches_whoever_waits_and_leaves_no_thread():
    def due(now_ns: int) -> int | None:
        if now_ns > 20_000_000:
            raise ValueError("broken")
        return now_ns + 1_000_000

    loop = Loop("test", due)
    loop.start()
    with pytest.raises(LinkFailed, match="test: ValueError"):
        loop.wait(20)
    with pytest.raises(LinkFailed, match="test: ValueError"):
        loop.stop()
    assert "test" not in {thread.name for thread in threading.enumerate()}


def test_an_order_that_the_end_overtakes_fails():
    loop = Loop("test", lambda _: None)
    loop.start()
    errors: list[BaseException] = []

    def order() -> None:
        try:
            loop.call(lambda: None)
        except LinkFailed as error:
            errors.append(error)

    def last() -> None:
        thread.start()
        until(lambda: bool(loop._orders), "waits")
        raise SystemExit

    thread = threading.Thread(target=order)
    loop.watch(loop._wake, lambda _: last())
    with pytest.raises(LinkFailed):
        loop.call(lambda: None)
    thread.join(20)
    assert len(errors) == 1
    with pytest.raises(LinkFailed):
        loop.stop()


def flood(trace: Path) -> None:
    with udp_ends(lambda to: UdpRelay(to, traces={"forward": trace})) as (relay, client, _):
        deadline = time.monotonic() + 20
        while time.monotonic() < deadline:
            client.send(datagram(0))
            relay.wait(0.0)


@pytest.mark.skipif(not FULL.exists(), reason="no /dev/full")
def test_a_trace_that_cannot_be_written_ends_the_relay_with_a_reason():
    with pytest.raises((LinkFailed, RunFailed), match="no space left"):
        flood(FULL)
    with pytest.raises(RunFailed, match="cannot write /dev/full: no space left"):
        TraceWriter(FULL).close()
