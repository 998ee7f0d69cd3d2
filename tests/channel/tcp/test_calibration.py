"""The model against what was measured of the kernel's TCP: see docs/explanation/transports.md for how.

measured.csv: one-way delay (ms), loss, messages, segments lost, time-outs, quantiles of the delay (ms), and the share
of messages that came within 1 ms of the one before. Messages of 64 bytes at 100 Hz, losses independent and both ways.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from testbed.channel.pipeline import Pipeline
from testbed.channel.tcp import TcpCarrier
from testbed.numerics.lanes import Floats
from testbed.scenario.carriers import TcpTransport
from testbed.scenario.links import Impairments

PERIOD = 10_000_000
LANES, MESSAGES = 2, 30_000
SHARE_ERROR = 0.01
"""Of a share of messages, from run to run: time-outs are few, and each delays some twenty messages."""
Row = dict[str, str]


def _rows() -> list[Row]:
    with (Path(__file__).parent / "measured.csv").open() as file:
        return list(csv.DictReader(file))


ROWS = _rows()
PATH_MS = {row["delay_ms"]: float(row["q50"]) for row in ROWS if float(row["loss"]) == 0}
"""What the path takes in truth: the median without losses."""


def _model(delay_ms: float, loss: float) -> tuple[Floats, float, float]:
    """Delays (ms), the share that comes together, and time-outs for each segment lost."""
    link = Impairments.model_validate(
        {"loss": {"kind": "bernoulli", "loss": loss}, "delay": {"kind": "constant", "by": f"{delay_ms:.2f} ms"}}
    )
    delays, together, timeouts, lost = [], 0, 0, 0
    for lane in range(LANES):
        forward, backward = (Pipeline(link, 1, name, lane) for name in ("forward", "backward"))
        carrier = TcpCarrier(forward, backward, TcpTransport())
        got = []
        for number in range(MESSAGES):
            carrier.send(number, 64, number * PERIOD)
            got += carrier.advance(number * PERIOD)
        got += carrier.advance(10**15)
        times, numbers = np.array(got, dtype=np.float64).T
        delays.append((times - numbers * PERIOD) / 1e6)
        together += np.count_nonzero(np.diff(times) < 1e6)
        timeouts += carrier.as_counters()["timeouts"]
        lost += forward.books.dropped["loss"]
    return np.concatenate(delays), together / (LANES * MESSAGES), timeouts / lost


@pytest.mark.parametrize(
    "row",
    [row for row in ROWS if 0 < float(row["loss"]) <= 0.05],
    ids=lambda row: f"{row['delay_ms']} ms, {row['loss']}",
)
def test_delays_are_within_30_percent_up_to_5_percent_loss(row: Row) -> None:
    delays, together, timeouts = _model(PATH_MS[row["delay_ms"]], float(row["loss"]))
    for share, key in ((0.5, "q50"), (0.9, "q90")):
        low, high = np.quantile(delays, [share - SHARE_ERROR, share + SHARE_ERROR])
        assert 0.7 * low <= float(row[key]) <= 1.3 * high
    assert together == pytest.approx(float(row["together"]), abs=0.05)
    assert timeouts == pytest.approx(int(row["timeouts"]) / int(row["lost"]), abs=0.03)
