"""Traces: what became of each packet of a link of a scenario."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from testbed.channel.chains import chain_of
from testbed.channel.law import LossModel
from testbed.channel.loss import LossCounts
from testbed.channel.packets import packet_bytes
from testbed.channel.pipeline import Pipeline
from testbed.channel.service import FIRST_STEP, loss_of, role_of
from testbed.scenario import Scenario
from testbed.scenario.changes import changed
from testbed.scenario.links import SteppedImpairments
from testbed.scenario.trace_file import Row, write_rows
from testbed.wire.keys import LinkName


@dataclass(frozen=True)
class Trace:
    """Packets in the order of delivery, lost ones where they were sent: (seq, sent_ns, delivered_ns or None)."""

    rows: list[Row]
    counts: LossCounts
    losses: LossModel | None
    """The model that the figures are compared with; None where more than its losses decides, or where it changes."""

    def figures(self) -> dict[str, Any]:
        """Counts and rates beside those of the stationary model; None where there is nothing to average."""
        counts, losses = self.counts, self.losses
        return {
            "sent": counts.sent,
            "delivered": counts.delivered,
            "dropped": counts.dropped,
            "loss_rate": counts.dropped / counts.sent,
            "mean_burst": counts.dropped / counts.bursts if counts.bursts else None,
            "expected_loss_rate": None if losses is None else 0.0 if losses.never_loses else 1.0 - losses.arrival,
            "expected_mean_burst": None if losses is None or losses.never_loses else losses.mean_burst,
        }


def sample_trace(scenario: Scenario, link: LinkName, number: int, *, seed: int, lane: int = 0) -> Trace:
    """Send ``number`` packets, one a period, over a link; the same draws and events as in a run with that seed.

    A packet that arrives twice has two rows. One that arrives with a bit flipped counts as lost, and has no delivery.
    """
    settings: SteppedImpairments = getattr(scenario.links, link)
    pipeline = Pipeline(settings, seed, role_of(link), lane)
    changes, first_step = scenario.changes_of(link), FIRST_STEP[link]
    counts, period_ns, size = LossCounts(), scenario.clock.period_ns, packet_bytes(scenario, link)
    rows: list[tuple[int, int, int, int | None]] = []
    for seq in range(number):
        while changes and changes[0][0] <= seq + first_step:
            settings = changed(settings, changes.pop(0)[1])
            pipeline.change(settings)
        sent_ns = seq * period_ns
        arrivals = [copy.at_ns for copy in pipeline.send(size, sent_ns) if copy.flip is None]
        counts.count(bool(arrivals))
        rows += [(at_ns, seq, sent_ns, at_ns) for at_ns in arrivals] or [(sent_ns, seq, sent_ns, None)]
    rows.sort(key=lambda row: row[:2])
    model = chain_of(loss_of(scenario, link))
    plain = not scenario.changes_of(link) and settings.rate is None and settings.slot is None
    return Trace([row[1:] for row in rows], counts, model if plain and settings.corrupt is None else None)


def write_trace(path: Path, trace: Trace) -> None:
    """Write TRACE.csv. Raises OSError."""
    write_rows(path, trace.rows)
