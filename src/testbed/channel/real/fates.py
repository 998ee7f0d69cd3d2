"""The fates of a block's packets as they become known: in what order they are told, what is in time, what is late."""

from __future__ import annotations

from collections import Counter

import numpy as np

from testbed.channel.books import Books
from testbed.channel.steps import Arrivals
from testbed.scenario.links import Impairments


class Fates:
    """Of packets that carry ``lanes`` lanes each, numbered 0, 1, … as they are sent; the lanes share one fate.

    A packet is in time if it arrives before it is given up. Fates are told in the order of the numbers: ``ready`` says
    whether that of the next packet is known, ``send`` takes it, with those that have come late meanwhile.
    repeated: arrivals of packets that were there already.
    """

    def __init__(self, lanes: int) -> None:
        self.repeated = 0
        self._delivered = 0
        self._lanes = lanes
        self._sent = 0
        self._told = 0
        self._known: dict[int, bool] = {}
        self._lost: set[int] = set()
        """Given up, and not arrived since."""
        self._late: list[int] = []

    @property
    def books(self) -> Books:
        """Of lane-packets: those handed over are delivered; whether another is lost or in flight is not known here."""
        return Books(sent=self._lanes * self._sent, delivered=self._delivered)

    @property
    def transport(self) -> Counter[str]:
        """The kernel does not tell."""
        return Counter()

    @property
    def next(self) -> int:
        """The packet whose fate is to be told next."""
        return self._told

    @property
    def ready(self) -> bool:
        return self._told in self._known

    @property
    def waiting_late(self) -> int:
        """Lanes of packets that came late and were not handed over."""
        return self._lanes * len(self._late)

    def sent(self) -> int:
        """A packet goes out; its number."""
        self._sent += 1
        return self._sent - 1

    def arrived(self, number: int) -> None:
        if number in self._lost:
            self._lost.discard(number)
            self._late.append(number)
        elif number < self._told or number in self._known:
            self.repeated += 1
        else:
            self._known[number] = True

    def give_up(self, number: int) -> None:
        """What has not arrived by now is not in time."""
        if number >= self._told and number not in self._known:
            self._known[number] = False
            self._lost.add(number)

    def send(self, number: int) -> Arrivals:
        """The fate of packet ``number``, which is the next, and what came late since that of the one before."""
        assert number == self._told
        self._told += 1
        in_time = np.full(self._lanes, self._known.pop(number))
        late = [(one, np.ones(self._lanes, dtype=np.bool_)) for one in sorted(self._late) if one < number]
        self._late = [one for one in self._late if one >= number]
        self._delivered += self._lanes * (len(late) + bool(in_time[0]))
        return Arrivals(in_time, late)

    def change(self, settings: Impairments) -> None:
        """The path changes, not what is known of its packets."""
