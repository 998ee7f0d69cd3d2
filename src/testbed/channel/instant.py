"""A link that takes no time, for a block of lanes: the fate of each packet, and their counts."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.channel.loss import LossCounts
from testbed.channel.processes import FateProcess, goes_on, index_of_state, set_state
from testbed.numerics.lanes import Mask, mask_of
from testbed.wire.state import Unpacked


class InstantBlock:
    """Lets packet 0, 1, 2, … through or not, as its loss process says."""

    def __init__(self, process: FateProcess, lanes: int) -> None:
        self._process, self._lanes = process, lanes
        self.counts = LossCounts()
        self.cut = 0
        """Lane-packets that would have come through, and the link was cut."""

    @property
    def packets(self) -> int:
        """How many there were."""
        return self.counts.sent // self._lanes

    def change(self, process: FateProcess) -> None:
        """Another process from now on, in the state of the one before if it has as many."""
        goes_on(process, self._process)
        self._process = process

    def arrives(self, number: int, *, up: bool = True) -> Mask:
        """Where packet ``number`` arrives; up: whether the link is, without which nothing does."""
        arrived = self._process.next(number)
        if not up:
            self.cut += int(np.count_nonzero(arrived))
            arrived = False if isinstance(arrived, bool) else np.zeros_like(arrived)
        self.counts.count(arrived)
        return arrived

    def state(self) -> tuple[dict[str, NDArray[Any]], dict[str, int]]:
        """Where the process is, the last fate, and the counts: the next fate follows from that and its number."""
        counts = self.counts
        arrays: dict[str, NDArray[Any]] = {}
        index = index_of_state(self._process)
        if index is not None:
            arrays["process"] = index
        if counts.last is not None:
            arrays["last"] = np.atleast_1d(np.asarray(counts.last, dtype=np.uint8))
        arrays["transitions"] = np.array(counts.transitions, dtype=np.int64)
        return arrays, {"sent": counts.sent, "delivered": counts.delivered, "bursts": counts.bursts, "cut": self.cut}

    def resume(self, given: Unpacked) -> None:
        """Go on from the state of a block with the same process. Raises UsageError where it is none."""
        if "process" in given:
            set_state(self._process, given.array("process", np.int64, self._lanes))
        last = mask_of(given.array("last", np.uint8, self._lanes)) if "last" in given else None
        transitions = given.array("transitions", np.int64, 2, 2).tolist()
        sent, delivered, bursts = (given.number(name) for name in ("sent", "delivered", "bursts"))
        self.cut = given.number("cut")
        self.counts = LossCounts(sent, delivered, bursts, transitions, last)
