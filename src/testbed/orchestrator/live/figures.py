"""The figures of one step, for a script."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NoReturn

from testbed.errors import UsageError, did_you_mean
from testbed.orchestrator.collect import Collector


@dataclass(frozen=True)
class EstimatorStep:
    """Means over lanes at one step, as in the summary; None where a figure has no value.

    trace_P: tr P_k. squared_error: ‖x_k − x̂_k‖². nees: (x − x̂)' P⁻¹ (x − x̂). excess: ‖x_k − x̂_k‖² − tr P_k.
    """

    trace_P: float | None
    squared_error: float | None
    nees: float | None
    excess: float | None


class Figures(dict[str, EstimatorStep]):
    """The figures of each estimator that runs at ``step``, by name; with step 0 there are none."""

    def __init__(self, step: int, estimators: dict[str, EstimatorStep]) -> None:
        super().__init__(estimators)
        self.step = step

    def __missing__(self, name: str) -> NoReturn:
        allowed = ", ".join(self) or "none"
        raise UsageError(
            f"no estimator {name!r} at step {self.step}; allowed: {allowed}{did_you_mean(str(name), self)}"
        )


def figures_at(collector: Collector, step: int) -> Figures:
    """Of a step that is complete, or 0. From any thread: what is complete does not change."""
    if step == 0:
        return Figures(0, {})
    found = {name: series.mean_at(step) for name, series in list(collector.estimators.items())}
    return Figures(step, {name: EstimatorStep(**means) for name, means in found.items() if means is not None})
