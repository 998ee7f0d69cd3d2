"""The books of a link against a plain count of each lane with itertools.groupby."""

from __future__ import annotations

from collections import Counter
from itertools import groupby, pairwise

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from testbed.channel.loss import LossCounts

check = settings(deadline=None, max_examples=150)


@st.composite
def histories(draw: st.DrawFn) -> tuple[np.ndarray, list[int]]:
    """Fates of shape (packets, lanes), and the sizes of the blocks that the lanes come in."""
    blocks = draw(st.lists(st.integers(1, 4), min_size=1, max_size=4))
    packets = draw(st.integers(0, 12))
    bits = draw(st.lists(st.booleans(), min_size=packets * sum(blocks), max_size=packets * sum(blocks)))
    return np.array(bits, dtype=np.bool_).reshape(packets, sum(blocks)), blocks


def counted(fates: np.ndarray, blocks: list[int], order: list[int]) -> Counter[str]:
    """Each block of lanes has its counts; their sum."""
    counts = [LossCounts() for _ in blocks]
    begins = np.cumsum([0, *blocks])[:-1]
    for row in fates:
        for block in order:
            lane, lanes = int(begins[block]), blocks[block]
            counts[block].count(bool(row[lane]) if lanes == 1 else row[lane : lane + lanes])
    total: Counter[str] = Counter()
    for one in counts:
        total.update(one.as_counters())
    return total


@check
@given(histories(), st.randoms(use_true_random=False))
def test_counts_are_those_of_each_lane_alone(history: tuple[np.ndarray, list[int]], random: object) -> None:
    fates, blocks = history
    order = list(range(len(blocks)))
    random.shuffle(order)  # type: ignore[attr-defined]
    counts = counted(fates, blocks, order)
    lanes = [column.tolist() for column in fates.T]
    pairs = Counter(pair for lane in lanes for pair in pairwise(lane))
    bursts = sum(1 for lane in lanes for arrived, _ in groupby(lane) if not arrived)
    assert counts == {
        "sent": fates.size,
        "delivered": int(fates.sum()),
        "dropped": int((~fates).sum()),
        "bursts": bursts,
        **{f"{a:d}{b:d}": pairs[a, b] for a in (False, True) for b in (False, True)},
    }


@check
@given(histories())
def test_the_books_balance(history: tuple[np.ndarray, list[int]]) -> None:
    fates, blocks = history
    counts = counted(fates, blocks, list(range(len(blocks))))
    assert counts["sent"] == counts["delivered"] + counts["dropped"]
    moves = sum(counts[pair] for pair in ("00", "01", "10", "11"))
    assert moves == max(0, fates.shape[0] - 1) * fates.shape[1]
    assert all(isinstance(value, int) for value in counts.values())
