"""Which packets are lost, with the chain moved by packets or by time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from testbed.channel.processes import FateProcess, goes_on, process_of
from testbed.numerics.streams import Stream
from testbed.scenario.durations import parse_duration
from testbed.scenario.links import Impairments

StreamOf = Callable[[str], Stream]
"""The stream of a purpose."""


class Losses:
    """Decides over packet 0, 1, 2, … of one lane; a packet meets the state of the chain, then the chain moves.

    With clock "packet" it moves once a packet. With clock "time" it moves once a slot, and all packets of a slot meet
    the same state: state number ``now_ns // slot``, whatever was sent before.
    """

    def __init__(self, settings: Impairments, stream_of: StreamOf) -> None:
        self._stream_of = stream_of
        self._last_ns: int | None = None
        self._state: Any = None
        self._set(settings)

    def change(self, settings: Impairments) -> None:
        """Other losses from now on: the streams go on, and so does the state where there are as many as before.

        A chain that goes on moves at the slots that begin after the last packet, whatever the slots were before.
        """
        before = self._process
        self._set(settings)
        if goes_on(self._process, before) and before.state is not None:
            self._state = before.state
        elif self._last_ns is not None:
            self._slot -= 1  # a first state of the new kind, in this slot

    def _set(self, settings: Impairments) -> None:
        self._slot_ns = None if settings.slot is None else parse_duration(settings.slot)
        self._slot = -1 if self._last_ns is None or self._slot_ns is None else self._last_ns // self._slot_ns
        self._process: FateProcess = process_of(settings.loss, self._stream_of, 1)

    def arrives(self, number: int, now_ns: int) -> bool:
        """The fate of packet ``number``, sent now."""
        self._last_ns = now_ns
        if self._slot_ns is None:
            return bool(self._process.next(number))
        slot = now_ns // self._slot_ns
        while self._slot < slot:
            self._slot += 1
            self._state = self._process.move(self._slot)
        return bool(self._process.fate(number, self._state))
