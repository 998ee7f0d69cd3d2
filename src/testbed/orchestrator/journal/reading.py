"""Reading a journal back: from where a run can go on."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from testbed.errors import UsageError
from testbed.orchestrator.journal.files import (
    BEGIN,
    FIGURES,
    NOTES,
    VERSION,
    Checkpoint,
    Figures,
    checkpoint_of,
    notes,
    records,
    step_of,
)


@dataclass(frozen=True)
class Found:
    """What a journal holds.

    begin: as it was given. notes: those that are whole. figures: of the steps 1, 2, … in a row. checkpoint: the newest
    that is whole and has the figures of all its steps; None: the run begins anew. lost: what is damaged, a line each.
    """

    begin: dict[str, Any]
    notes: tuple[dict[str, Any], ...]
    figures: tuple[Figures, ...]
    checkpoint: Checkpoint | None
    lost: tuple[str, ...]

    @property
    def step(self) -> int:
        """The step after which the run goes on."""
        return 0 if self.checkpoint is None else self.checkpoint.step


def read(folder: Path) -> Found:
    """Read a journal that may have ended at any moment. Raises UsageError where there is none that can be read."""
    lost: list[str] = []
    begin = _begin(folder / BEGIN)
    content = _content(folder / NOTES)
    happened, end = notes(content)
    if end < len(content):
        lost.append(f"{folder / NOTES}: the last {len(content) - end} bytes are not whole notes")
    content = _content(folder / FIGURES)
    figures, ends = records(content)
    if (ends or [0])[-1] < len(content):
        lost.append(f"{folder / FIGURES}: the last {len(content) - (ends or [0])[-1]} bytes are not whole figures")
    checkpoint = None
    for step in sorted(checkpoints(folder), reverse=True):
        path = checkpoints(folder)[step]
        try:
            checkpoint = _checkpoint(path, step, _last(figures))
            break
        except UsageError as error:
            lost.append(f"{path}: {error}")
    return Found(begin, tuple(happened), tuple(figures), checkpoint, tuple(lost))


def checkpoints(folder: Path) -> dict[int, Path]:
    """The files of checkpoints, by step."""
    found = {step_of(path.name): path for path in folder.iterdir()}
    return {step: path for step, path in found.items() if step is not None}


def _checkpoint(path: Path, step: int, last: int) -> Checkpoint:
    checkpoint = checkpoint_of(_content(path))
    if checkpoint.step != step:
        raise UsageError(f"holds step {checkpoint.step}")
    if last < step:
        raise UsageError(f"there are figures of {last} steps only")
    return checkpoint


def _last(figures: list[Figures]) -> int:
    """The last step up to which there are figures."""
    last = 0
    for part in figures:
        if part.after > last:
            break
        last = part.to
    return last


def _begin(path: Path) -> dict[str, Any]:
    if not path.exists():
        raise UsageError(f"{path}: no such file: there is no journal of a run")
    try:
        begin = json.loads(_content(path))
        if begin.pop("v") != VERSION:
            raise UsageError(f"{path}: of another version of the testbed; allowed: {VERSION}")
        return dict(begin)
    except (ValueError, KeyError, AttributeError, TypeError):
        raise UsageError(f"{path}: damaged: the run must begin anew") from None


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError:
        return b""
    except OSError as error:
        raise UsageError(f"cannot read {path}: {(error.strerror or str(error)).lower()}") from None
