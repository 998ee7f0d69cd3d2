"""What a script has ordered of a run."""

from __future__ import annotations

from typing import TYPE_CHECKING

from testbed.errors import RunFailed
from testbed.orchestrator.summary import Happened

if TYPE_CHECKING:
    from testbed.orchestrator.live.run import LiveRun


class Ordered:
    """An event that was ordered and taken; ``number`` is its number among those of the run.

    at: its step, where it is known.
    """

    def __init__(self, run: LiveRun, number: int, action: str, at: int | None) -> None:
        self._run, self.number, self.action, self.at = run, number, action, at

    def result(self) -> Happened:
        """What became of it, with the step from which on it holds; waits for that.

        Where the clock is held before that step, it goes on as far as it must: to the step before; where it waits for a
        condition, step by step until that holds. Raises RunFailed where the event was refused or did not happen.
        """
        while True:
            seen, over = self._run.changes, self._run.over
            found = self._run.outcome(self.number)
            if found is not None:
                break
            if over:
                raise RunFailed(f"{self.action}: the run was over before")
            self._run.go_on_for(self, seen)
        if not found.ok:
            raise RunFailed(found.text)
        return found
