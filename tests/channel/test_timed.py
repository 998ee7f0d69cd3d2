"""What a link that takes time hands over, and what it no longer has when it arrives."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from channel.impaired import MS, NAME, link
from testbed.channel.carriers import carriers_of
from testbed.channel.steps import SteppedLink
from testbed.channel.timed import TimedBlock

PERIOD, LANES = 10 * MS, 3


def block(name: str, batch: int = 1, keep: int = 64, **keys: Any) -> TimedBlock:
    stepped = SteppedLink(carriers_of(link(**keys), 3, NAME, 0, LANES), 100, PERIOD, PERIOD)
    return TimedBlock(stepped, LANES, name, first_step=1, keep=keep, batch=batch)


def content(number: int) -> Any:
    return np.arange(LANES, dtype=float)[:, None] + 10.0 * number + 1.0


def test_late_content_is_what_was_sent_and_blank_elsewhere() -> None:
    made = block(
        "y", delay={"kind": "uniform", "low": "1 ms", "high": "45 ms"}, loss={"kind": "bernoulli", "loss": 0.2}
    )
    sent, came, lanes_late = {}, set(), 0
    for number in range(60):
        sent[number] = content(number)
        arrays = made.pass_on(number, sent[number])
        mask = arrays["mask"].astype(bool)
        if "y" in arrays:
            np.testing.assert_array_equal(arrays["y"], sent[number] * mask[:, None])
        came |= {(number, lane) for lane in np.flatnonzero(mask)}
        if "late_mask" not in arrays:
            continue
        count = arrays["late_mask"].shape[1]
        assert arrays["late_y"].shape == (LANES, count, 1)
        assert arrays["late_step"].shape == (LANES, count)
        for place in range(count):
            (step,) = set(arrays["late_step"][:, place].tolist())
            lanes = arrays["late_mask"][:, place].astype(bool)
            assert lanes.any()
            assert 1 <= step <= number
            np.testing.assert_array_equal(arrays["late_y"][:, place], sent[int(step) - 1] * lanes[:, None])
            fresh = {(int(step) - 1, lane) for lane in np.flatnonzero(lanes)}
            assert not fresh & came
            came |= fresh
            lanes_late += len(fresh)
    assert made.late == lanes_late > 50
    assert made.books.delivered == len(came)


@pytest.mark.parametrize(("periods", "used"), [(65, True), (66, False)])
def test_what_comes_too_late_is_dropped_and_counted(periods: int, used: bool) -> None:
    """Kept are 64 packets: a delay of n periods makes packets n − 1 late."""
    made = block("y", delay={"kind": "constant", "by": f"{10 * periods} ms"})
    found = [made.pass_on(number, content(number)) for number in range(100)]
    arrived = (100 - (periods - 1)) * LANES
    assert any("late_y" in arrays for arrays in found) == used
    books = made.books
    assert made.late == books.delivered
    assert (books.delivered, books.dropped["stale"]) == ((arrived, 0) if used else (0, arrived))
    assert books.sent == books.delivered + books.dropped.total() + books.in_flight == 100 * LANES


def test_a_batch_tells_what_the_packets_before_did() -> None:
    """Of ten ACKs only the last of every three arrives, in time: it brings the outcomes of the last two."""
    made = block("nu", batch=2, loss={"kind": "scripted", "pattern": "001"})
    outcomes = np.random.default_rng(1).integers(0, 2, (10, LANES)).astype(np.uint8)
    for number in range(10):
        arrays = made.pass_on(number, outcomes[number])
        assert arrays["mask"].tolist() == [int(number % 3 == 2)] * LANES
        if number % 3 != 2:
            assert set(arrays) == {"mask"}
            continue
        np.testing.assert_array_equal(arrays["nu"], outcomes[number])
        np.testing.assert_array_equal(arrays["late_nu"], outcomes[number - 1][:, None])
        assert arrays["late_step"].tolist() == [[number]] * LANES
        assert arrays["late_mask"].tolist() == [[1]] * LANES
