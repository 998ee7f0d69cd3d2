"""Reordering against the definitions of RFC 4737, pair by pair."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from testbed.analysis.trace_order import reordering


@given(st.permutations(range(12)), st.integers(0, 12))
def test_all_figures_are_the_definitions(order: list[int], kept: int) -> None:
    seqs = order[:kept]
    times = [7 * i * i for i in range(kept)]
    expected, extents, late, deep = 0, [], [], 0
    highest = -1
    for i, seq in enumerate(seqs):
        if seq > highest:
            highest = seq
            continue
        expected += 1
        first = next(j for j in range(i) if seqs[j] > seq)
        extents.append(i - first)
        late.append(times[i] - times[first])
        deep += i >= 3 and all(other > seq for other in seqs[i - 3 : i])
    found = reordering(np.array(seqs, dtype=np.int64), np.array(times, dtype=np.int64))
    assert (found.arrived, found.reordered, found.three_reordered) == (kept, expected, deep)
    assert found.ratio == (expected / kept if kept else 0.0)
    assert found.extent_max == max(extents, default=None)
    assert found.late_max_ns == max(late, default=None)
    assert found.extent_mean == (np.mean(extents) if extents else None)
    assert found.late_mean_ns == (np.mean(late) if late else None)


def test_the_example_of_one_late_packet() -> None:
    """The sixth packet comes after the eighth."""
    found = reordering(np.array([1, 2, 3, 4, 5, 7, 8, 6, 9, 10]), np.arange(10) * 10)
    assert (found.reordered, found.ratio, found.extent_max, found.late_max_ns) == (1, 0.1, 2, 20)
    assert found.three_reordered == 0
