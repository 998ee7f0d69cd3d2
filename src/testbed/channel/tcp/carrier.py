"""Messages over a connection: the two ends, the packets between them, and the life of the connection."""

from __future__ import annotations

import heapq
from collections import deque
from typing import Final

from testbed.channel.message_books import MessageBooks
from testbed.channel.pipeline import Pipeline
from testbed.channel.tcp.congestion import congestion_of
from testbed.channel.tcp.opening import Opening
from testbed.channel.tcp.receiver import Receiver
from testbed.channel.tcp.segment import Ack, Data
from testbed.channel.tcp.sender import Sender
from testbed.scenario.carriers import TcpTransport
from testbed.scenario.durations import parse_duration
from testbed.scenario.links import Impairments, SteppedImpairments

HEADER_BYTES: Final = 52
"""Of IP and TCP, with the time stamps."""
_SETUP_BYTES: Final = 60

_DATA: Final = 0
_ACK: Final = 1
_REQUEST: Final = 2
_ANSWER: Final = 3


class TcpCarrier:
    """A connection from the sending to the receiving application over two pipelines, open at the start.

    Data segments and the requests to open cross ``forward``, acknowledgements and answers ``backward``. The sizes given
    to the pipelines are those of the IP packets. A packet with a flipped bit fails its checksum.
    """

    def __init__(self, forward: Pipeline, backward: Pipeline, options: TcpTransport) -> None:
        self.books = MessageBooks()
        self.connections_lost = 0
        self.attempts = 0
        self._timeouts = self._probes = self._retransmissions = self._recoveries = 0
        self._pipelines = (forward, backward, forward, backward)  # by kind of packet
        self._options = options
        self._framing, self._buffer = options.framing_bytes, options.buffer_bytes
        self._blocks, self._waiting_max = options.when_full == "block", options.waiting_max
        self._delayed_ack_ns = parse_duration(options.delayed_ack, zero=True)
        self._keep_alive_ns = parse_duration(options.keep_alive, zero=True)
        self._blocked_limit_ns = parse_duration(options.blocked_limit)
        self._lease_ns = parse_duration(options.lease)
        self._packets: list[tuple[int, int, int, int, Data | Ack | int]] = []  # time, order, connection, kind, content
        self._sent = 0
        self._connection = 0
        self._opening: Opening | None = None
        self._got: list[tuple[int, int]] = []
        self._open(None)

    # The interface of a carrier

    def send(self, number: int, size: int, now_ns: int) -> None:
        """A message of ``size`` bytes is handed over."""
        self._run(now_ns)
        self.books.sent += 1
        size += self._framing
        if self._opening is not None:
            self.books.drop("closed")
        elif not self._waiting and self._fits(size):
            self._write(number, size, now_ns)
        elif self._blocks and len(self._waiting) < self._waiting_max:
            if not self._waiting:
                self._blocked_ns = now_ns
            self._waiting.append((number, size))
        else:
            self.books.drop("full")

    def advance(self, to_ns: int) -> list[tuple[int, int]]:
        """(time, number) of the messages that the receiving application got up to ``to_ns``."""
        self._run(to_ns)
        got, self._got = self._got, []
        return got

    @property
    def next_ns(self) -> int | None:
        times = [
            time for time in (self._timer_ns(), self._packets[0][0] if self._packets else None) if time is not None
        ]
        if self._got:
            times.append(self._got[0][0])
        return min(times, default=None)

    @property
    def under_way(self) -> set[int]:
        numbers = [self._got, self._ends]
        return {number for pairs in numbers for _, number in pairs} | {number for number, _ in self._waiting}

    def change(self, settings: Impairments) -> None:
        """Other impairments from now on: forwards these, backwards those of `back`, or else these too."""
        forward, backward = self._pipelines[:2]
        forward.change(settings)
        backward.change(settings.backwards if isinstance(settings, SteppedImpairments) else settings)

    def as_counters(self) -> dict[str, int]:
        """What the connections did so far."""
        sender = self._sender
        return {
            "retransmissions": self._retransmissions + sender.retransmissions,
            "recoveries": self._recoveries + sender.recovery.recoveries,
            "timeouts": self._timeouts + sender.timeouts,
            "probes": self._probes + sender.probes,
            "connections_lost": self.connections_lost,
            "attempts": self.attempts + (0 if self._opening is None else self._opening.attempts),
        }

    # Time

    def _timer_ns(self) -> int | None:
        """When the first timer expires."""
        if self._opening is not None:
            return self._opening.deadline_ns
        least = self._sender.deadline_ns
        other = self._receiver.deadline_ns
        if other is not None and (least is None or other < least):
            least = other
        if self._sender.unacknowledged:
            other = self._progress_ns + self._lease_ns
            if self._waiting:
                other = min(other, self._blocked_ns + self._blocked_limit_ns)
            if least is None or other < least:
                least = other
        return least

    def _run(self, to_ns: int) -> None:
        """Let all happen that is due: packets first, then timers."""
        packets = self._packets
        while True:
            timer_ns = self._timer_ns()
            if packets and (timer_ns is None or packets[0][0] <= timer_ns):
                if packets[0][0] > to_ns:
                    return
                at_ns, _, connection, kind, content = heapq.heappop(packets)
                self._arrive(at_ns, connection, kind, content)
            elif timer_ns is not None and timer_ns <= to_ns:
                self._timeout(timer_ns)
            else:
                return

    def _timeout(self, now_ns: int) -> None:
        if self._opening is not None:
            self._opening.timeout(now_ns)
        elif self._receiver.deadline_ns == now_ns:
            self._receiver.timeout(now_ns)
        elif self._sender.deadline_ns == now_ns:
            self._sender.timeout(now_ns)
        else:
            self._close(now_ns)

    # Packets

    def _launch(self, kind: int, content: Data | Ack | int, size: int, now_ns: int) -> None:
        pipeline = self._pipelines[kind]
        for copy in pipeline.send(size, now_ns):
            flipped = copy.flip is not None
            self._sent += 1
            heapq.heappush(self._packets, (copy.at_ns, self._sent, -1 if flipped else self._connection, kind, content))

    def _arrive(self, now_ns: int, connection: int, kind: int, content: Data | Ack | int) -> None:
        books = self._pipelines[kind].books
        if connection < 0:
            books.drop("corrupt")
            return
        books.delivered += 1
        if connection != self._connection:
            return
        if isinstance(content, Data):
            if self._receiver.segment(content, now_ns):
                self._hand_over(now_ns)
        elif isinstance(content, Ack):
            before = self._sender.board.una
            self._sender.acknowledged(content, now_ns)
            if self._sender.board.una > before:
                self._progress_ns = now_ns
                if self._waiting:
                    self._unblock(now_ns)
        elif kind == _REQUEST:
            self._launch(_ANSWER, content, _SETUP_BYTES, now_ns)
        elif self._opening is not None:
            self._opening.answered(content, now_ns)
            if self._opening.opened_ns is not None:
                self.attempts += self._opening.attempts
                self._open(self._opening.round_trip_ns)

    def _transmit(self, data: Data, now_ns: int) -> None:
        self._launch(_DATA, data, data.end - data.start + HEADER_BYTES, now_ns)

    def _acknowledge(self, ack: Ack, now_ns: int) -> None:
        blocks = len(ack.blocks) + (ack.duplicate is not None)
        self._launch(_ACK, ack, HEADER_BYTES + (4 + 8 * blocks if blocks else 0), now_ns)

    def _request(self, step: int, now_ns: int) -> None:
        self._launch(_REQUEST, step, _SETUP_BYTES, now_ns)

    # Messages

    def _fits(self, size: int) -> bool:
        """A message larger than the buffer fits an empty one."""
        held = self._sender.unacknowledged
        return held + size <= self._buffer or not held

    def _write(self, number: int, size: int, now_ns: int) -> None:
        sender = self._sender
        if not sender.unacknowledged:
            self._progress_ns = now_ns
        self._ends.append((sender.written + size, number))
        sender.write(size, now_ns)

    def _hand_over(self, now_ns: int) -> None:
        """The application reads the messages that are complete and in order."""
        ends, expected = self._ends, self._receiver.expected
        while ends and ends[0][0] <= expected:
            self._got.append((now_ns, ends.popleft()[1]))
            self.books.delivered += 1

    def _unblock(self, now_ns: int) -> None:
        """Messages that waited for room enter the buffer."""
        waiting = self._waiting
        before = len(waiting)
        while waiting and self._fits(waiting[0][1]):
            number, size = waiting.popleft()
            self._write(number, size, now_ns)
        if len(waiting) < before:
            self._blocked_ns = now_ns

    # The life of the connection

    def _open(self, round_trip_ns: int | None) -> None:
        self._opening = None
        self._sender = Sender(self._options.mss, congestion_of(self._options.congestion), self._transmit)
        if round_trip_ns is not None:
            self._sender.trips.see_least(round_trip_ns)
            self._sender.trips.sample(round_trip_ns, 0, 0)
        self._receiver = Receiver(self._delayed_ack_ns, self._acknowledge, self._keep_alive_ns)
        self._ends: deque[tuple[int, int]] = deque()  # end in the stream, number; not delivered
        self._waiting: deque[tuple[int, int]] = deque()  # number, size; no room for them yet
        self._progress_ns = self._blocked_ns = 0

    def _close(self, now_ns: int) -> None:
        """The connection is given up, with all that was not delivered, and a new one is asked for."""
        sender = self._sender
        self.connections_lost += 1
        self._retransmissions += sender.retransmissions
        self._recoveries += sender.recovery.recoveries
        self._timeouts += sender.timeouts
        self._probes += sender.probes
        self.books.dropped["connection"] += len(self._ends) + len(self._waiting)
        self._connection += 1
        self._open(None)
        options = self._options
        self._opening = Opening(
            options.handshake_round_trips,
            parse_duration(options.open_limit),
            parse_duration(options.retry, zero=True),
            self._request,
            now_ns,
        )
