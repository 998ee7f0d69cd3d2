"""The sending end of a connection: transmissions, retransmissions, and the one timer for them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from testbed.channel.tcp.congestion import WINDOW_INITIAL, Congestion
from testbed.channel.tcp.recovery import LOST, NEW, NOTHING, OPEN, RECOVERY, REDUCED, Recovery
from testbed.channel.tcp.rtt import LEAST_NS, RoundTrips
from testbed.channel.tcp.scoreboard import News, Scoreboard
from testbed.channel.tcp.segment import Ack, Data, Segment, stamp

_IDLE: Final = 0
_PROBE: Final = 1  # tail loss probe
_REORDER: Final = 2  # segments that may only be out of order
_TIMEOUT: Final = 3

_TIMER_LEAST_NS = 2_000_000


class Sender:
    """transmit: called with each `Data` and the time. No Nagle: what may be sent is sent at once.

    Bytes that have to wait for the window leave in segments of up to ``mss`` bytes.
    """

    def __init__(self, mss: int, congestion: Congestion, transmit: Callable[[Data, int], None]) -> None:
        self._mss, self._congestion, self._transmit = mss, congestion, transmit
        self.board = Scoreboard(mss)
        self.trips = RoundTrips()
        self.recovery = Recovery(self.board, self.trips, congestion)
        self.deadline_ns: int | None = None
        self.written = 0
        self.timeouts = self.probes = self.retransmissions = 0
        self._pending = _IDLE
        self._expired = 0  # time-outs since the last progress
        self._sent_ns = 0
        self._limited = False  # the window limits the sender, not the application
        self._most_out = self._usage_end = 0

    @property
    def unacknowledged(self) -> int:
        """Bytes written and not acknowledged."""
        return self.written - self.board.una

    def write(self, size: int, now_ns: int) -> None:
        """The application hands over ``size`` bytes more."""
        self.written += size
        if not self.board.queue:
            self._after_idle(now_ns)
        self._push(now_ns)

    def acknowledged(self, ack: Ack, now_ns: int) -> None:
        """An acknowledgement arrives."""
        board, recovery, trips = self.board, self.recovery, self.trips
        news = News()
        before, upto = board.una, ack.upto
        delivered_before, losses_before = board.delivered, board.losses
        had = len(board.queue)
        if upto > before:
            news.advanced = True
            board.una = upto
            self._expired = 0
        if ack.duplicate is not None:
            recovery.take_duplicate(*ack.duplicate, before, news)
        if ack.blocks:
            board.take_sacks(ack, recovery.high, trips.least_ns, now_ns, news)
        if upto < before:  # overtaken by a later one
            then = self._take(news, False, ack.echo, now_ns) if news.sacked or news.duplicate else NOTHING
            self._finish(then, now_ns)
            return
        if had:
            board.clean(ack, recovery.high, trips.least_ns, now_ns, news)
            self._measure(news, ack.echo, now_ns)
        board.delivered += news.delivered
        board.adapt(delivered_before)
        if recovery.probe_high is not None:
            recovery.probe_acknowledged(upto, news)
        then = NOTHING
        if not news.acked or news.sacked or news.duplicate or recovery.state != OPEN:
            duplicate = bool(had) and not (news.advanced or news.acked or news.sacked or news.duplicate)
            then = self._take(news, duplicate, ack.echo, now_ns)
        if news.set_timer:
            self._set_timer(now_ns)
        if recovery.reducing:
            recovery.reduce(news.delivered, news.advanced, board.losses - losses_before)
        elif news.acked:
            window = recovery.window
            if self._limited or (window.slow_start and window.size < 2 * self._most_out):
                self._congestion.grow(window, news.delivered, now_ns)
        self._finish(then, now_ns)

    def timeout(self, now_ns: int) -> None:
        """The timer at `deadline_ns` expires."""
        if self._pending == _PROBE:
            self._probe(now_ns)
        elif self._pending == _REORDER:
            self._reordering_over(now_ns)
        else:
            self._time_out(now_ns)

    # After an acknowledgement

    def _take(self, news: News, duplicate: bool, echo: int, now_ns: int) -> int:
        then, wait_ns = self.recovery.take(news, duplicate, echo, now_ns)
        if wait_ns:
            self._start(_REORDER, wait_ns + _TIMER_LEAST_NS, now_ns)
            news.set_timer = False
        return then

    def _measure(self, news: News, echo: int, now_ns: int) -> None:
        """Round trips, from the acknowledgement of what was sent once, a report of it, or the echoed time stamp."""
        board, trips = self.board, self.trips
        round_ns = least_ns = None
        if news.acked_first_ns is not None and not news.acked_resent:
            round_ns, least_ns = now_ns - news.acked_first_ns, now_ns - news.acked_last_ns
        sacked_ns = None
        if news.sacked_first_ns is not None:
            sacked_ns = now_ns - news.sacked_first_ns
            if round_ns is None:
                round_ns = sacked_ns
            if least_ns is None:
                least_ns = now_ns - news.sacked_last_ns
        if round_ns is None and news.acked:
            round_ns = least_ns = max(stamp(now_ns) - echo, 1) * 1_000_000
        if round_ns is not None and least_ns is not None:
            trips.see_least(least_ns)
            trips.sample(round_ns, board.una, board.next)
        head_sent_later = sacked_ns is not None and bool(board.queue) and sacked_ns > now_ns - board.queue[0].sent_ns
        news.set_timer = bool(news.acked) or head_sent_later

    def _finish(self, then: int, now_ns: int) -> None:
        """Retransmit what recovery asks for, and send what the window allows."""
        recovery = self.recovery
        if then == NEW:
            self._push(now_ns)
            if self.board.next <= recovery.high:
                recovery.suspicious = False
                then = LOST
        if then == LOST:
            self._resend_lost(now_ns)
        if self.board.next < self.written:
            self._push(now_ns)

    # Sending

    def _after_idle(self, now_ns: int) -> None:
        """Slow start again after an idle time (RFC 5681, 4.1): the window halves with each time-out that passed."""
        window = self.recovery.window
        idle_ns = now_ns - self._sent_ns - self.trips.timeout_ns
        if idle_ns > 0 and window.size > WINDOW_INITIAL:
            window.threshold = max(window.threshold, (window.size >> 1) + (window.size >> 2))
            while idle_ns > 0 and window.size > WINDOW_INITIAL:
                window.size = max(window.size >> 1, WINDOW_INITIAL)
                idle_ns -= self.trips.timeout_ns

    def _push(self, now_ns: int) -> None:
        """Send what was never sent, as far as the window allows."""
        board = self.board
        size = self.recovery.window.size
        count = 0
        while board.next < self.written and board.in_flight < size:
            self._send_new(now_ns)
            count += 1
        if count:
            if self.recovery.reducing:
                self.recovery.sent += count
            self._schedule_probe(False, now_ns)
        limited = board.in_flight >= size
        if not (count or limited):
            return
        out = len(board.queue)
        if board.una >= self._usage_end or limited or (not self._limited and out > self._most_out):
            self._limited, self._most_out, self._usage_end = limited, out, board.next

    def _send_new(self, now_ns: int) -> None:
        board = self.board
        start = board.next
        end = min(start + self._mss, self.written)
        first = not board.queue
        board.queue.append(Segment(start, end, now_ns))
        board.next = end
        self._sent_ns = now_ns
        if first or self._pending == _PROBE:
            self._rearm(now_ns)
        self._transmit(Data(start, end, stamp(now_ns)), now_ns)

    def _resend_lost(self, now_ns: int) -> None:
        """Retransmit what is lost, in order, as far as the window allows."""
        board, recovery = self.board, self.recovery
        if board.resent >= board.lost:
            return
        rearm = False
        for segment in list(board.queue):
            if board.resent >= board.lost or board.in_flight >= recovery.window.size:
                break
            if not segment.lost or segment.resent or segment.sacked or segment.end <= segment.start:
                continue
            self._resend(segment, now_ns)
            if recovery.reducing:
                recovery.sent += 1
            if segment is board.queue[0] and self._pending != _REORDER:
                rearm = True
        if rearm:
            self._start(_TIMEOUT, self.trips.timeout_ns, now_ns)

    def _resend(self, segment: Segment, now_ns: int) -> None:
        if not segment.resent:
            segment.resent = True
            self.board.resent += 1
        self.recovery.count_resent(now_ns)
        self._repeat(segment, now_ns)

    def _repeat(self, segment: Segment, now_ns: int) -> None:
        segment.start = max(segment.start, self.board.una)
        self.board.join(segment)
        segment.ever = True
        segment.sent_ns = self._sent_ns = now_ns
        self.retransmissions += 1
        self._transmit(Data(segment.start, segment.end, stamp(now_ns)), now_ns)

    # The timer

    def _start(self, kind: int, after_ns: int, now_ns: int) -> None:
        self._pending, self.deadline_ns = kind, now_ns + after_ns

    def _set_timer(self, now_ns: int) -> None:
        if not self._schedule_probe(True, now_ns):
            self._rearm(now_ns)

    def _left_ns(self, now_ns: int) -> int:
        """Until the time-out of the first segment."""
        return self.board.queue[0].sent_ns + self.trips.timeout_ns - now_ns

    def _rearm(self, now_ns: int) -> None:
        if not self.board.queue:
            self._pending, self.deadline_ns = _IDLE, None
            return
        after_ns = self.trips.timeout_ns
        if self._pending in (_PROBE, _REORDER):
            after_ns = max(self._left_ns(now_ns), 1)
        self._start(_TIMEOUT, after_ns, now_ns)

    def _schedule_probe(self, progress: bool, now_ns: int) -> bool:
        """A probe after two round trips without an acknowledgement (RFC 8985, 7.2); 200 ms more for one segment."""
        out = len(self.board.queue)
        if not out or self.recovery.state not in (OPEN, REDUCED):
            return False
        smoothed_ns = self.trips.smoothed_ns
        after_ns = 1_000_000_000
        if smoothed_ns:
            after_ns = 2 * smoothed_ns + (LEAST_NS if out == 1 else _TIMER_LEAST_NS)
        left_ns = self.trips.timeout_ns if progress else self._left_ns(now_ns)
        if left_ns > 0:
            after_ns = min(after_ns, left_ns)
        self._start(_PROBE, after_ns, now_ns)
        return True

    def _probe(self, now_ns: int) -> None:
        """Tail loss probe: something new, or the last segment again (RFC 8985, 7.3)."""
        board, recovery = self.board, self.recovery
        if recovery.probe_high is None:
            recovery.probe_repeats = board.next >= self.written
            if recovery.probe_repeats:
                self._repeat(board.queue[-1], now_ns)
            else:
                self._send_new(now_ns)
                if recovery.reducing:
                    recovery.sent += 1
            self.probes += 1
            recovery.probe_high = board.next
            self._pending = _IDLE
        self._rearm(now_ns)

    def _reordering_over(self, now_ns: int) -> None:
        """What was waited for is lost."""
        board, recovery = self.board, self.recovery
        in_flight, losses = board.in_flight, board.losses
        board.detect(recovery.reordering_ns, now_ns)
        if in_flight != board.in_flight:
            if recovery.state != RECOVERY:
                recovery.enter()
                recovery.reduce(1, False, board.losses - losses)
            self._resend_lost(now_ns)
        if self._pending != _TIMEOUT:
            self._rearm(now_ns)

    def _time_out(self, now_ns: int) -> None:
        board = self.board
        if not board.queue:
            self._pending, self.deadline_ns = _IDLE, None
            return
        self.timeouts += 1
        self.recovery.time_out(now_ns, not self._expired)
        self._expired += 1
        self._resend(board.queue[0], now_ns)
        self.trips.back_off()
        self._start(_TIMEOUT, self.trips.timeout_ns, now_ns)
