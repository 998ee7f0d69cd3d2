"""One lane at a window: the testbed without and with a recording, beside the bare chain."""

from __future__ import annotations

from typing import Any

from benchmarks.bare import message_sizes, run_bare, star_of
from benchmarks.figures import Figures, Median, alternate, cpu_rows, ratios
from benchmarks.scenarios import scenario
from benchmarks.testbed_run import run_testbed


def measure(name: str, *, window: int, quick: bool) -> tuple[Figures, Median, Median]:
    """The figures, the steps/s of the testbed without a recording, and their ratio to the bare chain's."""
    repetitions, seconds = (2, 1.0) if quick else (5, 3.0)
    steps = enough(run_testbed(scenario(steps=600, window=window)), seconds)
    sizes = message_sizes(n=2, p=2, q=1, lanes=1)

    def ours(record: str) -> Any:
        return lambda: run_testbed(scenario(steps=steps, window=window, record=record))

    def bare(steps: int, *, whole: bool) -> Any:
        star = star_of(sizes, whole=whole)
        return lambda: run_bare(star, steps=steps, window=window, express=window == 1)

    bare_steps = enough(bare(2000, whole=False)(), seconds)
    cases = {
        "testbed, record none": ours("none"),
        "testbed, record first": ours("first"),
        "bare chain, 6 hops": bare(bare_steps, whole=False),
        "bare star, all messages": bare(bare_steps, whole=True),
    }
    results = alternate(repetitions, cases)
    chain = [r.steps_per_s for r in results["bare chain, 6 hops"]]
    figures = Figures(name)
    for case, runs in results.items():
        rates = [r.steps_per_s for r in runs]
        figures.rows.append(
            {
                "case": case,
                "steps": runs[0].steps,
                "steps/s": Median.of(rates),
                "ratio to the bare chain": ratios(rates, chain),
                "CPU µs/step": Median.of([r.cpu_us_per_step for r in runs]),
                "CPUs of others": Median.of([r.others for r in runs]),
            }
        )
        figures.cpu[case] = cpu_rows(runs)
    rates = [r.steps_per_s for r in results["testbed, record none"]]
    figures.notes.append(f"window {window}; rates leave out starting the processes; median (lowest … highest)")
    return figures, Median.of(rates), ratios(rates, chain)


def enough(pilot: Any, seconds: float) -> int:
    """Steps that take about ``seconds`` at the rate of the pilot."""
    return max(500, round(pilot.steps_per_s * seconds / 100) * 100)
