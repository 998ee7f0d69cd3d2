"""Traces: what became of each packet of a link of a scenario."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from testbed.channel.chains import chain_of
from testbed.channel.law import LossModel
from testbed.channel.loss import LossCounts
from testbed.channel.service import loss_of, loss_process
from testbed.scenario import Scenario
from testbed.scenario.trace_file import HEADER
from testbed.wire.keys import LinkName


@dataclass(frozen=True)
class Trace:
    """Packets in the order of delivery, lost ones where they were sent: (seq, sent_ns, delivered_ns or None)."""

    rows: list[tuple[int, int, int | None]]
    counts: LossCounts
    losses: LossModel

    def figures(self) -> dict[str, Any]:
        """Counts and rates beside those of the stationary model; None where there is nothing to average."""
        counts, losses = self.counts, self.losses
        lossless = losses.never_loses
        return {
            "sent": counts.sent,
            "delivered": counts.delivered,
            "dropped": counts.dropped,
            "loss_rate": counts.dropped / counts.sent,
            "mean_burst": counts.dropped / counts.bursts if counts.bursts else None,
            "expected_loss_rate": 0.0 if lossless else 1.0 - losses.arrival,
            "expected_mean_burst": None if lossless else losses.mean_burst,
        }


def sample_trace(scenario: Scenario, link: LinkName, number: int, *, seed: int, lane: int = 0) -> Trace:
    """Send ``number`` packets, one a period, over a link; the same draws as in a run with that seed."""
    process = loss_process(scenario.model_copy(update={"seed": seed}), link, lane, 1)
    counts, rows, period_ns = LossCounts(), [], scenario.clock.period_ns
    for seq in range(number):
        arrived = process.next(seq)
        counts.count(lane, arrived)
        rows.append((seq, seq * period_ns, seq * period_ns if arrived else None))
    return Trace(rows, counts, chain_of(loss_of(scenario, link)))


def write_trace(path: Path, trace: Trace) -> None:
    """Write TRACE.csv. Raises OSError."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(HEADER)
        writer.writerows(("" if field is None else field for field in row) for row in trace.rows)
