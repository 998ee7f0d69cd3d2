"""The quadratic cost of a run: of each step and lane as it comes, and of whole lanes at the end. No I/O."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from testbed.numerics.lanes import (
    Component,
    Constant,
    Floats,
    Vector,
    constant,
    constant_times,
    dot,
    vector_of,
)
from testbed.numerics.moments import LaneMoments, Result
from testbed.orchestrator.statistics import Arrays, Series
from testbed.scenario import Cost, System

FIGURES = ("step", "state", "input")


def cost_of_step(weights: Cost, q: int, x: Vector, applied: Vector, *, last: bool) -> dict[str, Component]:
    """x'Qx x + a'Ru a of every lane, and its two terms; x is x_k less the reference, a the input applied at k − 1.

    last: with the terminal weight.
    """
    weight = weights.terminal if last and weights.terminal is not None else weights.Qx
    state = _quadratic(constant(weight), x)
    if weights.Ru is None or not q:
        pushed = 0.0 if isinstance(state, float) else np.zeros_like(state)
    else:
        pushed = _quadratic(constant(weights.Ru), applied)
    return {"step": state + pushed, "state": state, "input": pushed}


def _quadratic(weight: Constant, x: Vector) -> Component:
    return dot(x, constant_times(weight, x))


class CostBook:
    """Figures along k over lanes, and the sums of whole lanes, J_k = Σ_{j ≤ k}; a lane's steps come in order."""

    def __init__(self, weights: Cost, system: System, steps: int, lanes: int, ends: tuple[int, ...]) -> None:
        """ends: of the windows of steps over which the cost is kept of each lane."""
        self._weights, self._q, self._steps, self._lanes = weights, system.q, steps, lanes
        self._reference = [0.0] * system.n if weights.reference is None else list(weights.reference)
        self.series = Series(FIGURES, lanes, kept=1, ends=ends)
        self._sums: dict[int, Component] = {}
        self._open: dict[int, dict[int, Component]] = {}

    def add(self, step: int, lane: int, x: Vector, applied: Floats | None) -> None:
        """Take in x_k and the input applied at k − 1 (M, q) of a block of lanes."""
        away = [c - r if r else c for c, r in zip(x, self._reference, strict=True)]
        pushed = [] if applied is None else vector_of(applied)
        figures = cost_of_step(self._weights, self._q, away, pushed, last=step == self._steps)
        self.series.add(step, lane, figures)
        self._open.setdefault(step, {})[lane] = figures["step"]

    def close(self, step: int) -> None:
        """The next step is complete."""
        self.series.close(step)
        for lane, cost in self._open.pop(step).items():
            self._sums[lane] = self._sums[lane] + cost if lane in self._sums else cost

    def state(self, step: int) -> Arrays:
        """What outlives the last complete step beside the figures: sums (lanes,), once there are any."""
        sums = [np.atleast_1d(self._sums[lane]) for lane in sorted(self._sums)]
        return {**self.series.state(step), **({"sums": np.concatenate(sums)} if sums else {})}

    def put_state(self, step: int, arrays: Arrays, blocks: Sequence[tuple[int, int]]) -> None:
        """Have what ``state`` gave; blocks: (first lane, number of lanes)."""
        self.series.put_state(step, arrays)
        for lane, lanes in blocks if "sums" in arrays else ():
            self._sums[lane] = float(arrays["sums"][lane]) if lanes == 1 else arrays["sums"][lane : lane + lanes].copy()

    def total(self) -> Result:
        """Number of lanes, mean of their sums over the closed steps, and its standard error.

        No mean where the sum of a lane is not finite: it must not drop out.
        """
        if self._lanes == 1:
            return (1, float(self._sums[0]), None) if self._sums else (0, None, None)
        if not all(np.isfinite(cost).all() for cost in self._sums.values()):
            return (0, None, None)
        moments = LaneMoments(1, self._lanes)
        for lane in sorted(self._sums):
            moments.add(lane, np.atleast_2d(self._sums[lane]))
        return moments.results()[0]
