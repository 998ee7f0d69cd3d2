"""A run in a thread of its own, and its handle for a script."""

from __future__ import annotations

import atexit
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import Any, NoReturn, TypeVar

from pydantic_core import PydanticCustomError

from testbed.errors import RunFailed, UsageError
from testbed.orchestrator.asked import status_of
from testbed.orchestrator.conductor import Conductor
from testbed.orchestrator.desk import RunOver
from testbed.orchestrator.live.actions import Actions, Moment
from testbed.orchestrator.live.figures import Figures, figures_at
from testbed.orchestrator.live.ordered import Ordered
from testbed.orchestrator.preflight import default_folder
from testbed.orchestrator.run import Run
from testbed.orchestrator.summary import Happened, Summary
from testbed.scenario import Scenario
from testbed.scenario.base import plain, shown
from testbed.scenario.durations import parse_duration

T = TypeVar("T")


def start(scenario: Scenario, out: str | PathLike[str] | None = None, *, in_process: bool = False) -> LiveRun:
    """Start a run, wait until its roles are there, and hold its clock at step 0. See ``Scenario.start``."""
    return LiveRun(scenario, default_folder(scenario) if out is None else Path(out), in_process=in_process)


class LiveRun(Actions):
    """A run that goes in the background. Its methods are for the thread that started it.

    In virtual time the clock is held until the script says how far it may go: ``until``, ``steps``, ``release``,
    ``wait``. What is ordered while it is held at step k takes effect at step k + 1, always. In real time the clock is
    held at the beginning only; what is ordered later takes effect as soon as can be.

    As a context manager: an exception stops the run, and what was collected is kept; else the end is waited for.
    """

    def __init__(self, scenario: Scenario, out: Path, *, in_process: bool) -> None:
        self.scenario, self.out = scenario, out
        self._work, self._in_process = Run(scenario, out), in_process
        self._work.desk.opened = self._opened
        self._changed = threading.Condition()
        self._changes = 0
        self._over = self._stopped = self._told = False
        self._conductor: Conductor | None = None
        self._summary: Summary | None = None
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._play, name="testbed run", daemon=True)
        atexit.register(self._end, "the script ended")
        self._thread.start()
        try:
            self._await(lambda: self._conductor is not None and self._conductor.started)
        except BaseException as error:
            self._end(_words_of(error))
            raise
        if self._over:
            self._raise()

    def __enter__(self) -> LiveRun:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if error is not None:
            self._end(_words_of(error))
        else:
            self.wait(check=not self._told)

    @property
    def over(self) -> bool:
        """Whether the run has ended, and its results are written."""
        return self._over

    @property
    def changes(self) -> int:
        """Grows whenever something about the run is new."""
        return self._changes

    @property
    def completed(self) -> int:
        """The last step that is complete."""
        return self._of_conductor.collector.completed

    @property
    def figures(self) -> Figures:
        """Of the last step that is complete."""
        return figures_at(self._of_conductor.collector, self.completed)

    @property
    def summary(self) -> Summary | None:
        """None while the run goes."""
        return self._summary

    def status(self) -> dict[str, Any]:
        """How far it is, who estimates, what has happened; and ``status``: held, running, or how it has ended."""
        conductor = self._of_conductor
        found = status_of(conductor) if self._over else self._ask(status_of)
        if self._summary is not None:
            return {**found, "status": self._summary.status}
        return {**found, "status": "running" if conductor.held_at is None else "held"}

    def at(self, moment: int | str) -> Moment:
        """Orders that take effect at a step, or at a time such as "1.5 s". They must not have been reached."""
        return Moment(self._order, {"at": self._step_of(moment, "at")})

    def when(self, condition: str) -> Moment:
        """Orders that take effect after a condition has begun to hold, such as "trace_P(aoe) > 500 for 10 steps"."""
        return Moment(self._order, {"when": condition})

    def do(self, action: str, **keys: Any) -> Ordered:
        """At the step after that at which the clock is held; where it is not, as soon as can be."""
        return self._order({"action": action, **keys})

    def until(self, moment: int | str) -> Figures:
        """Wait until a step, or the one of a time such as "1.5 s", is complete; its figures.

        In virtual time the clock is held there. Raises UsageError for a step that is past, RunFailed where the run ends
        before.
        """
        step = self._step_of(moment, "until")
        if not self._over:
            self._let_go(step)
            self._await(lambda: self.completed >= step)
        if self.completed < step:
            self._raise()
        return figures_at(self._of_conductor.collector, step)

    def steps(self, *, held: bool = True) -> Iterator[tuple[int, Figures]]:
        """(k, figures) of each step from the next one on, as it is complete.

        held: in virtual time the clock waits for the body of the loop, so that its orders take effect at step k + 1;
        else the run goes on meanwhile. Raises RunFailed where the run ends before its last step.
        """
        for k in range(self.completed + 1, self.scenario.steps + 1):
            if not held or self.scenario.clock.real:
                self.release()
                self._await(lambda k=k: self.completed >= k)  # type: ignore[misc]
                if self.completed < k:
                    self._raise()
                yield k, figures_at(self._of_conductor.collector, k)
            else:
                yield k, self.until(k)

    def release(self) -> None:
        """Let the clock go on to the end."""
        with suppress(RunOver):
            self._ask(Conductor.release)

    def wait(self, *, check: bool = True) -> Summary:
        """Let the clock go on, and wait for the end of the run and its results.

        check: raises RunFailed, with the reason, where the run is not complete, unless ``stop`` has ended it.
        """
        self.release()
        self._await(lambda: False)
        self._thread.join()
        if self._summary is None or (check and self._summary.status != "complete" and not self._stopped):
            self._raise()
        self._told = True
        return self._summary

    def stop(self) -> Summary:
        """End the run now; what was collected is kept, and it counts as interrupted."""
        self._stopped = not self._over
        self._end("stopped by the script")
        return self.wait(check=False)

    def outcome(self, number: int) -> Happened | None:
        """What became of an order; None as long as that is to come, or where the run ended before."""
        if self._over:
            told = () if self._summary is None else self._summary.events
            found = next((event for event in told if event.number == number), None)
            return found or self._of_conductor.outcome(number)  # done, and the run ended at that very step
        with suppress(RunOver):
            return self._ask(lambda conductor: conductor.outcome(number))
        return None

    def go_on_for(self, ordered: Ordered, seen: int) -> None:
        """Let the clock go as far as an order needs, or wait for something new since ``seen``."""
        completed, held = self.completed, self._of_conductor.resting
        needed = completed + 1 if ordered.at is None else ordered.at - 1
        if held and completed < needed <= self.scenario.steps:
            self.until(needed)
        else:
            self._await(lambda: self._changes != seen)

    @property
    def _of_conductor(self) -> Conductor:
        assert self._conductor is not None
        return self._conductor

    def _order(self, event: dict[str, Any]) -> Ordered:
        event = plain({key: value for key, value in event.items() if value is not None})

        def place(conductor: Conductor) -> Ordered:
            if "at" not in event and "when" not in event and conductor.held_at is not None:
                event["at"] = conductor.held_at + 1
            return Ordered(self, conductor.order(event), event["action"], event.get("at"))

        return self._ask(place)

    def _let_go(self, step: int) -> None:
        """Up to a step, where the clock is held if it can be."""
        if self.scenario.clock.real:
            self.release()
        else:
            with suppress(RunOver):
                self._ask(partial(_hold, step))

    def _step_of(self, moment: int | str, where: str) -> int:
        steps = self.scenario.steps
        if isinstance(moment, str):
            try:
                step = -(-parse_duration(moment, zero=True) // self.scenario.clock.period_ns)
            except PydanticCustomError as error:
                raise UsageError(f"{where}: {(error.context or {})['text']}, or a step") from None
        elif isinstance(moment, int) and not isinstance(moment, bool):
            step = moment
        else:
            raise UsageError(f"{where}: got {shown(moment)}; allowed: a step, or a duration such as '500 ms'")
        if not 0 <= step <= steps:
            raise UsageError(f"{where}: got {shown(moment)}; allowed: at most {steps}, the steps of the scenario")
        return step

    def _ask(self, order: Callable[[Conductor], T]) -> T:
        """Have the thread of the run do it. Raises RunOver where the run has ended."""
        return self._work.desk.put(order).result()

    def _opened(self, conductor: Conductor) -> None:
        """On the thread of the run, before it begins."""
        conductor.on_progress = self._tell
        conductor.hold(0)
        self._conductor = conductor

    def _play(self) -> None:
        try:
            self._summary = self._work.in_process() if self._in_process else self._work.over_zenoh()
        except BaseException as error:  # the script is told
            self._error = error
        finally:
            self._work.desk.close()
            atexit.unregister(self._end)
            self._over = True
            self._tell()

    def _tell(self) -> None:
        with self._changed:
            self._changes += 1
            self._changed.notify_all()

    def _await(self, done: Callable[[], bool]) -> None:
        """Wait until something is so, or the run has ended."""
        with self._changed:
            while not (self._over or done()):
                self._changed.wait()

    def _raise(self) -> NoReturn:
        """Say why the run has not come so far."""
        self._told = True
        if self._error is not None:
            raise self._error
        assert self._summary is not None
        raise RunFailed(self._summary.reason or f"the run was over after step {self._summary.completed_steps}")

    def _end(self, reason: str) -> None:
        """Stop the run, and see it end, whatever interrupts."""
        interrupted: KeyboardInterrupt | None = None
        while not self._over:
            try:
                self._work.desk.put(lambda conductor: conductor.end(reason))
                self._await(lambda: False)
            except KeyboardInterrupt as error:  # its processes are to end first
                interrupted = error
        if interrupted is not None:
            raise interrupted


def _hold(step: int, conductor: Conductor) -> None:
    if step < conductor.granted:
        raise UsageError(
            f"until: got step {step}, which the clock has passed; allowed: {conductor.granted} or later, where it is"
        )
    conductor.hold(step)


def _words_of(error: BaseException) -> str:
    return f"stopped: the script raised {type(error).__name__}"
