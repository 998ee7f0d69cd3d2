"""Single lane, open loop, with the window that the testbed chooses."""

from __future__ import annotations

from benchmarks.figures import Figures, Target
from benchmarks.scenarios import scenario
from benchmarks.single_lane import measure


def run(*, quick: bool) -> Figures:
    from testbed.wire.setup import Setup

    window = Setup("0123456789ab", scenario(steps=1)).window
    figures, rate, _ = measure("streaming", window=window, quick=quick)
    figures.targets.append(Target("steps/s, one lane, open loop", rate.value, 12_000))
    return figures
