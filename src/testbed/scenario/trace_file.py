"""TRACE.csv, read and written: what became of each packet of a link."""

import csv
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from testbed.errors import UsageError
from testbed.numerics.lanes import Bools

HEADER = ("seq", "sent_ns", "delivered_ns")
Row = tuple[int, int, int | None]


@dataclass(frozen=True, eq=False)
class Fates:
    """What became of the packets of a trace, in the order of seq: arrived (n,); rows beyond the first of a packet."""

    arrived: Bools
    duplicates: int

    @property
    def word(self) -> str:
        """A letter for each packet: 1 arrived, 0 lost."""
        return (self.arrived.astype(np.uint8) + ord("0")).tobytes().decode("ascii")


def read_fates(path: Path, source: str = "") -> Fates:
    """The fates in a TRACE.csv. Rows come in any order; a packet arrived if one of its rows has delivered_ns.

    Raises UsageError where it is no such file, or where a packet between the first and the last has no row; ``source``
    is what it calls the file, if not by its path.
    """
    rows = read_rows(path, source)
    arrived: dict[int, bool] = {}
    for seq, _, delivered in rows:
        arrived[seq] = arrived.get(seq, False) or delivered is not None
    return Fates(np.array([arrived[seq] for seq in sorted(arrived)], dtype=np.bool_), len(rows) - len(arrived))


def read_rows(path: Path, source: str = "") -> list[Row]:
    """The rows of a TRACE.csv, in their order. Raises UsageError as ``read_fates`` does."""
    name = source or str(path)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = list(_rows(name, csv.reader(file, strict=True)))
    except (OSError, ValueError) as error:
        if isinstance(error, UnicodeDecodeError):
            raise UsageError(f"{name}: not a trace; {_ALLOWED}") from None
        raise UsageError(f"cannot read {name}: {(getattr(error, 'strerror', None) or str(error)).lower()}") from None
    except csv.Error:
        raise UsageError(f"{name}: not a trace; {_ALLOWED}") from None
    order = sorted({seq for seq, _, _ in rows})
    for before, after in pairwise(order):
        if after != before + 1:
            raise UsageError(
                f"{name}: no row for packet {before + 1}; allowed: a row for each from {order[0]} to {order[-1]}, "
                "with delivered_ns empty where it was lost"
            )
    return rows


def write_rows(path: Path, rows: Iterable[Row]) -> None:
    """Write TRACE.csv. Raises OSError."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(HEADER)
        writer.writerows(("" if field is None else field for field in row) for row in rows)


_DIGITS_MAX = 20  # of 64 bits
_ALLOWED = f"allowed: CSV in UTF-8 with the header {','.join(HEADER)}"


def _rows(name: str, rows: Any) -> Iterator[Row]:
    header = next(rows, None)
    if header is None or tuple(name.strip() for name in header) != HEADER:
        got = "an empty file" if header is None else f"the header {','.join(header)[:60]!r}"
        raise UsageError(f"{name}: not a trace: got {got}; {_ALLOWED}")
    for row in rows:
        if not row:
            continue
        where = f"{name}:{rows.line_num}"
        if len(row) != len(HEADER):
            raise UsageError(f"{where}: got {len(row)} field{'s' * (len(row) != 1)}; allowed: {len(HEADER)}")
        seq, sent, delivered = (_whole(where, key, text.strip()) for key, text in zip(HEADER, row, strict=True))
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
