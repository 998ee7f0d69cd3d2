"""A collector, and the parts of a run to give it in any order."""

from __future__ import annotations

from typing import Any

import numpy as np

from orchestrator.runs import scenario
from testbed.orchestrator.collect import Collector
from testbed.scenario import Scenario
from testbed.wire.setup import Setup

STEPS, LANES = 4, 5
Part = tuple[str, int, int]


def given_scenario(**changes: Any) -> Scenario:
    estimators = [{"name": "aoe"}, {"name": "oe", "acks": "none", "until": 2}]
    own = {"steps": STEPS, "lanes": LANES, "estimators": estimators, "transport": {"lanes_per_packet": 2}}
    return scenario(**{**own, **changes})


class Bench:
    """A collector, and parts with random contents to give it."""

    def __init__(self, made: Scenario, seed: int = 1, late: tuple[str, int] | None = None) -> None:
        """late: an estimator that joins, and its first step."""
        self.setup, self.late = Setup("run0testrun1", made), late
        self.collector = Collector(self.setup)
        rng = np.random.default_rng(seed)
        shape = (made.steps + 1, made.lanes)
        self.x = rng.normal(size=(*shape, 2))
        self.nu = rng.integers(0, 2, size=shape).astype(np.uint8)
        self.x_hat = {name: rng.normal(size=(*shape, 2)) for name in ("aoe", "oe", "new")}
        root = rng.normal(size=(*shape, 2, 2))
        self.P = root @ root.swapaxes(2, 3) + np.eye(2)
        self.traces = rng.random(size=(2, *shape))
        self.applied = rng.normal(size=(*shape, 1))

    def parts(self) -> list[Part]:
        """All parts of a run: (what, step, lane)."""
        made = self.setup.scenario
        kinds = [("truth", 1, made.steps), *((spec.name, 1, spec.until or made.steps) for spec in made.estimators)]
        kinds += [("bounds", 1, made.steps)] if made.bounds else []
        kinds += [(*self.late, made.steps)] if self.late else []
        lanes = [lane for lane, _ in self.setup.blocks]
        return [(what, k, lane) for what, first, last in kinds for k in range(first, last + 1) for lane in lanes]

    def give(self, part: Part) -> None:
        what, k, lane = part
        rows = slice(lane, lane + dict(self.setup.blocks)[lane])
        if what == "truth":
            applied = self.applied[k, rows]
            self.collector.truth(k, lane, {"x": self.x[k, rows], "nu": self.nu[k, rows], "applied": applied})
        elif what == "bounds":
            lower, upper = self.traces[:, k, rows]
            self.collector.bound(k, lane, {"trace_lower": lower, "trace_upper": upper})
        else:
            self.collector.estimate(what, k, lane, {"x_hat": self.x_hat[what][k, rows], "P": self.P[k, rows]})
