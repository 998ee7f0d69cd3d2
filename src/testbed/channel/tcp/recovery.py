"""What a sender makes of losses: when recovery begins and ends, the window meanwhile, and what is undone.

Fast recovery with proportional rate reduction (RFC 6937, 9937), time-outs with F-RTO (RFC 5682), needless
retransmissions found by duplicate SACKs (RFC 3708) and by time stamps (RFC 3522): as the Linux kernel combines them.
"""

from __future__ import annotations

from typing import Final

from testbed.channel.tcp.congestion import UNLIMITED, Congestion, Window
from testbed.channel.tcp.rtt import RoundTrips
from testbed.channel.tcp.scoreboard import News, Scoreboard
from testbed.channel.tcp.segment import stamp

OPEN: Final = 0
DISORDER: Final = 1  # something arrived out of order, or twice
REDUCED: Final = 2  # a loss was found by a probe that repaired it
RECOVERY: Final = 3
LOSS: Final = 4  # after a time-out

NOTHING: Final = 0
LOST: Final = 1
NEW: Final = 2
"""What to send after an acknowledgement: nothing more, what is lost, or first what was never sent."""


class Recovery:
    """State and window of a sender. `high`: what was sent when the state was entered; it ends when that is acked."""

    def __init__(self, board: Scoreboard, trips: RoundTrips, congestion: Congestion) -> None:
        self._board, self._trips, self._congestion = board, trips, congestion
        self.window = Window()
        self.state = OPEN
        self.high = 0
        self.recoveries = 0
        self.undone = 0
        self.probe_high: int | None = None  # what was sent when the probe was; None if none is on its way
        self.probe_repeats = False
        self.resent_stamp: int | None = None  # of the first retransmission in this state
        self.suspicious = False  # F-RTO: the time-out may have been spurious
        self._undo_from: int | None = None
        self._undo_left = 0  # retransmissions not yet proved needless; -1: none was made
        self._undo_threshold = 0  # 0: the window stays as it is
        self._window_before = 0
        self._delivered = self.sent = 0  # while the window is reduced

    @property
    def reducing(self) -> bool:
        return self.state in (REDUCED, RECOVERY)

    # What was (re)sent

    def count_resent(self, now_ns: int) -> None:
        if self.resent_stamp is None:
            self.resent_stamp = stamp(now_ns)
        self._undo_left = max(self._undo_left, 0) + 1

    # Acknowledgements

    def take_duplicate(self, start: int, end: int, una: int, news: News) -> None:
        """The receiver reports that start … end − 1 came twice. ``una``: acknowledged before this report."""
        news.duplicate = True
        if self.probe_high is not None and self.probe_high == end:
            news.probe_duplicate = True
        else:
            self._board.take_duplicate()
        if self._undo_from is not None and self._undo_left > 0 and self._undo_from < end <= una:
            self._undo_left -= 1

    def probe_acknowledged(self, upto: int, news: News) -> None:
        """Settle the tail loss probe (RFC 8985, 7.4): did it repair a loss, or was it needless?"""
        if self.probe_high is None or upto < self.probe_high:
            return
        if not self.probe_repeats or news.probe_duplicate:
            self.probe_high = None
        elif upto > self.probe_high:
            self._reduce()
            self.state = REDUCED
            self._undo_from = None
            self._end_reduction()
            self._keep_open()
        elif not (news.advanced or news.acked or news.sacked):
            self.probe_high = None

    def take(self, news: News, duplicate: bool, echo: int, now_ns: int) -> tuple[int, int]:
        """An acknowledgement that is more than the next one in order.

        ``duplicate``: it acknowledged nothing. Returns what to send, and how long to wait for segments that may only
        be out of order (0: do not).
        """
        board = self._board
        wait_ns = 0
        if self.state == OPEN:
            self.resent_stamp = None
        elif board.una >= self.high:
            if self.state == REDUCED and board.una != self.high:
                self._end_reduction()
                self.state = OPEN
            elif self.state == RECOVERY:
                self._recovered(echo)
                self._end_reduction()
        if self.state == RECOVERY:
            if news.advanced and self._undo_partly(echo):
                return NOTHING, 0
            if self._undo_by_duplicates():
                self._try_open()
            wait_ns = self._identify(news, now_ns)
            if self.state != RECOVERY:
                if not board.lost:
                    return NOTHING, wait_ns
                self.enter()
            return LOST, wait_ns
        if self.state == LOSS:
            then = self._timed_out(news, duplicate, echo)
            wait_ns = self._identify(news, now_ns)
            if self.state != OPEN and not news.lost_again:
                return then, wait_ns
        elif self.state <= DISORDER:
            self._undo_by_duplicates()
        wait_ns = max(wait_ns, self._identify(news, now_ns))
        if not board.lost:
            self._try_open()
            return NOTHING, wait_ns
        self.enter()
        return LOST, wait_ns

    def _identify(self, news: News, now_ns: int) -> int:
        """RACK; returns how long to wait for what may be out of order."""
        board = self._board
        if not board.queue or not board.advanced:
            return 0
        board.advanced = False
        again, wait_ns = board.detect(self.reordering_ns, now_ns)
        news.lost_again |= again
        return wait_ns

    @property
    def reordering_ns(self) -> int:
        return self._board.window_ns(self.state >= RECOVERY, self._trips.least_ns, self._trips.smoothed_ns)

    # Fast recovery

    def enter(self) -> None:
        """Fast recovery begins."""
        self.recoveries += 1
        if not self._board.any_resent:
            self.resent_stamp = None
        self._undo_threshold = 0
        self._prepare_undo()
        if not self.reducing:
            self._undo_threshold = self._threshold_now()
            self._reduce()
        self.state = RECOVERY

    def _threshold_now(self) -> int:
        window = self.window
        if self.reducing:
            return window.threshold
        return max(window.threshold, (window.size >> 1) + (window.size >> 2))

    def _reduce(self) -> None:
        window = self.window
        self.high = self._board.next
        self.probe_high = None
        window.counted = 0
        self._window_before = window.size
        self._delivered = self.sent = 0
        window.threshold = self._congestion.threshold(window.size)

    def reduce(self, delivered: int, advanced: bool, lost: int) -> None:
        """Proportional rate reduction: how much may be sent for what was delivered."""
        if delivered <= 0:
            return
        window, in_flight = self.window, self._board.in_flight
        self._delivered += delivered
        room = window.threshold - in_flight
        if room < 0:
            may = -(-window.threshold * self._delivered // self._window_before) - self.sent
        else:
            may = max(self._delivered - self.sent, delivered)
            if advanced and not lost:
                may += 1
            may = min(room, may)
        window.size = in_flight + max(may, 0 if self.sent else 1)

    def _end_reduction(self) -> None:
        window = self.window
        if window.threshold < UNLIMITED and (self.state == REDUCED or self._undo_from is not None):
            window.size = window.threshold

    def _recovered(self, echo: int) -> None:
        if self._may_undo(echo):
            self._undo(False)
        elif self._board.persist:
            self._board.persist -= 1
        self.state = OPEN

    def _try_open(self) -> None:
        if not self._board.any_resent:
            self.resent_stamp = None
        if self.state != REDUCED:
            self._keep_open()

    def _keep_open(self) -> None:
        board = self._board
        state = DISORDER if board.sacked or board.lost or board.any_resent else OPEN
        if state != self.state:
            self.state, self.high = state, board.next

    # Time-outs

    def time_out(self, now_ns: int, first: bool) -> None:
        """The retransmission time-out expired; ``first``: since the last progress."""
        board, window = self._board, self.window
        fresh = self.state < RECOVERY
        board.lose_all(now_ns)
        if self.state <= DISORDER or board.una >= self.high or (self.state == LOSS and first):
            self._undo_threshold = self._threshold_now()
            self._window_before = window.size
            window.threshold = self._congestion.threshold(window.size)
            self._prepare_undo()
        self._congestion.timed_out()
        window.size = board.in_flight + 1
        window.counted = 0
        self.state = LOSS
        self.high = board.next
        self.probe_high = None
        self.suspicious = fresh or not first

    def _timed_out(self, news: News, duplicate: bool, echo: int) -> int:
        """An acknowledgement after a time-out."""
        board = self._board
        recovered = board.una >= self.high
        if news.advanced and self._may_undo(echo):
            self._undo_time_out()
            return NOTHING
        if self.suspicious:
            if news.original:
                self._undo_time_out()
                return NOTHING
            if board.next > self.high:
                if news.sacked or duplicate:
                    self.suspicious = False
            elif news.advanced and not recovered:
                self.high = board.next
                return NEW
        if recovered:
            self._recovered(echo)
            return NOTHING
        return LOST

    def _undo_time_out(self) -> None:
        self._undo(True)
        self.state = OPEN

    # Undoing

    def _prepare_undo(self) -> None:
        self._undo_from = self._board.una
        self._undo_left = self._board.resent + (self.probe_high is not None and self.probe_repeats) or -1

    def _overtaken(self, echo: int) -> bool:
        """The receiver answers something that was sent before the first retransmission."""
        return self.resent_stamp is None or echo < self.resent_stamp

    def _may_undo(self, echo: int) -> bool:
        return self._undo_from is not None and (self._undo_left == 0 or self._overtaken(echo))

    def _undo(self, unmark: bool) -> None:
        self.undone += 1
        if unmark:
            self._board.unmark()
        if self._undo_threshold:
            window = self.window
            window.size = max(window.size, self._window_before)
            window.threshold = max(window.threshold, self._undo_threshold)
        self._undo_from = None
        self._board.advanced = True

    def _undo_partly(self, echo: int) -> bool:
        """In recovery some of the stream was acknowledged without its retransmission; True if that is all for now."""
        if self._undo_from is None or not self._overtaken(echo):
            return False
        self._board.reordered = True
        if self._board.resent:
            return True
        if not self._board.any_resent:
            self.resent_stamp = None
        self._undo(True)
        self._keep_open()
        return False

    def _undo_by_duplicates(self) -> bool:
        if self._undo_from is None or self._undo_left:
            return False
        self._board.keep_wide()
        self._undo(False)
        return True
