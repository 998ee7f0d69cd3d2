"""Which packets are lost, with the chain moved by packets or by time."""

from __future__ import annotations

from collections.abc import Callable

from testbed.channel.chains import chain_of
from testbed.channel.gilbert_elliott import GilbertElliott, GilbertElliottProcess
from testbed.channel.loss import LossProcess
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
        self._slot = -1
        self._good = True
        self._set(settings)

    def change(self, settings: Impairments) -> None:
        """Other losses from now on: the streams go on, and so does the state, where there was one."""
        before = self._process
        self._set(settings)
        self._process.state = before.state

    def _set(self, settings: Impairments) -> None:
        losses = chain_of(settings.loss)
        self._slot_ns = None if settings.slot is None else parse_duration(settings.slot)
        self._process: LossProcess | GilbertElliottProcess
        if isinstance(losses, GilbertElliott):
            self._process = GilbertElliottProcess(losses, self._stream_of("state"), self._stream_of("loss"), 1)
        else:
            self._process = LossProcess(losses, self._stream_of("loss"), 1)

    def arrives(self, number: int, now_ns: int) -> bool:
        """The fate of packet ``number``, sent now."""
        if self._slot_ns is None:
            return bool(self._process.next(number))
        slot = now_ns // self._slot_ns
        while self._slot < slot:
            self._slot += 1
            self._good = bool(self._process.move(self._slot))
        return bool(self._process.fate(number, self._good))
