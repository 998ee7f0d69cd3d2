"""Writing a journal: notes and figures at once, checkpoints and what waits for the disk in a thread."""

from __future__ import annotations

import fcntl
import json
import os
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from testbed.errors import RunFailed, UsageError
from testbed.orchestrator.journal.files import (
    BEGIN,
    FIGURES,
    NOTES,
    VERSION,
    Checkpoint,
    Figures,
    checkpoint_name,
    note_line,
    notes,
    record_of,
    records,
    written,
)
from testbed.orchestrator.journal.reading import checkpoints

KEPT = 2
"""Checkpoints that are kept: should the newest be damaged, there is the one before."""


class Journal:
    """The journal of a run in a folder. Call ``begin`` or ``go_on`` first.

    Every method raises RunFailed, in one line, once the disk has refused something; nothing is written after that.
    Notes and figures are with the operating system when a call returns: they outlive the process. What a checkpoint
    holds, and all notes and figures before it, outlives a power cut from when ``stable`` is its step.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.stable = 0
        """The step of the newest checkpoint that is on disk; 0: none."""
        self.skipped = 0
        """Checkpoints that were not written because a newer one came while the disk was busy."""
        self.figures_to = 0
        """The last step whose figures are in."""
        self._ends: set[int] = set()
        self._notes = self._figures = -1
        self._failure: str | None = None
        self._changed = threading.Condition()
        self._due: tuple[Checkpoint, tuple[Callable[[], None], ...]] | None = None
        self._closing = False
        self._thread: threading.Thread | None = None

    def begin(self, facts: Mapping[str, Any]) -> None:
        """Start anew, without what an earlier run left. facts: what the run is; what JSON can say.

        Raises UsageError where another process writes this journal.
        """
        self._guarded(self._start, facts)

    def go_on(self, step: int) -> None:
        """Go on after ``step``, that of the checkpoint that ``read`` found, or 0; what came later is removed.

        Notes stay. Raises UsageError where another process writes this journal.
        """
        self._guarded(self._continue, step)

    def note(self, **what: Any) -> None:
        """Note something that happened; what JSON can say."""
        self._guarded(_write, self._notes, note_line(what))

    def figures(self, to: int, content: bytes) -> None:
        """Keep the figures of the steps that came after the last ones, up to ``to``."""
        self._guarded(_write, self._figures, record_of(Figures(self.figures_to, to, content)))
        self.figures_to = to
        self._ends.add(to)

    def checkpoint(
        self,
        step: int,
        states: Mapping[tuple[str, int], bytes],
        collector: bytes,
        facts: Mapping[str, Any],
        *before: Callable[[], None],
    ) -> None:
        """Have a checkpoint written in the background. It is on disk when ``stable`` says so.

        Its figures must be in, some of them given up to its step and no further.

        One is written at a time; of those that come meanwhile the newest waits and the others are skipped, so that
        the run never waits for the disk. before: what else must be on disk first, called in the background; an
        OSError there is one of the journal.
        """
        self.check()
        if step not in self._ends:
            raise ValueError(f"checkpoint of step {step}, and no figures end there")
        self._ends = {end for end in self._ends if end >= step}
        due = Checkpoint(step, dict(states), collector, json.loads(json.dumps(facts)))
        with self._changed:
            self.skipped += self._due is not None
            self._due = due, before
            self._changed.notify()

    def check(self) -> None:
        """Raises RunFailed where something could not be written."""
        if self._failure is not None:
            raise RunFailed(self._failure)

    def close(self) -> None:
        """Wait until everything that was given is on disk. May be called again."""
        if self._thread is not None:
            with self._changed:
                self._closing = True
                self._changed.notify()
            self._thread.join()
            self._thread = None
            if self._failure is None:
                self._guarded(self._sync)
        for file in (self._notes, self._figures):
            if file >= 0:
                os.close(file)
        self._notes = self._figures = -1
        self.check()

    def _start(self, facts: Mapping[str, Any]) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)
        self._open()
        self._remove(self._folder / BEGIN, *checkpoints(self._folder).values())
        os.ftruncate(self._notes, 0)
        os.ftruncate(self._figures, 0)
        self._replace(BEGIN, json.dumps({"v": VERSION, **facts}).encode())
        _sync(self._folder.parent)
        self._run()

    def _continue(self, step: int) -> None:
        self._open()
        _, end = notes((self._folder / NOTES).read_bytes())
        os.ftruncate(self._notes, end)
        found, ends = records((self._folder / FIGURES).read_bytes())
        kept = [(0, 0), *((part.to, end) for part, end in zip(found, ends, strict=True) if part.to <= step)]
        if kept[-1][0] != step:
            raise UsageError(f"{self._folder}: there are no figures up to step {step}")
        os.ftruncate(self._figures, kept[-1][1])
        self._remove(*(path for later, path in checkpoints(self._folder).items() if later > step))
        self.figures_to = self.stable = step
        self._run()

    def _remove(self, *paths: Path) -> None:
        for path in (*paths, *self._folder.glob("*.partial")):
            path.unlink(missing_ok=True)
        _sync(self._folder)

    def _open(self) -> None:
        flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC
        self._notes = os.open(self._folder / NOTES, flags, 0o644)
        try:
            fcntl.flock(self._notes, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(self._notes)
            self._notes = -1
            raise UsageError(f"{self._folder}: another process writes this journal; is the run still going?") from None
        self._figures = os.open(self._folder / FIGURES, flags, 0o644)

    def _run(self) -> None:
        self._thread = threading.Thread(target=self._write_all, name="journal", daemon=True)
        self._thread.start()

    def _write_all(self) -> None:
        """The thread: one checkpoint after the other."""
        while True:
            with self._changed:
                while self._due is None and not self._closing:
                    self._changed.wait()
                if self._due is None or self._failure is not None:
                    return
                (checkpoint, before), self._due = self._due, None
            try:
                for call in before:
                    call()
                self._sync()
                self._replace(checkpoint_name(checkpoint.step), written(checkpoint))
                for step in sorted(checkpoints(self._folder))[:-KEPT]:
                    (self._folder / checkpoint_name(step)).unlink()
            except Exception as error:  # told by the next call
                self._fail(error)
                return
            self.stable = checkpoint.step

    def _sync(self) -> None:
        os.fsync(self._notes)
        os.fsync(self._figures)

    def _replace(self, name: str, content: bytes) -> None:
        """Write a file that is there whole or not at all, on disk when this returns."""
        partial = self._folder / f"{name}.partial"
        file = os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o644)
        try:
            _write(file, content)
            os.fsync(file)
        finally:
            os.close(file)
        os.replace(partial, self._folder / name)
        _sync(self._folder)

    def _guarded(self, do: Callable[..., None], *given: Any) -> None:
        self.check()
        try:
            do(*given)
        except OSError as error:
            self._fail(error)
            self.check()

    def _fail(self, error: Exception) -> None:
        if self._failure is None:
            text = error.strerror.lower() if isinstance(error, OSError) and error.strerror else str(error)
            self._failure = f"cannot write the journal {self._folder}: {' '.join(text.split())}"


def _write(file: int, content: bytes) -> None:
    view = memoryview(content)
    while view:
        view = view[os.write(file, view) :]


def _sync(folder: Path) -> None:
    file = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(file)
    finally:
        os.close(file)
