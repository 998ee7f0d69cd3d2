"""Runs that are cut off at a message, as by the death of their process, and finished from their journal."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import patch

from orchestrator.runs import figures
from testbed.orchestrator.run import Run
from testbed.orchestrator.summary import Summary
from testbed.scenario import Scenario
from testbed.wire.memory_bus import MemoryNetwork

Meanwhile = Callable[[Run, int], None]
"""Called with a run and the number of messages delivered so far."""
_TRIES = 50


class Cut(BaseException):
    """The process is no more: nobody catches this."""


def _nothing(work: Run, delivered: int) -> None:
    pass


def cut_run(
    given: Scenario, out: Path, at: int, left: Path, *, settled: bool = False, meanwhile: Meanwhile = _nothing
) -> bool:
    """Run until ``at`` messages are delivered; what is on disk then is put into ``left``. False: it ended before.

    settled: what the journal's thread had to write is on disk; else it is wherever it is.
    """

    class Cutting(MemoryNetwork):
        delivered = 0

        def step(self) -> bool:
            if self.delivered == at:
                if not settled:
                    _copy(out, left)
                raise Cut
            meanwhile(work, self.delivered)
            self.delivered += 1
            return super().step()

    with patch("testbed.orchestrator.report.write_report"), patch("testbed.orchestrator.run.MemoryNetwork", Cutting):
        work = Run(given, out)
        try:
            work.in_process()
        except Cut:
            if settled:
                _copy(out, left)
            return True
    return False


def _copy(out: Path, left: Path) -> None:
    """As a thread may be renaming a file meanwhile, more than once if need be."""
    for _ in range(_TRIES):
        shutil.rmtree(left, ignore_errors=True)
        try:
            shutil.copytree(out, left)
        except (shutil.Error, FileNotFoundError):
            continue
        return
    raise AssertionError(f"{out} does not hold still")


def resume(
    left: Path, schedule: int | None = None, network: type[MemoryNetwork] = MemoryNetwork
) -> tuple[Summary, int]:
    """The summary of the run that is finished, and the step after which it went on."""
    with patch("testbed.orchestrator.report.write_report"), patch("testbed.orchestrator.run.MemoryNetwork", network):
        work, begun = Run.again(left)
        return work.in_process(schedule), begun.step


def determined(summary: Summary) -> dict[str, Any]:
    """What of a summary does not depend on whether something was lost on the way."""
    return {key: value for key, value in figures(summary).items() if key not in {"recovered", "repeated", "rejected"}}
