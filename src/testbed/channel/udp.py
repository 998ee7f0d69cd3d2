"""Messages as datagrams: best effort, cut into IP fragments, with what overtaking and bit errors make of them."""

from __future__ import annotations

from testbed.channel.message_books import MessageBooks
from testbed.channel.pipeline import Pipeline
from testbed.channel.schedule import Schedule
from testbed.scenario.carriers import IP_HEADER_BYTES, UDP_HEADER_BYTES, UdpTransport
from testbed.scenario.links import Impairments


class _Message:
    """A message on its way. missing: fragments of which no intact copy came yet. copies: arrivals still due."""

    __slots__ = ("cause", "copies", "missing", "number", "order")

    def __init__(self, number: int, order: int, fragments: int) -> None:
        self.number, self.order, self.copies = number, order, 0
        self.missing = set(range(fragments))
        self.cause: str | None = None


class UdpCarrier:
    """Each message is one datagram of ``size`` + framing + 8 bytes, in IP packets of at most ``mtu`` bytes.

    All fragments must arrive. A packet with a flipped bit fails its checksum. A message that a newer one has overtaken
    is late: dropped, or delivered out of order. The sizes given to the pipeline are those of the IP packets. A message
    of which a fragment is missing is dropped when the last of the packets that did get through has arrived.
    """

    def __init__(self, pipeline: Pipeline, options: UdpTransport) -> None:
        self.books = MessageBooks()
        self._pipeline = pipeline
        self._header = options.framing_bytes + UDP_HEADER_BYTES
        self._whole = options.mtu - IP_HEADER_BYTES
        self._drop_late = options.late == "drop"
        self._on_the_way: Schedule[tuple[_Message, int, bool]] = Schedule()
        self._newest = -1

    @property
    def next_ns(self) -> int | None:
        return self._on_the_way.next_ns

    @property
    def under_way(self) -> set[int]:
        return {message.number for message, _, _ in self._on_the_way}

    def fragments(self, size: int) -> list[int]:
        """Sizes of the IP packets of a message of ``size`` bytes; all but the last carry a multiple of 8 (RFC 791)."""
        rest = size + self._header
        if rest <= self._whole:
            return [rest + IP_HEADER_BYTES]
        each = self._whole // 8 * 8
        count = -(-(rest - self._whole) // each)
        return [each + IP_HEADER_BYTES] * count + [rest - count * each + IP_HEADER_BYTES]

    def send(self, number: int, size: int, now_ns: int) -> None:
        """A message of ``size`` bytes is handed over."""
        packets = self.fragments(size)
        message = _Message(number, self.books.sent, len(packets))
        self.books.sent += 1
        for place, packet in enumerate(packets):
            copies = self._pipeline.send(packet, now_ns)
            if not copies:
                message.cause = message.cause or self._pipeline.cause
            for copy in copies:
                message.copies += 1
                self._on_the_way.push(copy.at_ns, (message, place, copy.flip is not None))
        if not message.copies:
            self._drop(message)

    def advance(self, to_ns: int) -> list[tuple[int, int]]:
        """(time, number) of the messages that the receiving application got up to ``to_ns``."""
        got = []
        for at_ns, (message, place, damaged) in self._on_the_way.due(to_ns):
            message.copies -= 1
            if damaged:
                self._pipeline.books.drop("corrupt")
            else:
                self._pipeline.books.delivered += 1
                if self._arrived(message, place):
                    got.append((at_ns, message.number))
            if message.missing and not message.copies:
                self._drop(message)
        return got

    def change(self, settings: Impairments) -> None:
        """Other impairments from now on."""
        self._pipeline.change(settings)

    def _arrived(self, message: _Message, place: int) -> bool:
        """An intact fragment; True if the application gets the message now."""
        if not message.missing:
            self.books.repeated += 1
            return False
        message.missing.discard(place)
        if message.missing:
            return False
        if message.order < self._newest:
            self.books.late += 1
            if self._drop_late:
                self.books.drop("late")
                return False
        else:
            self._newest = message.order
        self.books.delivered += 1
        return True

    def _drop(self, message: _Message) -> None:
        self.books.drop(message.cause or "corrupt")
