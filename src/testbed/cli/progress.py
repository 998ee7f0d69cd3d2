"""The live display of a run."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn


@dataclass
class Display:
    """Where a run tells how far it is."""

    progress: Progress
    task: TaskID
    _first: tuple[int, float] | None = None

    def update(self, completed: int, steps: int) -> None:
        now = time.monotonic()
        if self._first is None:
            self._first = completed, now
        done, elapsed_s = completed - self._first[0], now - self._first[1]
        rate = f"{done / elapsed_s:,.0f} steps/s" if done and elapsed_s > 0.0 else ""
        self.progress.update(self.task, completed=completed, total=steps, rate=rate)

    def say(self, line: str) -> None:
        self.progress.console.print(line, markup=False, highlight=False, soft_wrap=True)


@contextmanager
def progress_display(console: Console, name: str, steps: int, *, shown: bool) -> Iterator[Display]:
    """A bar with the steps completed and their rate, on a terminal; nothing elsewhere."""
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console, disable=not shown or not console.is_terminal) as progress:
        yield Display(progress, progress.add_task(name, total=steps, rate="starting"))
