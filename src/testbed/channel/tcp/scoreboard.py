"""What was sent and not yet acknowledged: the SACK scoreboard (RFC 6675) and the loss detection of RACK (RFC 8985)."""

from __future__ import annotations

from collections import deque

from testbed.channel.tcp.segment import Ack, Segment, stamp

_REORDERING_INITIAL = 3
_REORDERING_MAX = 300
_STEPS_MAX = 255
_RECOVERIES_KEPT = 16  # for which a widened reordering window is kept (RFC 8985, 6.2)


class News:
    """What one acknowledgement told. Times are those at which segments that were never retransmitted had been sent."""

    __slots__ = (
        "acked",
        "acked_first_ns",
        "acked_last_ns",
        "acked_resent",
        "advanced",
        "delivered",
        "duplicate",
        "lost",
        "lost_again",
        "original",
        "probe_duplicate",
        "sacked",
        "sacked_first_ns",
        "sacked_last_ns",
        "set_timer",
    )

    def __init__(self) -> None:
        self.acked = self.delivered = self.lost = 0
        self.advanced = self.sacked = self.original = self.acked_resent = False
        self.duplicate = self.probe_duplicate = self.lost_again = self.set_timer = False
        self.acked_first_ns: int | None = None
        self.acked_last_ns = 0
        self.sacked_first_ns: int | None = None
        self.sacked_last_ns = 0


