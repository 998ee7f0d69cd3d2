"""The mathematics of a run without messages: the project's own cores called in one loop in one process."""

from __future__ import annotations

import time
from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from testbed.channel.loss import LossCounts
from testbed.channel.service import loss_process
from testbed.estimator.bounds import Bounds
from testbed.estimator.registry import create, model_of
from testbed.numerics.lanes import array_of, trace
from testbed.orchestrator.statistics import ERROR_FIGURES, Series, error_figures
from testbed.plant.dynamics import Plant, bits
from testbed.plant.inputs import control_bound, open_loop
from testbed.scenario import Scenario


@dataclass(frozen=True)
class Floor:
    """wall_s of the loop and, by part, the seconds in it."""

    steps: int
    lanes: int
    wall_s: float
    parts: dict[str, float]

    @property
    def lane_steps_per_s(self) -> float:
        return self.steps * self.lanes / self.wall_s


def run_floor(scenario: Scenario) -> Floor:
    """Plant, both losses, AOE, statistics (and the bounds where the scenario has them), step after step."""
    lanes, steps = scenario.lanes, scenario.steps
    plant = Plant(scenario, 0, lanes)
    control, observation = (loss_process(scenario, link, 0, lanes) for link in ("control", "observation"))
    counts = {"control": LossCounts(), "observation": LossCounts()}
    spec, model = scenario.estimators[0], model_of(scenario)
    estimator = create(spec.kind, model, lanes=lanes, options=spec.options)
    bounds = Bounds(model, control_bound(scenario), lanes) if scenario.bounds else None
    source = open_loop(scenario, 0, lanes)
    series, bound_series = Series(ERROR_FIGURES, lanes), Series(("lower", "upper"), lanes)
    parts: dict[str, float] = defaultdict(float)
    begun = last = time.perf_counter()

    def spent(part: str) -> None:
        nonlocal last
        now = time.perf_counter()
        parts[part] += now - last
        last = now

    with np.errstate(all="ignore"):
        for k in range(1, steps + 1):
            u = source(k - 1)
            spent("controller")
            applied = control.next(k - 1)
            counts["control"].count(0, applied)
            spent("link.control")
            _, y = plant.move(u, applied)
            spent("plant")
            arrived = observation.next(k - 1)
            counts["observation"].count(0, arrived)
            spent("link.observation")
            estimate = estimator.step(u, y, bits(arrived))
            spent("estimator.aoe")
            if bounds is not None:
                lower, upper = bounds.components(bits(arrived))
                traces = {"lower": trace(lower), **({} if upper is None else {"upper": trace(upper)})}
                spent("bounds")
                bound_series.add(k, 0, traces)
                bound_series.close(k)
            series.add(k, 0, error_figures(plant.x, estimate.x, estimate.p))
            series.close(k)
            spent("orchestrator")
    assert array_of(plant.x, lanes).shape == (lanes, model.n)
    return Floor(steps, lanes, time.perf_counter() - begun, dict(parts))
