"""Collection: truth, estimates and bounds of each step and block, joined and reduced as they come. No I/O."""

from __future__ import annotations

import json
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from testbed.errors import UsageError
from testbed.numerics.lanes import Component, Matrix, Vector, matrix_of, vector_of
from testbed.orchestrator.cost import CostBook
from testbed.orchestrator.lane_windows import window_ends
from testbed.orchestrator.lanes_file import LaneFigures
from testbed.orchestrator.statistics import (
    ERROR_FIGURES,
    LANE_FIGURES,
    Arrays,
    Figures,
    Series,
    error_figures,
    prepare,
)
from testbed.wire.setup import Setup
from testbed.wire.state import pack, unpack

TRUTH, BOUNDS = "truth", "bounds"


@dataclass
class _Step:
    """One step: what has come of it, how much has not, and what has come before its truth."""

    parts: frozenset[str]
    outstanding: int
    gate: int
    come: list[tuple[int, str]] = field(default_factory=list)
    largest: float = 0.0
    applied: int = 0
    truth: dict[int, Vector] = field(default_factory=dict)
    early: dict[int, list[tuple[str, Vector, Matrix]]] = field(default_factory=dict)


class Collector:
    """Knows which steps are complete, and the figures of those.

    completed: steps of which everything has come, in order. estimated: steps of which every estimate has come, which
    is what lets the clock go on; truth and bounds may follow later. All sums are of completed steps.
    """

    def __init__(self, setup: Setup) -> None:
        self._setup, scenario = setup, setup.scenario
        self._blocks = [lane for lane, _ in setup.blocks]
        self._first = {spec.name: 1 for spec in scenario.estimators}
        self._until = {spec.name: spec.until or scenario.steps for spec in scenario.estimators}
        self._words = {name: f"estimate of {name}" for name in self._until}
        self._bounds_until = scenario.steps if scenario.bounds else 0
        self._count = scenario.steps
        self._windows = window_ends(scenario.steps, scenario.lanes, self._until.values())
        self.estimators = {spec.name: self._new_series() for spec in scenario.estimators}
        self.bounds = Series(("lower", "upper", "upper_correlated"), scenario.lanes)
        self.completed = 0
        self.estimated = 0
        self.on_completed: Callable[[int], None] | None = None
        """Called with each step when it is complete and the next one is not yet."""
        self.discarded: Counter[str] = Counter()
        """Lanes × steps that came of a part that was given up, after the last whole step of it."""
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
        self.watch: Callable[[str, int, int, Figures], None] = lambda name, step, lane, figures: None
        """Called with the figures of each estimator, step and block of lanes, as they come."""

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
        record.applied += int(np.count_nonzero(arrays["nu"]))
        if self.cost is not None:
            self.cost.add(step, lane, x, arrays.get("applied"))
        for name, x_hat, P in record.early.pop(lane, ()):
            self._reduce(name, step, lane, x, x_hat, P)
        self._done(record, lane, TRUTH)

    def estimate(self, name: str, step: int, lane: int, arrays: Arrays) -> None:
        if self.discarded and step > self._until[name]:
            self.discarded[self._words[name]] += len(arrays["x_hat"])
            return
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
        if step > self._bounds_until:
            self.discarded[BOUNDS] += len(arrays["trace_lower"])
            return
        figures = {"lower": _component(arrays["trace_lower"])}
        for name in ("upper", "upper_correlated"):
            if f"trace_{name}" in arrays:
                figures[name] = _component(arrays[f"trace_{name}"])
        self.bounds.add(step, lane, figures)
        self._done(self._of(step), lane, BOUNDS)

    def abandon(self, name: str) -> int:
        """Go on without the estimates of a name: the last step of which all lanes have come, where its figures end.

        What has come of later steps, or will, is discarded.
        """
        word = self._words[name]
        last = self._until[name] = self._last_whole(word, self._first[name], self._until[name])
        for record in self._strike(word, self.estimators[name], last):
            record.early = {lane: [e for e in early if e[0] != name] for lane, early in record.early.items()}
        self._plan()
        self._advance()
        return last

    def abandon_bounds(self) -> int:
        """Go on without bounds, as ``abandon`` does without an estimator."""
        last = self._bounds_until = self._last_whole(BOUNDS, 1, self._bounds_until)
        self._strike(BOUNDS, self.bounds, last)
        self._plan()
        self._advance()
        return last

    def state(self) -> bytes:
        """What outlives the last completed step, beside its figures and those before it."""
        plan = {
            "first": self._first,
            "until": self._until,
            "bounds_until": self._bounds_until,
            "discarded": self.discarded,
        }
        arrays = {"plan": np.frombuffer(json.dumps(plan).encode(), dtype=np.uint8)}
        if self.estimators:
            arrays |= _named("estimators", _stacked([s.state(self.completed) for s in self.estimators.values()]))
        if self.cost is not None:
            arrays |= _named("cost", self.cost.state(self.completed))
        return pack(arrays, completed=self.completed, applied=self.applied)

    def figures(self, after: int, to: int) -> bytes:
        """The figures of the completed steps after + 1 … to."""
        names = json.dumps(list(self.estimators)).encode()
        arrays = {"names": np.frombuffer(names, dtype=np.uint8), "largest": np.array(self.largest_state[after:to])}
        if self.estimators:
            arrays |= _named("estimators", _stacked([s.figures(after, to) for s in self.estimators.values()]))
        arrays |= _named("bounds", self.bounds.figures(after, to))
        if self.cost is not None:
            arrays |= _named("cost", self.cost.series.figures(after, to))
        return pack(arrays, after=after, to=to)

    def resume(self, step: int, state: bytes, figures: Iterable[bytes]) -> None:
        """Go on after ``step`` completed steps, as the collector whose ``state`` that was; called on a new one.

        figures: what ``figures`` gave of steps in a row, 1 … step or further; of a step that is there twice the later
        ones count. Raises UsageError where this does not belong to the run, or a step is missing.
        """
        try:
            self._put_plan(step, state)
            for part in figures:
                self._put_figures(step, part)
            if len(self.largest_state) != step:
                raise UsageError(f"figures of {len(self.largest_state)} steps, expected {step}")
            self._put_state(step, unpack(state).group(""))
        except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
            raise UsageError(f"not what a collector of this run gave: {' '.join(str(error).split())}") from None

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

    def _put_plan(self, step: int, state: bytes) -> None:
        given = unpack(state)
        if given.number("completed") != step:
            raise UsageError(f"the state of the collector is not that after step {step}")
        self.applied = given.number("applied")
        plan = json.loads(given.group("")["plan"].tobytes())
        for name, until in plan["until"].items():
            if name not in self._until:
                self.expect(name, plan["first"][name], until)
            self._until[name] = until
        self._bounds_until = plan["bounds_until"]
        self.discarded.update(plan["discarded"])
        self._plan()

    def _put_figures(self, step: int, figures: bytes) -> None:
        given = unpack(figures)
        after, to = given.number("after"), min(step, given.number("to"))
        if after >= step:
            return
        if after > len(self.largest_state):
            raise UsageError(f"no figures of the steps {len(self.largest_state) + 1} … {after}")
        arrays = given.group("")
        self.largest_state[after:] = arrays["largest"][: to - after].tolist()
        for i, name in enumerate(json.loads(arrays["names"].tobytes())):
            if name in self.estimators:  # else it joined after ``step``
                self.estimators[name].put_figures(after, to, {k: a[i] for k, a in _of("estimators", arrays).items()})
        self.bounds.put_figures(after, to, _of("bounds", arrays))
        if self.cost is not None:
            self.cost.series.put_figures(after, to, _of("cost", arrays))

    def _put_state(self, step: int, arrays: Arrays) -> None:
        for i, series in enumerate(self.estimators.values()):
            series.put_state(step, {k: a[i] for k, a in _of("estimators", arrays).items()})
        self.bounds.put_state(step, {})
        if self.cost is not None:
            self.cost.put_state(step, _of("cost", arrays), self._setup.blocks)
        self.completed = self.estimated = step

    def _last_whole(self, word: str, first: int, until: int) -> int:
        """The last step up to which all lanes of a part have come."""
        step = max(self.completed, first - 1)
        while step < until and (record := self._steps.get(step + 1)) is not None:
            if sum(part == word for _, part in record.come) < len(self._blocks):
                break
            step += 1
        return min(step, until)

    def _strike(self, word: str, series: Series, last: int) -> list[_Step]:
        """Have no step after ``last`` wait for a part; those that did."""
        self.discarded[word] += 0
        struck, sizes = [], dict(self._setup.blocks)
        for step, record in self._steps.items():
            if step > last and word in record.parts:
                come = [lane for lane, part in record.come if part == word]
                self.discarded[word] += sum(sizes[lane] for lane in come)
                missing = len(self._blocks) - len(come)
                record.outstanding -= missing
                record.gate -= missing if word != BOUNDS else 0
                record.parts -= {word}
                record.come = [entry for entry in record.come if entry[1] != word]
                series.drop(step)
                struck.append(record)
        return struck

    def _reduce(self, name: str, step: int, lane: int, x: Vector, x_hat: Vector, P: Matrix) -> None:
        figures = error_figures(x, x_hat, P)
        self.estimators[name].add(step, lane, figures)
        self.watch(name, step, lane, figures)

    def _new_series(self) -> Series:
        return Series(ERROR_FIGURES, self._setup.scenario.lanes, kept=len(LANE_FIGURES), ends=self._windows)

    def _parts_at(self, step: int) -> tuple[frozenset[str], int]:
        """What a block of lanes has at a step, and how many of it are estimates."""
        names = {self._words[name] for name, until in self._until.items() if self._first[name] <= step <= until}
        return frozenset(names | {TRUTH} | ({BOUNDS} if step <= self._bounds_until else set())), len(names)

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
        self._ends = sorted({*self._until.values(), *begins, self._bounds_until, self._count})
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
        self._advance()

    def _done(self, record: _Step, lane: int, part: str) -> None:
        record.come.append((lane, part))
        record.outstanding -= 1
        if not record.gate:
            self._advance()

    def _advance(self) -> None:
        """To the first step of which something has not come."""
        steps = self._steps
        while (following := steps.get(self.completed + 1)) is not None and not following.outstanding:
            self.completed += 1
            del steps[self.completed]
            self.largest_state.append(following.largest)
            self.applied += following.applied
            for series in self._series:
                series.close(self.completed)
            if self.on_completed is not None:
                self.on_completed(self.completed)
        if self.estimated < self.completed:
            self.estimated = self.completed
        while (following := steps.get(self.estimated + 1)) is not None and self._estimated(following):
            self.estimated += 1

    def _estimated(self, record: _Step) -> bool:
        """Whether all estimates of a step have come; where no estimator runs any more, everything else."""
        return not record.gate and (not record.outstanding or self.estimated < self._last_estimate)


def _component(array: NDArray[np.float64]) -> Component:
    return float(array[0]) if len(array) == 1 else array


def _stacked(parts: list[Arrays]) -> Arrays:
    return {name: np.stack([part[name] for part in parts]) for name in parts[0]}


def _named(prefix: str, arrays: Arrays) -> Arrays:
    return {f"{prefix}.{name}": array for name, array in arrays.items()}


def _of(prefix: str, arrays: Arrays) -> Arrays:
    """What ``_named`` has named so."""
    return {name.removeprefix(f"{prefix}."): a for name, a in arrays.items() if name.startswith(f"{prefix}.")}
