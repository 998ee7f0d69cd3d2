"""Single lane in lock-step: one step in flight, six hops a step."""

from __future__ import annotations

from benchmarks.figures import Figures, Target
from benchmarks.single_lane import measure


def run(*, quick: bool) -> Figures:
    figures, _, ratio = measure("lockstep", window=1, quick=quick)
    figures.targets.append(Target("lock-step rate, testbed / bare chain", ratio.value, 0.6))
    return figures
