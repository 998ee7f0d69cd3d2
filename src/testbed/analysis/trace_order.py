"""How far packets arrive out of order: A. Morton et al.: Packet reordering metrics. RFC 4737."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_RETRANSMITS = 3


@dataclass(frozen=True)
class Reordering:
    """Counts over the packets that arrived, copies left out. Sections are those of RFC 4737.

    reordered: packets that come after one sent later (3.3). extent: of a reordered packet, how many came between the
    first one sent later and itself, itself included (4.2). late_ns: the time between the two (4.3).
    three_reordered: packets that follow at least three in a row sent later, so that TCP would take them for lost (5).
    """

    arrived: int
    reordered: int
    ratio: float
    extent_mean: float | None
    extent_max: int | None
    late_mean_ns: float | None
    late_max_ns: int | None
    three_reordered: int


def reordering(seqs: NDArray[np.int64], arrivals_ns: NDArray[np.int64]) -> Reordering:
    """Of packets in their order of arrival, (n,) numbers and times."""
    number = len(seqs)
    if number == 0:
        return Reordering(0, 0, 0.0, None, None, None, None, 0)
    highest = np.maximum.accumulate(seqs)
    at = np.flatnonzero(seqs < highest)
    if not len(at):
        return Reordering(number, 0, 0.0, None, None, None, None, 0)
    first_later = np.searchsorted(highest, seqs[at], side="right")
    extents, late = at - first_later, arrivals_ns[at] - arrivals_ns[first_later]
    deep = sum(_in_a_row(seqs, int(i)) >= _RETRANSMITS for i in at)
    return Reordering(
        number,
        len(at),
        len(at) / number,
        float(extents.mean()),
        int(extents.max()),
        float(late.mean()),
        int(late.max()),
        deep,
    )


def _in_a_row(seqs: NDArray[np.int64], at: int) -> int:
    """How many packets right before this one were sent later; no more are counted than matter."""
    count = 0
    while count < _RETRANSMITS and at - count > 0 and seqs[at - count - 1] > seqs[at]:
        count += 1
    return count
