"""Single lane in lock-step: a closed loop, in which every step waits for the estimate, beside a bare ring."""

from __future__ import annotations

from typing import Any

from benchmarks.bare import message_sizes, ring_of, run_bare, star_of
from benchmarks.figures import Figures, Median, Target, alternate, cpu_rows, ratios
from benchmarks.scenarios import scenario
from benchmarks.single_lane import enough
from benchmarks.testbed_run import run_testbed


def run(*, quick: bool) -> Figures:
    repetitions, seconds = (2, 1.0) if quick else (7, 2.0)
    sizes = message_sizes(n=2, p=2, q=1, lanes=1)
    closed, ring, opened, chain = (
        "testbed, closed loop",
        "bare ring, 5 hops",
        "testbed, open loop, window 1",
        "bare chain, 6 hops",
    )

    def ours(steps: int, *, loop: bool) -> Any:
        return lambda: run_testbed(scenario(steps=steps, window=1, closed=loop))

    def bare(steps: int, star: Any) -> Any:
        return lambda: run_bare(star, steps=steps, window=1, express=True)

    made = {
        closed: lambda steps: ours(steps, loop=True),
        ring: lambda steps: bare(steps, ring_of(sizes)),
        opened: lambda steps: ours(steps, loop=False),
        chain: lambda steps: bare(steps, star_of(sizes, whole=False)),
    }
    results = alternate(repetitions, {case: make(enough(make(600)(), seconds)) for case, make in made.items()})
    figures = Figures("lockstep")
    beside = {closed: ring, ring: ring, opened: chain, chain: chain}
    for case, runs in results.items():
        rates = [r.steps_per_s for r in runs]
        figures.rows.append(
            {
                "case": case,
                "steps/s": Median.of(rates),
                "ratio to the bare one": ratios(rates, [r.steps_per_s for r in results[beside[case]]]),
                "CPU µs/step": Median.of([r.cpu_us_per_step for r in runs]),
                "CPUs of others": Median.of([r.others for r in runs]),
            }
        )
        figures.cpu[case] = cpu_rows(runs)
    rates = {case: [r.steps_per_s for r in runs] for case, runs in results.items()}
    ratio = ratios(rates[closed], rates[ring])
    figures.targets.append(Target("lock-step rate, testbed / bare ring of as many hops", ratio.value, 0.6))
    figures.notes.append("one step in flight; rates leave out starting the processes; median (lowest … highest)")
    return figures
