"""A process that is killed, in virtual time: how long until it is back, and what the run loses beside a plain one."""

from __future__ import annotations

from typing import Any

from benchmarks.figures import Figures, Median, alternate, ratios
from benchmarks.scenarios import scenario
from benchmarks.summaries import changed, summary_of

ROLES = ("plant", "link.observation", "estimator.aoe")
PLAIN = "nobody is killed"


def run(*, quick: bool) -> Figures:
    steps = 4_000 if quick else 16_000
    given = changed(scenario(steps=steps), recovery={"policy": "restart"})
    cases: dict[str, Any] = {PLAIN: lambda: summary_of(given)}
    for role in ROLES:
        kill = changed(given, events=[{"at": 3 * steps // 4, "action": "kill", "role": role}])
        cases[f"{role} is killed"] = lambda kill=kill: summary_of(kill)
    results = alternate(2 if quick else 5, cases)
    figures = Figures("recovery")
    walls = {case: [summary["timing"]["wall_s"] for summary in found] for case, found in results.items()}
    for case, found in results.items():
        row: dict[str, Any] = {"case": case, "run, s": Median.of(walls[case])}
        row["ratio to plain"] = ratios(walls[case], walls[PLAIN])
        if case != PLAIN:
            lost = [summary["recovered"][0] for summary in found]
            row["back after, ms"] = Median.of([entry["down_ms"] for entry in lost])
            row["steps worked off"] = Median.of([entry["step"] - entry["begin"] for entry in lost])
            row["its start-up, ms"] = Median.of([1e3 * summary["timing"]["startup_s"] for summary in found])
        figures.rows.append(row)
    figures.notes.append(
        f"{steps} steps of one lane over processes, killed after three quarters; start-up: of all processes together "
        "at the beginning of the same run; median (lowest … highest)"
    )
    return figures
