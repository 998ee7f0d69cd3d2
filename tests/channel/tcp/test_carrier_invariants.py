"""What holds over any pipelines: order, once each, no earlier than the path allows, books that balance."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from channel.scripted import MS, S
from testbed.channel.pipeline import Pipeline
from testbed.channel.tcp import TcpCarrier
from testbed.scenario.carriers import TcpTransport
from testbed.scenario.links import Impairments, SteppedImpairments

PATIENT: dict[str, Any] = {"lease": "1000000 s", "blocked_limit": "1000000 s"}

losses = st.one_of(
    st.just({"kind": "none"}),
    st.builds(lambda loss: {"kind": "bernoulli", "loss": loss}, st.floats(0, 0.4)),
    st.builds(
        lambda recovery, failure: {"kind": "markov", "recovery": recovery, "failure": failure},
        st.floats(0.2, 1),
        st.floats(0, 0.3),
    ),
)


@st.composite
def links(draw: st.DrawFn) -> Impairments:
    low = draw(st.integers(1, 50))
    keys: dict[str, Any] = {
        "loss": draw(losses),
        "delay": {"kind": "uniform", "low": f"{low} ms", "high": f"{low + draw(st.integers(0, 40))} ms"},
    }
    if draw(st.booleans()):
        keys["duplicate"] = {"chance": 0.1, "after": "3 ms"}
    if draw(st.booleans()):
        keys["corrupt"] = {"chance": 0.05}
    if draw(st.booleans()):
        keys["reorder"] = {"chance": 0.05, "by": "30 ms"}
    if draw(st.booleans()):
        keys["rate"] = {"bits_per_second": 1e6, "queue_packets": 20}
    return Impairments.model_validate(keys)


transports = st.fixed_dictionaries(
    {
        "congestion": st.sampled_from(["cubic", "reno"]),
        "mss": st.sampled_from([100, 536, 1448]),
        "delayed_ack": st.sampled_from(["0 s", "40 ms"]),
        "buffer_bytes": st.sampled_from([2000, 20000]),
    }
)
gaps = st.lists(st.integers(0, 60 * MS), min_size=1, max_size=80)
seeds = st.integers(0, 2**32)


def _carrier(forward: Impairments, backward: Impairments, seed: int, keys: dict[str, Any]) -> TcpCarrier:
    pipelines = Pipeline(forward, seed, "forward"), Pipeline(backward, seed, "backward")
    return TcpCarrier(*pipelines, TcpTransport.model_validate(keys))


def _least_ns(link: Impairments) -> int:
    assert link.delay is not None
    assert link.delay.kind == "uniform"
    return int(link.delay.low.removesuffix(" ms")) * MS


def _check_books(carrier: TcpCarrier, sent: int, got: int) -> None:
    books = carrier.books
    assert books.sent == sent
    assert books.delivered == got
    assert books.sent == books.delivered + books.dropped.total() + books.in_flight
    assert books.in_flight >= 0
    assert (books.in_flight > 0) <= (carrier.next_ns is not None)


def _run(carrier: TcpCarrier, gaps: list[int], size: int, to_ns: int) -> tuple[list[tuple[int, int]], list[int]]:
    got: list[tuple[int, int]] = []
    times: list[int] = []
    now = 0
    for number, gap in enumerate(gaps):
        now += gap
        times.append(now)
        carrier.send(number, size, now)
        got += carrier.advance(now)
        _check_books(carrier, number + 1, len(got))
    got += carrier.advance(to_ns)
    _check_books(carrier, len(gaps), len(got))
    return got, times


@settings(max_examples=60, deadline=None)
@given(forward=links(), backward=links(), keys=transports, gaps=gaps, size=st.integers(1, 4000), seed=seeds)
def test_every_message_arrives_once_and_in_order(
    forward: Impairments, backward: Impairments, keys: dict[str, Any], gaps: list[int], size: int, seed: int
) -> None:
    carrier = _carrier(forward, backward, seed, keys | PATIENT)
    got, sent = _run(carrier, gaps, size, 10**6 * S)
    assert [number for _, number in got] == list(range(len(gaps)))
    assert [at for at, _ in got] == sorted(at for at, _ in got)
    least_ns = _least_ns(forward)
    assert all(at >= sent[number] + least_ns for at, number in got)
    assert carrier.next_ns is None


@settings(max_examples=40, deadline=None)
@given(forward=links(), backward=links(), keys=transports, gaps=gaps, seed=seeds)
def test_over_lost_connections_messages_arrive_at_most_once_and_in_order(
    forward: Impairments, backward: Impairments, keys: dict[str, Any], gaps: list[int], seed: int
) -> None:
    keys = keys | {"lease": "300 ms", "open_limit": "2 s", "retry": "100 ms"}
    carrier = _carrier(forward, backward, seed, keys)
    got, _ = _run(carrier, gaps, 200, 10**5 * S)
    numbers = [number for _, number in got]
    assert numbers == sorted(set(numbers))
    assert carrier.books.in_flight == 0
    if not carrier.as_counters()["connections_lost"]:
        assert len(numbers) == len(gaps)


@settings(max_examples=30, deadline=None)
@given(
    forward=links(),
    backward=links(),
    keys=transports,
    gaps=gaps,
    seed=seeds,
    steps=st.lists(st.integers(1, S), max_size=20),
)
def test_how_often_it_is_advanced_changes_nothing(
    forward: Impairments, backward: Impairments, keys: dict[str, Any], gaps: list[int], seed: int, steps: list[int]
) -> None:
    often, seldom = (_carrier(forward, backward, seed, keys) for _ in range(2))
    got_often: list[tuple[int, int]] = []
    now = 0
    for number, gap in enumerate(gaps):
        got_often += often.advance(now + gap // 3)
        now += gap
        often.send(number, 100, now)
        seldom.send(number, 100, now)
    for step in steps:
        now += step
        got_often += often.advance(now)
    while often.next_ns is not None and often.next_ns < 100 * S:
        got_often += often.advance(often.next_ns)
    assert seldom.advance(100 * S) == got_often + often.advance(100 * S)
    assert seldom.books == often.books


def test_every_packet_is_in_the_books_of_its_pipeline() -> None:
    link = Impairments.model_validate(
        {
            "loss": {"kind": "bernoulli", "loss": 0.1},
            "delay": {"kind": "constant", "by": "10 ms"},
            "duplicate": {"chance": 0.1},
            "corrupt": {"chance": 0.1},
        }
    )
    forward, backward = Pipeline(link, 1, "forward"), Pipeline(link, 1, "backward")
    carrier = TcpCarrier(forward, backward, TcpTransport.model_validate(PATIENT))
    _run(carrier, [10 * MS] * 300, 64, 10**6 * S)
    for pipeline in (forward, backward):
        assert pipeline.books.in_flight == 0
        assert pipeline.books.dropped["corrupt"] == pipeline.books.corrupted > 0


@pytest.mark.parametrize("loss", [0.01, 0.05])
def test_time_outs_are_rare_among_isolated_losses(loss: float) -> None:
    link = Impairments.model_validate(
        {"loss": {"kind": "bernoulli", "loss": loss}, "delay": {"kind": "constant", "by": "10 ms"}}
    )
    carrier = _carrier(link, link, 1, {})
    _run(carrier, [10 * MS] * 5000, 64, 10**5 * S)
    counters = carrier.as_counters()
    assert counters["recoveries"] > 0.5 * loss * 5000
    assert counters["timeouts"] < 0.1 * loss * 5000


@pytest.mark.parametrize("congestion", ["cubic", "reno"])
def test_more_than_a_bottleneck_carries_fills_it_without_time_outs(congestion: str) -> None:
    delay = {"kind": "constant", "by": "10 ms"}
    rate = {"bits_per_second": 5e6, "queue_packets": 20}
    carrier = _carrier(
        Impairments.model_validate({"delay": delay, "rate": rate}),
        Impairments.model_validate({"delay": delay}),
        1,
        {"congestion": congestion, "framing_bytes": 0},
    )
    got: list[tuple[int, int]] = []
    for number in range(1000):  # 8 Mbit/s
        carrier.send(number, 10_000, number * 10 * MS)
        got += carrier.advance(number * 10 * MS)
    assert 0.95 < len(got) * 80_000 / (10 * 5e6 * 1448 / 1500) < 1.0
    assert carrier.as_counters()["recoveries"] > 0
    assert carrier.as_counters()["timeouts"] == 0


def test_a_change_reaches_both_directions() -> None:
    slow, slower = ({"kind": "constant", "by": f"{by} ms"} for by in (10, 30))
    for back, acked_ms in ((None, 60), ({"delay": slow}, 40)):
        link = Impairments.model_validate({"delay": slow})
        pipelines = Pipeline(link, 1, "forward"), Pipeline(link, 1, "backward")
        carrier = TcpCarrier(*pipelines, TcpTransport())
        carrier.change(SteppedImpairments.model_validate({"delay": slower, "transport": {"kind": "tcp"}, "back": back}))
        carrier.send(0, 64, 0)
        assert carrier.advance(S) == [(30 * MS, 0)]
        carrier.send(1, 64, S)
        carrier.advance(S + acked_ms * MS - 1)
        assert pipelines[1].books.in_flight == 1
        carrier.advance(S + acked_ms * MS)
        assert pipelines[1].books.in_flight == 0
