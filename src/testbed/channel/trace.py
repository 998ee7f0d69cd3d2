"""Traces: what became of each packet of a link. Written for a link of a scenario, read from anywhere."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from testbed.channel.law import LossModel
from testbed.channel.loss import LossCounts
from testbed.channel.service import loss_process, losses_of
from testbed.errors import UsageError
from testbed.numerics.lanes import Bools
from testbed.scenario import Scenario
from testbed.wire.keys import LinkName

HEADER = ("seq", "sent_ns", "delivered_ns")
Row = tuple[int, int, int | None]


@dataclass(frozen=True)
class Trace:
    """Packets in the order of delivery, lost ones where they were sent: (seq, sent_ns, delivered_ns or None)."""

    rows: list[Row]
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
    return Trace(rows, counts, losses_of(scenario, link))


def write_trace(path: Path, rows: Iterable[Row]) -> None:
    """Write TRACE.csv. Raises OSError."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(HEADER)
        writer.writerows(("" if field is None else field for field in row) for row in rows)


@dataclass(frozen=True, eq=False)
class Fates:
    """What became of the packets of a trace, in the order of seq: arrived (n,); rows beyond the first of a packet."""

    arrived: Bools
    duplicates: int


def read_fates(path: Path) -> Fates:
    """The fates in a TRACE.csv. Rows come in any order; a packet arrived if one of its rows has delivered_ns.

    Raises UsageError where it is no such file, or where a packet between the first and the last has no row.
    """
    arrived: dict[int, bool] = {}
    rows = read_rows(path)
    for seq, _, delivered in rows:
        arrived[seq] = arrived.get(seq, False) or delivered is not None
    return Fates(np.array([arrived[seq] for seq in sorted(arrived)], dtype=np.bool_), len(rows) - len(arrived))


def read_rows(path: Path) -> list[Row]:
    """The rows of a TRACE.csv in their order. Raises UsageError as ``read_fates`` does."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = list(_rows(path, csv.reader(file, strict=True)))
    except OSError as error:
        raise UsageError(f"cannot read {path}: {(error.strerror or str(error)).lower()}") from None
    except (UnicodeDecodeError, csv.Error):
        raise UsageError(f"{path}: not a trace; {_ALLOWED}") from None
    order = sorted({seq for seq, _, _ in rows})
    for before, after in pairwise(order):
        if after != before + 1:
            raise UsageError(
                f"{path}: no row for packet {before + 1}; allowed: a row for each from {order[0]} to {order[-1]}, "
                "with delivered_ns empty where it was lost"
            )
    return rows


_DIGITS_MAX = 20  # of 64 bits
_ALLOWED = f"allowed: CSV in UTF-8 with the header {','.join(HEADER)}"


def _rows(path: Path, rows: Any) -> Iterator[Row]:
    header = next(rows, None)
    if header is None or tuple(name.strip() for name in header) != HEADER:
        got = "an empty file" if header is None else f"the header {','.join(header)[:60]!r}"
        raise UsageError(f"{path}: not a trace: got {got}; {_ALLOWED}")
    for row in rows:
        if not row:
            continue
        where = f"{path}:{rows.line_num}"
        if len(row) != len(HEADER):
            raise UsageError(f"{where}: got {len(row)} field{'s' * (len(row) != 1)}; allowed: {len(HEADER)}")
        seq, sent, delivered = (_whole(where, name, text.strip()) for name, text in zip(HEADER, row, strict=True))
        assert seq is not None
        assert sent is not None
        yield seq, sent, delivered


def _whole(where: str, name: str, text: str) -> int | None:
    if not text and name == "delivered_ns":
        return None
    if len(text) > _DIGITS_MAX or not text.removeprefix("-").isdecimal():
        none = ", or nothing for a lost packet" if name == "delivered_ns" else ""
        raise UsageError(f"{where}: {name}: got {text[:40]!r}; allowed: a whole number{none}")
    return int(text)
