"""What became of each packet of one direction, written to a TRACE.csv while it happens."""

from __future__ import annotations

from pathlib import Path

from testbed.channel.trace import HEADER
from testbed.errors import UsageError


class TraceWriter:
    """Rows in the order of delivery, lost packets where they were found lost. Raises UsageError for a wrong path."""

    def __init__(self, path: Path) -> None:
        try:
            self._file = path.open("w", newline="", encoding="ascii", buffering=1 << 16)
        except OSError as error:
            raise UsageError(f"cannot write {path}: {(error.strerror or str(error)).lower()}") from None
        self._file.write(f"{','.join(HEADER)}\n")

    def delivered(self, seq: int, sent_ns: int, delivered_ns: int) -> None:
        self._file.write(f"{seq},{sent_ns},{delivered_ns}\n")

    def lost(self, seq: int, sent_ns: int) -> None:
        self._file.write(f"{seq},{sent_ns},\n")

    def close(self) -> None:
        self._file.close()
