"""One direction of a link for one lane, in simulated time: loss, rate and queue, delay, order, copies, bit errors.

It is feed-forward: all that will become of a packet is settled when it is sent. Each decision has a random stream of
its own, indexed by the packet's number, so that switching one impairment on changes no draw of another.
"""

from __future__ import annotations

from dataclasses import dataclass

from testbed.channel.books import Books
from testbed.channel.delay import law_of
from testbed.channel.rate import Bottleneck
from testbed.channel.slots import Losses
from testbed.numerics.streams import Stream
from testbed.scenario.durations import parse_duration
from testbed.scenario.impairments import ConstantDelay
from testbed.scenario.links import Impairments


@dataclass(frozen=True, slots=True)
class Copy:
    """An arrival of a packet. flip: None, or a number whose remainder by 8 · size is the bit that arrives flipped."""

    at_ns: int
    flip: int | None = None


class Pipeline:
    """The stages in order: loss → rate and queue → delay → reordering → duplication → corruption.

    cause: why the last packet was dropped, "loss", "cut" or "queue"; None if it was not.
    """

    def __init__(self, settings: Impairments, seed: int, component: str, lane: int = 0) -> None:
        self._seed, self._component, self._lane = seed, component, lane
        self._streams: dict[str, Stream] = {}
        self.books = Books()
        self.cause: str | None = None
        self._losses = Losses(settings, self._stream)
        self._bottleneck: Bottleneck | None = None
        self._latest_ns = 0
        self._set(settings)

    @property
    def sent(self) -> int:
        """Packets so far: the number of the next one."""
        return self.books.sent

    def change(self, settings: Impairments) -> None:
        """Other parameters from now on. Streams and chains go on; what is in flight arrives as it would have."""
        self._losses.change(settings)
        self._set(settings)

    def _set(self, settings: Impairments) -> None:
        self.settings = settings
        self._lossless, self._up = settings.loss.kind == "none", settings.up
        if settings.rate is None:
            self._bottleneck = None
        elif self._bottleneck is None:
            self._bottleneck = Bottleneck(settings.rate)
        else:
            self._bottleneck.change(settings.rate)
        delay = settings.delay
        self._delay = None if delay is None else law_of(delay)
        self._constant_ns = self._delay(0.0) if self._delay is not None and isinstance(delay, ConstantDelay) else None
        self._in_order = delay is not None and not isinstance(delay, ConstantDelay) and delay.in_order
        self._delays = self._stream("delay")
        self._hold_chance, self._hold_ns = 0.0, 0
        if settings.reorder is not None:
            self._hold_chance, self._hold_ns = settings.reorder.chance, parse_duration(settings.reorder.by)
        self._holds = self._stream("reorder")
        self._copy_chance, self._copy_ns = 0.0, 0
        if settings.duplicate is not None:
            self._copy_chance = settings.duplicate.chance
            self._copy_ns = parse_duration(settings.duplicate.after, zero=True)
        self._copies = self._stream("duplicate")
        self._flip_chance = 0.0 if settings.corrupt is None else settings.corrupt.chance
        self._corruptions, self._flips = self._stream("corrupt"), self._stream("flip")

    def _stream(self, purpose: str) -> Stream:
        stream = self._streams.get(purpose)
        if stream is None:
            width = 2 if purpose in ("corrupt", "flip") else 1  # a packet and its copy
            stream = Stream(self._seed, self._component, purpose, width=width, lane=self._lane, lanes=1)
            self._streams[purpose] = stream
        return stream

    def send(self, size: int, now_ns: int) -> tuple[Copy, ...]:
        """The arrivals of a packet of ``size`` bytes sent now; none if it is dropped. ``now_ns`` never decreases."""
        books = self.books
        number = books.sent
        books.sent += 1
        self.cause = None
        if not self._lossless and not self._losses.arrives(number, now_ns):
            self.cause = "loss"
            books.drop("loss")
            return ()
        at_ns = now_ns
        if not self._up:
            self.cause = "cut"
            books.drop("cut")
            return ()
        if self._bottleneck is not None:
            left_ns = self._bottleneck.leave(size, now_ns)
            if left_ns is None:
                self.cause = "queue"
                books.drop("queue")
                return ()
            at_ns = left_ns
        if self._constant_ns is not None:
            at_ns += self._constant_ns
        elif self._delay is not None:
            at_ns += self._delay(self._delays.first(number))
            if self._in_order:
                at_ns = self._latest_ns = max(at_ns, self._latest_ns)
        if self._hold_chance and self._holds.first(number) < self._hold_chance:
            at_ns += self._hold_ns
        if self._copy_chance and self._copies.first(number) < self._copy_chance:
            books.duplicated += 1
            return Copy(at_ns, self._flip(number, 0)), Copy(at_ns + self._copy_ns, self._flip(number, 1))
        return (Copy(at_ns, self._flip(number, 0) if self._flip_chance else None),)

    def _flip(self, number: int, copy: int) -> int | None:
        if not self._flip_chance:
            return None
        uniform = self._corruptions.first(number) if not copy else self._corruptions.uniforms(number)[copy]
        if uniform >= self._flip_chance:
            return None
        self.books.corrupted += 1
        return int(self._flips.words(number)[copy, 0])
