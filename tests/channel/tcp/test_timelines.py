"""Timelines with told losses, computed by hand from the rules of the kernel's TCP.

The delay is 10 ms each way, and there is a message each 10 ms.
"""

from __future__ import annotations

from collections.abc import Callable, Collection

import pytest
from hypothesis import given
from hypothesis import strategies as st

from channel.scripted import MS, S, Scripted
from testbed.channel.tcp import TcpCarrier
from testbed.scenario.carriers import TcpTransport

DELAY = 10 * MS
SIZE = 100
Silence = Callable[[int], bool]


class Line:
    """A connection over told losses, with messages at 0, 10, 20, … ms."""

    def __init__(
        self,
        drops: Collection[int] = (),
        ack_drops: Collection[int] = (),
        silent: Silence | None = None,
        **options: object,
    ) -> None:
        never: Silence = lambda now_ns: False  # noqa: E731
        self.forward = Scripted(DELAY, drops, silent or never)
        self.backward = Scripted(DELAY, ack_drops)
        self.carrier = TcpCarrier(
            self.forward, self.backward, TcpTransport.model_validate({"framing_bytes": 0} | options)
        )
        self.got: dict[int, int] = {}

    def send(self, messages: int, first: int = 0) -> Line:
        for number in range(first, first + messages):
            self.carrier.send(number, SIZE, number * 10 * MS)
            self.advance(number * 10 * MS)
        return self

    def advance(self, to_ns: int) -> None:
        for at, number in self.carrier.advance(to_ns):
            assert number not in self.got
            self.got[number] = at

    def finish(self) -> dict[int, int]:
        """Arrival of each message, ms."""
        self.advance(10**12)
        assert self.carrier.books.in_flight == 0
        return {number: at // MS for number, at in self.got.items()}


def test_without_losses_a_message_takes_the_delay() -> None:
    assert Line().send(300).finish() == {k: 10 * k + 10 for k in range(300)}


def test_an_isolated_loss_costs_a_send_interval_and_a_round_trip() -> None:
    # Packet 5 (50 ms) is lost. 6 (60) tells so at 80: its round trip is over, so 5 is lost and sent again, and the
    # window is what is in flight and one more: 8 (80) waits until 7 is reported (90), 9 (90) until 5 is acked (100).
    arrivals = Line({5}).send(20).finish()
    late = {5: 90, 6: 90, 7: 90, 9: 110}
    assert arrivals == {k: late.get(k, 10 * k + 10) for k in range(20)} | {8: 100}


def test_a_lost_last_message_costs_the_time_out() -> None:
    # Message 4 is acked at 60 ms, and one segment is out: the probe would come 2 · 20 + 200 ms later, the time-out
    # is earlier with 20 + 200 ms.
    line = Line({5}).send(6)
    assert line.finish()[5] == 60 + 220 + 10
    assert line.carrier.as_counters()["probes"] == 1


def test_two_lost_last_messages_cost_a_probe() -> None:
    # Two are out: the probe repeats the last one 2 · 20 + 2 ms after it. Its report, at 122, tells that 5 is lost.
    arrivals = Line({5, 6}).send(7).finish()
    assert arrivals[5] == arrivals[6] == 60 + 42 + 20 + 10


def test_a_lost_retransmission_is_found_by_what_was_sent_after_it() -> None:
    # As for an isolated loss, but packet 8, the retransmission at 80, is lost too. 8 is sent at 90 and reported at
    # 110, a round trip after 80: 5 is sent once more and arrives at 120.
    arrivals = Line({5, 8}).send(30).finish()
    assert arrivals[4] == 50
    assert arrivals[5] == 120


def test_time_outs_double() -> None:
    # The probe, 220 ms after the last acknowledgement, finds nothing; the first time-out follows 220 ms later, the
    # next ones after 440, 880, … ms.
    line = Line(silent=lambda now_ns: 45 * MS < now_ns < 5 * S).send(6)
    arrivals = line.finish()
    assert [at // MS - 60 for at, _ in line.forward.log[6:]] == [220, 440, 880, 1760, 3520, 7040]
    assert arrivals[5] == 60 + 7040 + 10


def test_before_the_first_round_trip_the_time_out_is_a_second() -> None:
    assert Line({0}).send(1).finish() == {0: 1010}


def test_a_retransmission_joins_small_messages() -> None:
    # Nothing gets through from 50 ms to 1 s. What waited then leaves in full segments.
    line = Line(silent=lambda now_ns: 45 * MS < now_ns < 1 * S, mss=1000).send(100)
    arrivals = line.finish()
    again = [size - 52 for at, size in line.forward.log if at > 1 * S]
    assert max(again) == 1000
    assert sum(again) < 95 * SIZE + 2 * 1000
    assert sorted(arrivals.values()) == [arrivals[k] for k in range(100)]


@given(st.sets(st.integers(0, 199)))
def test_lost_acknowledgements_alone_delay_nothing(lost: set[int]) -> None:
    drops = {k for k in lost if not {k - 1, k - 2, k - 3} <= lost}  # never four in a row
    assert Line(ack_drops=drops).send(200).finish() == {k: 10 * k + 10 for k in range(200)}


def test_a_delayed_acknowledgement_comes_with_the_second_segment_or_when_its_time_is_over() -> None:
    line = Line(delayed_ack="40 ms").send(101)
    assert line.finish() == {k: 10 * k + 10 for k in range(101)}
    acked = [at // MS for at, _ in line.backward.log]
    assert acked[:16] == [10 * k + 10 for k in range(16)]
    assert acked[16:58] == [10 * k + 10 for k in range(17, 101, 2)]
    assert acked[58:] == [1010 + 40]


def test_an_outage_longer_than_the_lease_closes_the_connection_and_it_opens_again() -> None:
    # The last acknowledgement comes at 1.01 s; 10 s later the connection closes. Requests to open go out each second;
    # that of 15.01 s gets through, and three round trips later, at 15.07 s, the connection is open.
    line = Line(silent=lambda now_ns: 995 * MS < now_ns < 15 * S).send(2000)
    arrivals = line.finish()
    assert arrivals == {k: 10 * k + 10 for k in [*range(100), *range(1507, 2000)]}
    books = line.carrier.books
    assert dict(books.dropped) == {"connection": 1101 - 100, "closed": 1507 - 1101}
    opening = [at // MS - 11_010 for at, size in line.forward.log if size == 60]
    assert opening == [0, 1000, 2000, 3000, 4000, 4020, 4040]
    assert line.carrier.as_counters()["connections_lost"] == line.carrier.as_counters()["attempts"] == 1


def test_requests_to_open_back_off_and_attempts_are_repeated() -> None:
    line = Line(silent=lambda now_ns: 995 * MS < now_ns < 33 * S).send(2000)
    line.advance(30 * S)
    opening = [at // MS - 11_010 for at, size in line.forward.log if size == 60]
    assert opening == [0, 1000, 2000, 3000, 4000, 5000, 7000, 11000, 12000, 13000, 14000, 15000, 16000, 18000]


def test_a_message_that_waits_for_room_too_long_closes_the_connection() -> None:
    # The buffer holds 15 messages: those of 1.00 … 1.14 s. That of 1.15 s waits, for 5 s.
    line = Line(silent=lambda now_ns: 995 * MS < now_ns < 7 * S, buffer_bytes=1500).send(650)
    assert line.carrier.as_counters()["connections_lost"] == 1
    assert line.carrier.books.dropped["connection"] == 615 - 100
    assert line.carrier.books.dropped["closed"] == 650 - 615


def test_a_message_that_waited_for_room_is_sent_when_there_is_some() -> None:
    line = Line(silent=lambda now_ns: 995 * MS < now_ns < 3 * S, buffer_bytes=1500).send(400)
    arrivals = line.finish()
    assert sorted(arrivals) == list(range(400))
    assert line.carrier.books.dropped.total() == 0


def test_a_full_buffer_may_drop() -> None:
    line = Line(silent=lambda now_ns: 995 * MS < now_ns < 1200 * MS, buffer_bytes=1500, when_full="drop").send(120)
    arrivals = line.finish()
    assert sorted(arrivals) == list(range(115))
    assert dict(line.carrier.books.dropped) == {"full": 5}


@pytest.mark.parametrize("congestion", ["cubic", "reno"])
def test_a_loss_shrinks_the_window_and_the_flow_recovers(congestion: str) -> None:
    line = Line({50}, congestion=congestion).send(300)
    arrivals = line.finish()
    assert all(arrivals[k] == 10 * k + 10 for k in range(60, 300))
