"""What became of each packet of one direction, written to a TRACE.csv while it happens."""

from __future__ import annotations

from pathlib import Path

from testbed.errors import RunFailed, UsageError
from testbed.scenario.trace_file import HEADER


class TraceWriter:
    """Rows in the order of delivery, lost packets where they were found lost.

    Raises UsageError where the file cannot be made, RunFailed where it cannot be written to.
    """

    def __init__(self, path: Path) -> None:
        try:
            self._file = path.open("w", newline="", encoding="ascii", buffering=1 << 16)
        except OSError as error:
            raise UsageError(_reason(path, error)) from None
        self._path = path
        self._write(f"{','.join(HEADER)}\n")

    def delivered(self, seq: int, sent_ns: int, delivered_ns: int) -> None:
        self._write(f"{seq},{sent_ns},{delivered_ns}\n")

    def lost(self, seq: int, sent_ns: int) -> None:
        self._write(f"{seq},{sent_ns},\n")

    def close(self) -> None:
        try:
            self._file.close()
        except OSError as error:
            raise RunFailed(_reason(self._path, error)) from None

    def _write(self, row: str) -> None:
        try:
            self._file.write(row)
        except OSError as error:
            raise RunFailed(_reason(self._path, error)) from None


def _reason(path: Path, error: OSError) -> str:
    return f"cannot write {path}: {(error.strerror or str(error)).lower()}"
