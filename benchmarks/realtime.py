"""Real time at 100 Hz, 500 Hz and 1 kHz: how long after its time each control leaves and each estimate is there."""

from __future__ import annotations

import os
import time
from typing import Any

from benchmarks.figures import Figures, Median, alternate
from benchmarks.scenarios import scenario
from benchmarks.summaries import summary_of

RATES_HZ = (100, 500, 1000)
PRIORITY = 10
_QUANTILES = ("p50", "p90", "p99", "max")


def run(*, quick: bool) -> Figures:
    repetitions, seconds = (1, 2.0) if quick else (5, 3.0)
    cases: dict[str, Any] = {}
    for rate in RATES_HZ:
        cases[f"{rate} Hz, timer alone"] = lambda rate=rate: _timer(rate, seconds / 2)
        cases[f"{rate} Hz"] = lambda rate=rate: _testbed(rate, seconds, None)
        cases[f"{rate} Hz, SCHED_FIFO"] = lambda rate=rate: _testbed(rate, seconds, PRIORITY)
    figures = Figures("realtime")
    for case, found in alternate(repetitions, cases).items():
        runs = [one for one in found if one is not None]
        if not runs:
            figures.notes.append(f"{case}: the system did not grant the priority")
            continue
        for what in ("control leaves", "estimate is there"):
            times = [one[what] for one in runs if what in one]
            if times:
                row: dict[str, Any] = {"case": case, "µs after its time": what}
                row |= {name: Median.of([one[name] for one in times]) for name in _QUANTILES}
                row["missed %"] = Median.of([one["missed"] for one in times]) if "missed" in times[0] else ""
                row["load"] = Median.of([one["load"] for one in runs])
                figures.rows.append(row)
    figures.notes.append(
        "6 processes (orchestrator, controller, plant, 2 links, AOE), one lane; load: processes that want a CPU, the "
        "run's own included, mean of the last minute; missed: of the deadline of one period; median (lowest … highest)"
    )
    return figures


def _testbed(rate: int, seconds: float, priority: int | None) -> dict[str, Any] | None:
    """The quantiles of one run; None where the priority was refused."""
    given = scenario(steps=int(rate * seconds), record="none")
    clock = {"mode": "real", "period": f"{1_000_000 // rate} us", "window": given.steps} | (
        {"priority": priority} if priority else {}
    )
    given = given.model_copy(update={"clock": type(given.clock).model_validate(clock)})
    realtime = summary_of(given)["realtime"]
    if priority and not realtime["priorities"]:
        return None
    stages = {"control leaves": "control/sent", "estimate is there": "estimate/aoe"}
    steps = given.steps
    shown = {
        what: {**realtime["stages"][topic]["published"], "missed": 100 * realtime["stages"][topic]["missed"] / steps}
        for what, topic in stages.items()
    }
    return {**shown, "load": os.getloadavg()[0]}


def _timer(rate: int, seconds: float) -> dict[str, Any]:
    """What a process with nothing else to do gets of the system: how late it wakes."""
    period, late = 1_000_000_000 // rate, []
    start = time.monotonic_ns() + period
    for k in range(int(rate * seconds)):
        while (left := start + k * period - time.monotonic_ns()) > 0:
            time.sleep(left / 1e9)
        late.append((time.monotonic_ns() - start - k * period) / 1e3)
    late.sort()
    places = {"p50": 0.5, "p90": 0.9, "p99": 0.99, "max": 1.0}
    quantiles = {name: late[max(0, int(share * len(late)) - 1)] for name, share in places.items()}
    return {"control leaves": quantiles, "load": os.getloadavg()[0]}
