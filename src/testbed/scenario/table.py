"""Reading text files and CSV tables of numbers."""

import math
from pathlib import Path

from testbed.errors import UsageError
from testbed.scenario.base import count, shown


def read_text(path: Path) -> str:
    """The text of a file (UTF-8). Raises UsageError, without the path, if it is missing, not a file, or unreadable."""
    try:
        if path.exists() and not path.is_file():
            raise UsageError("not a file")
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise UsageError("no such file") from None
    except UnicodeDecodeError as error:
        raise UsageError(f"not UTF-8 text (byte {error.start})") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise UsageError(f"cannot be read: {reason}") from None


def read_table(path: Path) -> list[list[float]]:
    """The rows of a CSV file of finite numbers, all of one length.

    A first row with no number in it is a header and left out, as are empty lines and lines that begin with "#".
    Raises UsageError, without the path, if the file cannot be read or a cell is not a finite number.
    """
    text = read_text(path)
    lines = [
        (number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip() and line.strip()[0] != "#"
    ]
    rows: list[list[float]] = []
    for index, (number, line) in enumerate(lines):
        cells = [cell.strip().strip('"') for cell in line.split(",")]
        values = [_number(cell) for cell in cells]
        if index == 0 and all(value is None for value in values):
            continue
        row: list[float] = []
        for cell, value in zip(cells, values, strict=True):
            if value is None or not math.isfinite(value):
                raise UsageError(f"line {number}: got {shown(cell)}; allowed: a finite number")
            row.append(value)
        rows.append(row)
        if len(rows[-1]) != len(rows[0]):
            raise UsageError(
                f"line {number}: got {count(len(rows[-1]), 'number')}; allowed: {len(rows[0])}, as in the first row"
            )
    if not rows:
        raise UsageError("no rows; allowed: a row of numbers for each step")
    return rows


def _number(cell: str) -> float | None:
    try:
        return float(cell)
    except ValueError:
        return None
