"""Collection: truth, estimates and bounds of each step and block, joined and reduced as they come. No I/O."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.numerics.lanes import Component, Matrix, Vector, matrix_of, vector_of
from testbed.orchestrator.statistics import ERROR_FIGURES, Series, error_figures
from testbed.wire.setup import Setup

Arrays = dict[str, NDArray[Any]]


@dataclass
class _Pending:
    """One step of one block: what has come and what is still awaited."""

    awaited: set[str]
    truth: Vector | None = None
    estimates: list[tuple[str, Vector, Matrix]] = field(default_factory=list)


class Collector:
    """Knows which steps are complete, and the figures of those."""

    def __init__(self, setup: Setup) -> None:
        scenario = setup.scenario
        self._blocks = [lane for lane, _ in setup.blocks]
        self._until = {spec.name: spec.until or scenario.steps for spec in scenario.estimators}
        self._with_bounds = scenario.bounds
        self._steps = scenario.steps
        self.estimators = {spec.name: Series(ERROR_FIGURES, scenario.lanes) for spec in scenario.estimators}
        self.bounds = Series(("lower", "upper", "upper_correlated"), scenario.lanes)
        self.completed = 0
        self.applied = 0
        """Lane-packets of control that the plant says it applied."""
        self._pending: dict[int, dict[int, _Pending]] = {}

    @property
    def finished(self) -> bool:
        return self.completed == self._steps

    def truth(self, step: int, lane: int, arrays: Arrays) -> None:
        pending = self._of(step, lane)
        pending.truth = vector_of(arrays["x"])
        self.applied += int(np.count_nonzero(arrays["nu"]))
        for name, x_hat, P in pending.estimates:
            self._reduce(name, step, lane, pending.truth, x_hat, P)
        pending.estimates.clear()
        self._done(step, lane, "truth")

    def estimate(self, name: str, step: int, lane: int, arrays: Arrays) -> None:
        pending = self._of(step, lane)
        x_hat, P = vector_of(arrays["x_hat"]), matrix_of(arrays["P"])
        if pending.truth is None:
            pending.estimates.append((name, x_hat, P))
        else:
            self._reduce(name, step, lane, pending.truth, x_hat, P)
        self._done(step, lane, f"estimate of {name}")

    def bound(self, step: int, lane: int, arrays: Arrays) -> None:
        figures = {"lower": _component(arrays["trace_lower"])}
        for name in ("upper", "upper_correlated"):
            if f"trace_{name}" in arrays:
                figures[name] = _component(arrays[f"trace_{name}"])
        self.bounds.add(step, lane, figures)
        self._of(step, lane)
        self._done(step, lane, "bounds")

    def awaiting(self) -> str:
        """What the oldest incomplete step still waits for."""
        step = self.completed + 1
        awaited: set[str] = set()
        for lane in self._blocks:
            awaited |= self._of(step, lane).awaited
        return f"step {step}: {', '.join(sorted(awaited))}"

    def _reduce(self, name: str, step: int, lane: int, x: Vector, x_hat: Vector, P: Matrix) -> None:
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            self.estimators[name].add(step, lane, error_figures(x, x_hat, P))

    def _of(self, step: int, lane: int) -> _Pending:
        blocks = self._pending.get(step)
        if blocks is None:
            blocks = self._pending[step] = {block: _Pending(self._awaited(step)) for block in self._blocks}
        return blocks[lane]

    def _awaited(self, step: int) -> set[str]:
        names = {f"estimate of {name}" for name, until in self._until.items() if step <= until}
        return names | {"truth"} | ({"bounds"} if self._with_bounds else set())

    def _done(self, step: int, lane: int, part: str) -> None:
        self._pending[step][lane].awaited.discard(part)
        while (blocks := self._pending.get(self.completed + 1)) and not any(b.awaited for b in blocks.values()):
            self.completed += 1
            del self._pending[self.completed]
            for series in (*self.estimators.values(), self.bounds):
                series.close(self.completed)


def _component(array: NDArray[np.float64]) -> Component:
    return float(array[0]) if len(array) == 1 else array
