"""Fates that were written down: those of a trace, and those of a list."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from testbed.errors import UsageError
from testbed.numerics.lanes import Bools, Mask
from testbed.numerics.streams import Stream
from testbed.scenario import ScriptedLoss, TraceLoss


class Recorded:
    """The fates of a trace, around and around if it repeats; packet ``begins`` (M,) of it is the first of each lane."""

    def __init__(self, fates: str, begins: NDArray[np.int64], repeat: bool) -> None:
        self._fates, self._begins, self._repeat = _bits(fates), begins, repeat

    @classmethod
    def of(cls, loss: TraceLoss, offsets: Stream, lanes: int) -> Recorded:
        """Where each lane begins is drawn from ``offsets``, unless the scenario says it."""
        if loss.offset is not None or not loss.repeat:
            begins = np.full(lanes, loss.offset or 0, dtype=np.int64)
        else:
            (points,) = offsets.uniforms(0)
            begins = np.atleast_1d((np.asarray(points) * len(loss.fates)).astype(np.int64))
        return cls(loss.fates, begins, loss.repeat)

    def fates(self, number: int) -> Bools:
        """(M,) of packet ``number``. Raises UsageError beyond the end of a trace that does not repeat."""
        at, end = self._begins + number, len(self._fates)
        if not self._repeat and at[0] >= end:
            raise UsageError(
                f"the trace ends before packet {number}: it has {end - at[0] + number} from its offset on; "
                "allowed: fewer packets, a longer trace, or repeat = true"
            )
        return self._fates[at % end]


class Scripted:
    """The same fates in every lane: ``lost`` ranges, or a pattern over and over again."""

    def __init__(self, loss: ScriptedLoss, lanes: int) -> None:
        self._lanes = lanes
        self._pattern = None if loss.pattern is None else _bits(loss.pattern)
        self._firsts, self._lasts = np.array(loss.ranges, dtype=np.int64).reshape(-1, 2).T

    def fates(self, number: int) -> Bools:
        """(M,) of packet ``number``."""
        return np.full(self._lanes, self._arrives(number))

    def _arrives(self, number: int) -> bool:
        if self._pattern is not None:
            return bool(self._pattern[number % len(self._pattern)])
        before = int(np.searchsorted(self._firsts, number, side="right"))
        return before == 0 or number > int(self._lasts[before - 1])


class ReplayProcess:
    """Gives the fate of packet 0, 1, 2, … for a block of lanes. Nothing is kept: a fate depends on its number alone."""

    states = 0
    state: Mask | None = None

    def __init__(self, source: Recorded | Scripted, lanes: int) -> None:
        self._source, self._lanes = source, lanes

    def next(self, number: int) -> Mask:
        """Arrival mask of packet ``number``: a ``bool`` for one lane, else a boolean array of shape (M,)."""
        fates = self._source.fates(number)
        return bool(fates[0]) if self._lanes == 1 else fates

    def move(self, number: int) -> Mask:
        """Where fates are counted by time: that of slot ``number``."""
        return self.next(number)

    def fate(self, number: int, state: Mask) -> Mask:
        """The fate of every packet of a slot is that of the slot."""
        return state


def _bits(word: str) -> Bools:
    return np.asarray(np.frombuffer(word.encode("ascii"), dtype=np.uint8) == ord("1"))
