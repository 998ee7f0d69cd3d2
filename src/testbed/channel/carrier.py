"""What carries messages over a link, in simulated time; and the simplest of all: a packet a message."""

from __future__ import annotations

from typing import Protocol

from testbed.channel.books import Books
from testbed.channel.pipeline import Pipeline
from testbed.channel.schedule import Schedule
from testbed.scenario.links import Impairments


class Carrier(Protocol):
    """Carries the messages of one lane over one link. Times never decrease from call to call."""

    @property
    def books(self) -> Books:
        """Of messages."""
        ...

    @property
    def next_ns(self) -> int | None:
        """When something happens next; None while nothing is under way."""
        ...

    @property
    def under_way(self) -> set[int]:
        """Messages that may still be handed to the receiver."""
        ...

    def send(self, number: int, size: int, now_ns: int) -> None:
        """Take message ``number`` = 0, 1, 2, … of ``size`` bytes."""
        ...

    def advance(self, to_ns: int) -> list[tuple[int, int]]:
        """(time, number) of the messages handed to the receiver up to ``to_ns``, in the order of time."""
        ...

    def change(self, settings: Impairments) -> None:
        """Other impairments from now on."""
        ...


class Datagrams:
    """Every message is one packet. The receiver takes the first copy that is intact, in whatever order.

    Causes of a drop beside those of the pipeline: "corrupt" (a checksum failed), "duplicate" (it was there already).
    """

    def __init__(self, pipeline: Pipeline) -> None:
        self._pipeline = pipeline
        self._flight: Schedule[tuple[int, bool]] = Schedule()
        self._copies: dict[int, list[int]] = {}
        """By number of what was duplicated: copies under way, copies delivered."""

    @property
    def books(self) -> Books:
        return self._pipeline.books

    @property
    def next_ns(self) -> int | None:
        return self._flight.next_ns

    @property
    def under_way(self) -> set[int]:
        return {number for number, _ in self._flight}

    def send(self, number: int, size: int, now_ns: int) -> None:
        copies = self._pipeline.send(size, now_ns)
        if len(copies) > 1:
            self._copies[number] = [len(copies), 0]
        for copy in copies:
            self._flight.push(copy.at_ns, (number, copy.flip is None))

    def advance(self, to_ns: int) -> list[tuple[int, int]]:
        out = []
        for at_ns, (number, intact) in self._flight.due(to_ns):
            if self._first(number, intact):
                self.books.delivered += 1
                out.append((at_ns, number))
        return out

    def _first(self, number: int, intact: bool) -> bool:
        copies = self._copies.get(number)
        if copies is not None:
            copies[0] -= 1
            if not copies[0]:
                del self._copies[number]
        if not intact:
            self.books.drop("corrupt")
            return False
        if copies is not None:
            copies[1] += 1
            if copies[1] > 1:
                self.books.drop("duplicate")
                return False
        return True

    def change(self, settings: Impairments) -> None:
        self._pipeline.change(settings)
