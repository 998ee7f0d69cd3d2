"""4096 lanes of 2 states through all processes, beside in-process, the mathematics alone, and the bytes alone."""

from __future__ import annotations

from typing import Any

from benchmarks.bare import message_sizes, run_bare, star_of
from benchmarks.figures import Figures, Median, Target, alternate, cpu_rows, ratios
from benchmarks.floor import run_floor
from benchmarks.scenarios import scenario
from benchmarks.testbed_run import run_testbed

LANES = 4096


def run(*, quick: bool) -> Figures:
    repetitions, steady = (2, 400) if quick else (5, 1000)
    star = star_of(message_sizes(n=2, p=2, q=1, lanes=LANES), whole=True)

    def ours(steps: int, *, bounds: bool = False, in_process: bool = False) -> Any:
        return lambda: run_testbed(scenario(steps=steps, lanes=LANES, bounds=bounds), in_process=in_process)

    def bare(steps: int) -> Any:
        return lambda: run_bare(star, steps=steps, window=window, express=False, lanes=LANES)

    window = run_testbed(scenario(steps=20, lanes=LANES)).window
    short, long, bounded = "testbed, 200 steps", f"testbed, {steady} steps", f"testbed, bounds, {steady} steps"
    cases = {
        short: ours(200),
        long: ours(steady),
        bounded: ours(steady, bounds=True),
        "in process, 200 steps": ours(200, in_process=True),
        "mathematics alone": lambda: run_floor(scenario(steps=200, lanes=LANES)),
        "mathematics alone, bounds": lambda: run_floor(scenario(steps=200, lanes=LANES, bounds=True)),
        "bare star, same bytes": bare(steady),
    }
    results = alternate(repetitions, cases)
    floors = [r.lane_steps_per_s for r in results["mathematics alone"]]
    figures = Figures("lanes")
    for case, runs in results.items():
        rates = [r.lane_steps_per_s for r in runs]
        row = {"case": case, "lane-steps/s": Median.of(rates), "ratio to the mathematics alone": ratios(rates, floors)}
        if hasattr(runs[0], "cpu"):
            row["CPU µs/step"] = Median.of([r.cpu_us_per_step for r in runs])
            row["CPUs of others"] = Median.of([r.others for r in runs])
        figures.rows.append(row)
    for case, floor in ((long, "mathematics alone"), (bounded, "mathematics alone, bounds")):
        parts = _median_parts(results[floor])
        figures.cpu[case] = cpu_rows(results[case], parts)
    figures.cpu["bare star, same bytes"] = cpu_rows(results["bare star, same bytes"])
    rate = Median.of([r.lane_steps_per_s for r in results[short]])
    figures.targets.append(Target("lane-steps/s, 4096 lanes × 200 steps", rate.value, 3_000_000))
    figures.notes.append(f"window {window}; rates leave out starting the processes; median (lowest … highest)")
    return figures


def _median_parts(runs: list[Any]) -> dict[str, float]:
    """µs a step of each part of the mathematics, under the names of the roles that do it."""
    parts = {}
    for part in runs[0].parts:
        seconds = Median.of([r.parts[part] for r in runs]).value
        parts[{"bounds": "bounds_service"}.get(part, part)] = 1e6 * seconds / runs[0].steps
    return parts