class Scoreboard:
    """Segments in order of the stream, and their counts.

    una, next: offsets up to which the stream is acknowledged, and was sent. Of the segments in the queue, `sacked` have
    arrived beyond a gap, `lost` are taken for lost, and of `resent` a retransmission is on its way.
    """

    def __init__(self, mss: int) -> None:
        self.mss = mss
        self.queue: deque[Segment] = deque()
        self.una = self.next = 0
        self.sacked = self.lost = self.resent = 0
        self.losses = 0  # segments ever taken for lost
        self.delivered = 0  # segments ever delivered
        self.highest = 0  # start of the highest segment that was sacked
        self.reordering = _REORDERING_INITIAL
        self.reordered = False
        self.steps = 1
        self._duplicate_seen = False
        self._widened_at = 0
        self.persist = 0
        self.advanced = False
        self._latest_ns = -1
        self._latest_end = 0
        self._rtt_ns = 0

    @property
    def in_flight(self) -> int:
        """Segments that are thought to be on their way."""
        return len(self.queue) - self.sacked - self.lost + self.resent

    def take_sacks(self, ack: Ack, high: int, least_ns: int | None, now_ns: int, news: News) -> None:
        """Mark what the blocks of ``ack`` report. ``high``: what ends at or before it was sent before the last loss."""
        blocks = ack.blocks
        reorder: int | None = None
        top = self.highest if self.sacked else -1
        una = self.una
        for segment in self.queue:
            if segment.sacked or segment.end <= una:
                continue
            start, end = segment.start, segment.end
            for low, limit in blocks:
                if low <= start and end <= limit:
                    break
            else:
                continue
            self._latest(segment, least_ns, now_ns)
            if segment.resent:
                if segment.lost:
                    segment.lost = segment.resent = False
                    self.lost -= 1
                    self.resent -= 1
            else:
                if not segment.ever:
                    if start < top and (reorder is None or start < reorder):
                        reorder = start
                    if end <= high:
                        news.original = True
                    if news.sacked_first_ns is None:
                        news.sacked_first_ns = segment.sent_ns
                    news.sacked_last_ns = segment.sent_ns
                if segment.lost:
                    segment.lost = False
                    self.lost -= 1
            segment.sacked = True
            self.sacked += 1
            news.sacked = True
            news.delivered += 1
            self.highest = max(self.highest, start) if self.sacked > 1 else start
        if reorder is not None:
            self._saw_reordering(reorder, self.highest)

    def take_duplicate(self) -> None:
        """The receiver got something twice; not a probe."""
        self._duplicate_seen = True

    def clean(self, ack: Ack, high: int, least_ns: int | None, now_ns: int, news: News) -> None:
        """Forget the segments that are acknowledged."""
        queue, una = self.queue, self.una
        top = self.highest if self.sacked else -1
        reorder: int | None = None
        while queue and queue[0].end <= una:
            segment = queue.popleft()
            if segment.ever:
                news.acked_resent = True
                if segment.resent:
                    self.resent -= 1
            elif not segment.sacked:
                news.acked_last_ns = segment.sent_ns
                if news.acked_first_ns is None:
                    news.acked_first_ns = segment.sent_ns
                if reorder is None:
                    reorder = segment.start
                if segment.end <= high:
                    news.original = True
            if segment.sacked:
                self.sacked -= 1
            else:
                news.delivered += 1
                if not segment.ever or ack.echo >= stamp(segment.sent_ns):
                    self._latest(segment, least_ns, now_ns)
            if segment.lost:
                self.lost -= 1
            news.acked += 1
        if reorder is not None and reorder < top:
            self._saw_reordering(reorder, top)

    def _latest(self, segment: Segment, least_ns: int | None, now_ns: int) -> None:
        """RACK's latest delivery (RFC 8985, step 2): of the segments delivered, the one that was sent last.

        The round trip is, as in Linux, that of the segment looked at last: those acknowledged in order come after those
        reported beyond a gap. So one whose acknowledgement was delayed makes the sender wait longer for what is lost.
        """
        sent_ns = segment.sent_ns
        rtt_ns = now_ns - sent_ns
        if segment.ever and (least_ns is None or rtt_ns < least_ns):
            return  # it may be an earlier transmission that arrived
        self._rtt_ns, self.advanced = rtt_ns, True
        if (sent_ns, segment.end) > (self._latest_ns, self._latest_end):
            self._latest_ns, self._latest_end = sent_ns, segment.end

    def _saw_reordering(self, low: int, top: int) -> None:
        if low >= top:
            return
        self.reordered = True
        if top - low > self.reordering * self.mss:
            self.reordering = min(-(-(top - low) // self.mss), _REORDERING_MAX)

    def adapt(self, delivered_before: int) -> None:
        """The reordering window: one step wider for each round trip with a duplicate (RFC 8985, 6.2)."""
        if delivered_before < self._widened_at:
            self._duplicate_seen = False
        if self._duplicate_seen:
            self.steps = min(self.steps + 1, _STEPS_MAX)
            self._duplicate_seen = False
            self._widened_at = self.delivered
            self.persist = _RECOVERIES_KEPT
        elif not self.persist:
            self.steps = 1

    def keep_wide(self) -> None:
        """A retransmission proved needless."""
        self.persist = min(self.persist + 1, _RECOVERIES_KEPT)

    def window_ns(self, recovering: bool, least_ns: int | None, smoothed_ns: int) -> int:
        """How long to wait for a segment that others may have overtaken (RFC 8985, step 4)."""
        if not self.reordered and (recovering or self.sacked >= self.reordering):
            return 0
        return min(((least_ns or 0) >> 2) * self.steps, smoothed_ns >> 3)

    def detect(self, window_ns: int, now_ns: int) -> tuple[bool, int]:
        """Take for lost what was sent a round trip and ``window_ns`` before now, and before the latest delivery.

        Returns whether a retransmission was among it, and how long to wait for those on which it is too early to
        decide; 0 if there are none.
        """
        again, wait_ns = False, 0
        latest = (self._latest_ns, self._latest_end)
        limit_ns = self._rtt_ns + window_ns - now_ns
        for segment in self.queue:
            if segment.sacked or (segment.lost and not segment.resent) or (segment.sent_ns, segment.end) >= latest:
                continue
            left_ns = limit_ns + segment.sent_ns
            if left_ns <= 0:
                again |= segment.resent
                self.lose(segment)
            else:
                wait_ns = max(wait_ns, left_ns)
        return again, wait_ns

    def lose_all(self, now_ns: int) -> None:
        """A time-out: everything is lost but what is sacked, or was sent within the last round trip."""
        for place, segment in enumerate(self.queue):
            if not segment.sacked and (place == 0 or segment.sent_ns + self._rtt_ns - now_ns <= 0):
                self.lose(segment)

    def lose(self, segment: Segment) -> None:
        if not segment.lost:
            segment.lost = True
            self.lost += 1
            self.losses += 1
        elif segment.resent:
            segment.resent = False
            self.resent -= 1
            self.losses += 1

    def unmark(self) -> None:
        """What was taken for lost was not."""
        for segment in self.queue:
            segment.lost = False
        self.lost = 0

    def join(self, segment: Segment) -> None:
        """Before a retransmission, small segments that follow become part of this one, up to a full one."""
        queue = self.queue
        place = queue.index(segment)
        while place + 1 < len(queue):
            other = queue[place + 1]
            if other.sacked or other.end - segment.start > self.mss:
                return
            segment.end = other.end
            other.start = other.end
            segment.ever |= other.ever
            self.lost -= other.lost
            self.resent -= other.resent
            del queue[place + 1]

    @property
    def any_resent(self) -> bool:
        """A retransmission is on its way, or the first segment was retransmitted."""
        return bool(self.resent) or (bool(self.queue) and self.queue[0].ever)
