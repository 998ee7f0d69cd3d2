"""Collection: truth, estimates and bounds of each step and block, joined and reduced as they come. No I/O."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.numerics.lanes import Component, Matrix, Vector, matrix_of, vector_of
from testbed.orchestrator.cost import CostBook
from testbed.orchestrator.lane_windows import window_ends
from testbed.orchestrator.lanes_file import LaneFigures
from testbed.orchestrator.statistics import ERROR_FIGURES, LANE_FIGURES, Series, error_figures, prepare
from testbed.wire.setup import Setup

Arrays = dict[str, NDArray[Any]]
TRUTH, BOUNDS = "truth", "bounds"


@dataclass
class _Step:
    """One step: what has come of it, how much has not, and what has come before its truth."""

    parts: frozenset[str]
    outstanding: int
    gate: int
    come: list[tuple[int, str]] = field(default_factory=list)
    largest: float = 0.0
    truth: dict[int, Vector] = field(default_factory=dict)
    early: dict[int, list[tuple[str, Vector, Matrix]]] = field(default_factory=dict)


class Collector:
    """Knows which steps are complete, and the figures of those.

    completed: steps of which everything has come, in order. estimated: steps of which every estimate has come, which
    is what lets the clock go on; truth and bounds may follow later.
    """

    def __init__(self, setup: Setup) -> None:
        self._setup, scenario = setup, setup.scenario
        self._blocks = [lane for lane, _ in setup.blocks]
        self._first = {spec.name: 1 for spec in scenario.estimators}
        self._until = {spec.name: spec.until or scenario.steps for spec in scenario.estimators}
        self._words = {name: f"estimate of {name}" for name in self._until}
        self._with_bounds = scenario.bounds
        self._count = scenario.steps
        self._windows = window_ends(scenario.steps, scenario.lanes, self._until.values())
        self.estimators = {spec.name: self._new_series() for spec in scenario.estimators}
        self.bounds = Series(("lower", "upper", "upper_correlated"), scenario.lanes)
        self.completed = 0
        self.estimated = 0
        self.largest_state: list[float] = []
        """The largest |x_k| of any lane and entry, at each completed step."""
        self.applied = 0
        """Lane-packets of control that the plant says it applied."""
        self.cost = (
            CostBook(scenario.cost, scenario.system, scenario.steps, scenario.lanes, self._windows)
            if scenario.cost
            else None
        )
        self._plan()
        self._steps: dict[int, _Step] = {}

    def prepare(self) -> None:
        """What would hold up the first step: make it now."""
        for lanes in {lanes for _, lanes in self._setup.blocks}:
            prepare(self._setup.sizes.n, lanes)

    def expect(self, name: str, first: int, last: int) -> None:
        """Let the estimates of a name be due until step ``last``, and of a new one from ``first`` on.

        What is complete already must not change by it.
        """
        if name not in self._until:
            self._first[name], self._words[name] = first, f"estimate of {name}"
            self.estimators[name] = series = self._new_series()
            series.begin_at(first, self.completed)
        self._until[name] = last
        self._plan_again()

    def forget(self, name: str) -> None:
        """Let a name that was to have estimates, and has none yet, have none."""
        for of in (self._first, self._until, self._words, self.estimators):
            of.pop(name)
        self._plan_again()

    @property
    def finished(self) -> bool:
        return self.completed == self._count

    def truth(self, step: int, lane: int, arrays: Arrays) -> None:
        record = self._of(step)
        x = record.truth[lane] = vector_of(arrays["x"])
        largest = max(map(abs, x)) if isinstance(x[0], float) else float(np.abs(arrays["x"]).max())
        record.largest = max(record.largest, largest)
        self.applied += int(np.count_nonzero(arrays["nu"]))
        if self.cost is not None:
            self.cost.add(step, lane, x, arrays.get("applied"))
        for name, x_hat, P in record.early.pop(lane, ()):
            self._reduce(name, step, lane, x, x_hat, P)
        self._done(record, lane, TRUTH)

    def estimate(self, name: str, step: int, lane: int, arrays: Arrays) -> None:
        record = self._of(step)
        x_hat, P = vector_of(arrays["x_hat"]), matrix_of(arrays["P"])
        x = record.truth.get(lane)
        if x is None:
            record.early.setdefault(lane, []).append((name, x_hat, P))
        else:
            self._reduce(name, step, lane, x, x_hat, P)
        record.gate -= 1
        self._done(record, lane, self._words[name])

    def bound(self, step: int, lane: int, arrays: Arrays) -> None:
        figures = {"lower": _component(arrays["trace_lower"])}
        for name in ("upper", "upper_correlated"):
            if f"trace_{name}" in arrays:
                figures[name] = _component(arrays[f"trace_{name}"])
        self.bounds.add(step, lane, figures)
        self._done(self._of(step), lane, BOUNDS)

    def by_lane(self) -> LaneFigures:
        """The figures of each lane, over the windows of completed steps."""
        ends = np.array([end for end in self._windows if end <= self.completed], dtype=np.int64)
        lasts = {name: min(until, self.completed) for name, until in self._until.items()}
        estimators = {name: series.by_lane(lasts[name]) for name, series in self.estimators.items()}
        whole = {} if self.cost is None else {"cost": self.cost.series.by_lane(self.completed)["step"]}
        return LaneFigures(ends, estimators, whole)

    def awaiting(self) -> str:
        """What the oldest incomplete step still waits for."""
        record = self._steps.get(self.completed + 1) or self._record(self.completed + 1)
        awaited = {part for lane in self._blocks for part in record.parts if (lane, part) not in record.come}
        return f"step {self.completed + 1}: {', '.join(sorted(awaited))}"

    def _reduce(self, name: str, step: int, lane: int, x: Vector, x_hat: Vector, P: Matrix) -> None:
        self.estimators[name].add(step, lane, error_figures(x, x_hat, P))

    def _new_series(self) -> Series:
        return Series(ERROR_FIGURES, self._setup.scenario.lanes, kept=len(LANE_FIGURES), ends=self._windows)

    def _parts_at(self, step: int) -> tuple[frozenset[str], int]:
        """What a block of lanes has at a step, and how many of it are estimates."""
        names = {self._words[name] for name, until in self._until.items() if self._first[name] <= step <= until}
        return frozenset(names | {TRUTH} | ({BOUNDS} if self._with_bounds else set())), len(names)

    def _of(self, step: int) -> _Step:
        record = self._steps.get(step)
        if record is None:
            record = self._steps[step] = self._record(step)
        return record

    def _record(self, step: int) -> _Step:
        parts, estimates = self._parts[bisect_left(self._ends, step)]
        blocks = len(self._blocks)
        return _Step(parts, blocks * len(parts), blocks * estimates)

    def _plan(self) -> None:
        """What each step consists of, after a change of who estimates when."""
        self._series: list[Series | CostBook] = [*self.estimators.values(), self.bounds]
        if self.cost is not None:
            self._series.append(self.cost)
        self._last_estimate = max(self._until.values(), default=0)
        begins = {first - 1 for first in self._first.values()}
        self._ends = sorted({*self._until.values(), *begins, self._count})
        self._parts = [self._parts_at(end) for end in self._ends]

    def _plan_again(self) -> None:
        """What each step consists of, those included of which something has come."""
        self._plan()
        for step, record in self._steps.items():
            parts, _ = self._parts_at(step)
            for part in record.parts ^ parts:
                missing = sum((lane, part) not in record.come for lane in self._blocks)
                change = missing if part in parts else -missing
                record.outstanding += change
                record.gate += change
            record.parts = parts
        self._go_on()

    def _done(self, record: _Step, lane: int, part: str) -> None:
        record.come.append((lane, part))
        record.outstanding -= 1
        self._go_on()

    def _go_on(self) -> None:
        """To the first step of which something has not come."""
        steps = self._steps
        while (following := steps.get(self.completed + 1)) is not None and not following.outstanding:
            self.completed += 1
            del steps[self.completed]
            self.largest_state.append(following.largest)
            for series in self._series:
                series.close(self.completed)
        if self.estimated < self.completed:
            self.estimated = self.completed
        while (following := steps.get(self.estimated + 1)) is not None and self._estimated(following):
            self.estimated += 1

    def _estimated(self, record: _Step) -> bool:
        """Whether all estimates of a step have come; where no estimator runs any more, everything else."""
        return not record.gate and (not record.outstanding or self.estimated < self._last_estimate)


def _component(array: NDArray[np.float64]) -> Component:
    return float(array[0]) if len(array) == 1 else array
