"""What of a run goes into its journal, and when."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from testbed.orchestrator.conductor import Conductor
from testbed.orchestrator.journal import Journal
from testbed.orchestrator.recorder import Recorder
from testbed.orchestrator.recovery import Checkpoint
from testbed.orchestrator.resuming import facts_of
from testbed.orchestrator.services import Origin
from testbed.orchestrator.summary import Happened
from testbed.scenario.write import event_table

_FLUSH_S = 1.0


class Keeper:
    """Writes figures as they come, checkpoints when all their states are there, and what was commanded.

    events: number of those that the scenario has. Where the disk refuses, the run fails.
    """

    def __init__(self, journal: Journal, conductor: Conductor, recorder: Recorder | None, events: int) -> None:
        self._journal, self._conductor, self._recorder, self._events = journal, conductor, recorder, events
        self._every = conductor.setup.snapshot_every
        self._collected: dict[int, tuple[bytes, dict[str, Any]]] = {}
        self._offered = journal.stable
        self._flushed_s = time.monotonic()
        conductor.collector.on_completed = self._completed
        conductor.recovery.keep, conductor.recovery.stable = self._keep, lambda: journal.stable
        conductor.recovery.all_give = True
        conductor.timeline.accepted = self._accepted
        conductor.timeline.decided = conductor.services.decided = self._decided
        conductor.timeline.refused = conductor.services.refused = self._refused

    def tick(self) -> None:
        """From time to time. Raises RunFailed where the disk has refused something."""
        self._journal.check()
        now = time.monotonic()
        if now - self._flushed_s > _FLUSH_S:
            self._flushed_s = now
            self._flush(self._conductor.collector.completed)
            if self._recorder is not None:
                self._recorder.flush()

    def _completed(self, step: int) -> None:
        if self._every and not step % self._every and self._can_be(step):
            self._flush(step)
            self._collected[step] = self._conductor.collector.state(), facts_of(self._conductor, step)

    def _flush(self, step: int) -> None:
        if step > self._journal.figures_to:
            self._journal.figures(step, self._conductor.collector.figures(self._journal.figures_to, step))

    def _can_be(self, step: int) -> bool:
        """Whether there can be a checkpoint of the whole run: not where a role gives no state."""
        recovery = self._conductor.recovery
        return not recovery.serving(step) & recovery.silent.keys()

    def _keep(self, checkpoint: Checkpoint) -> bool:
        step = checkpoint.step
        if not self._can_be(step):
            return False
        if step <= self._offered or step not in self._collected or not self._is_all_there(step):
            return True
        self._offered = step
        states = {(role, lane): data for role, by_lane in checkpoint.states.items() for lane, data in by_lane.items()}
        collector, facts = self._collected[step]
        facts["reports"] = {role: word.model_dump_json() for role, word in self._conductor.last_words.items()}
        self._collected = {later: kept for later, kept in self._collected.items() if later > step}
        sync: tuple[Callable[[], None], ...] = ()
        if self._recorder is not None:
            self._recorder.flush()
            sync = (self._recorder.fsync,)
        self._journal.checkpoint(step, states, collector, facts, *sync)
        return True

    def _is_all_there(self, step: int) -> bool:
        """Whether the recording holds every packet up to a step, and who has left has reported."""
        if self._conductor.awaited_words:
            return False
        recorder, blocks = self._recorder, self._conductor.setup.blocks
        return recorder is None or all(
            recorder.holds(step, topic, lane) for topic in self._conductor.recorded for lane, _ in blocks
        )

    def _accepted(self, event: Any, number: int, timed: bool) -> None:
        self._journal.note(ordered=event_table(event), number=number, timed=timed)

    def _decided(self, event: Any, origin: Origin, step: int) -> None:
        if origin.number >= self._events:
            table = {**event_table(event), "at": step}
            table.pop("when", None)
            self._journal.note(command=table, number=origin.number, by=origin.by, when=origin.when, true=origin.true_at)

    def _refused(self, entry: Happened) -> None:
        if entry.number is not None and entry.number >= self._events:
            self._journal.note(refused=entry.model_dump(mode="json", exclude_none=True))
