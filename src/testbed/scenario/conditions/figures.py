"""What a condition can speak of, and the figures of a step that it is given."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from testbed.numerics.lanes import Floats

FIGURES = {"trace_P": "trace_P", "error": "squared_error", "nees": "nees"}
"""Of an estimator: the word of the language, and the name among the figures of a run."""
LOSS_RATE = "loss_rate"
QUANTITIES = ("step", "time")
REDUCTIONS = ("mean", "max", "min")
FUNCTIONS = {"abs": 1, "min": 2, "max": 2}
"""With the number of their arguments; min and max take more, too."""


@dataclass(frozen=True)
class Names:
    """The estimators and links that may be named, and the period, in nanoseconds."""

    estimators: tuple[str, ...]
    links: tuple[str, ...]
    period_ns: int


@dataclass(frozen=True)
class StepFigures:
    """Of one step. What is absent has no value.

    estimators: by name and figure (`trace_P`, `squared_error`, `nees`), (lanes,). links: by name, how many lane-packets
    were sent at the step and how many of them were lost.
    """

    estimators: Mapping[str, Mapping[str, Floats]] = field(default_factory=dict)
    links: Mapping[str, tuple[int, int]] = field(default_factory=dict)
