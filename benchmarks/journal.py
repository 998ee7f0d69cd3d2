"""What it costs that a run can be recovered: states of roles, packets that are kept, and the journal on disk."""

from __future__ import annotations

from typing import Any

from benchmarks.figures import Figures, Median, alternate, ratios
from benchmarks.scenarios import scenario
from benchmarks.summaries import changed
from benchmarks.testbed_run import Result, run_testbed

NOTHING, KEPT, JOURNAL = "nothing kept", "states and packets", "and a journal"
_RECOVERY: dict[str, dict[str, Any]] = {
    NOTHING: {"policy": "fail", "journal": False},
    KEPT: {"policy": "restart", "journal": False},
    JOURNAL: {"policy": "restart", "journal": True},
}
_STEPS = {  # (lanes, in process) → steps
    (1, False): 8_000,
    (1, True): 8_000,
    (10_000, False): 200,
    (10_000, True): 200,
}


def run(*, quick: bool) -> Figures:
    repetitions, share = (3, 2) if quick else (7, 1)
    figures = Figures("journal")
    for (lanes, in_process), steps in _STEPS.items():
        results = alternate(repetitions, {kept: _case(kept, lanes, in_process, steps // share) for kept in _RECOVERY})
        rates = {kept: [result.steps_per_s for result in found] for kept, found in results.items()}
        for kept, found in results.items():
            figures.rows.append(
                {
                    "case": f"{lanes} lane{'s' * (lanes > 1)}, {'in process' if in_process else 'processes'}: {kept}",
                    "steps/s": Median.of(rates[kept]),
                    "ratio to nothing": ratios(rates[kept], rates[NOTHING]),
                    "CPU µs/step": Median.of([result.cpu_us_per_step for result in found]),
                    "CPU ratio": ratios(*([r.cpu_us_per_step for r in results[of]] for of in (kept, NOTHING))),
                    "journal, bytes/step": Median.of([result.journal_bytes / result.steps for result in found]),
                    "CPUs of others": Median.of([result.others for result in found]),
                }
            )
    figures.notes.append("open loop, AOE, record none; a run begins anew each time; median (lowest … highest)")
    return figures


def _case(kept: str, lanes: int, in_process: bool, steps: int) -> Any:
    given = changed(scenario(steps=steps, lanes=lanes), recovery=_RECOVERY[kept])

    def case() -> Result:
        return run_testbed(given, in_process=in_process)

    return case
