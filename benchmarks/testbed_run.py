"""One run of the testbed in processes of its own, with the CPU time of each role.

As a program (``python -m benchmarks.testbed_run SCENARIO.toml DIR [--in-process]``) it is the orchestrator's process:
it runs the scenario as ``testbed run`` does, reads the CPU time of all roles at the first and at the last completed
step, and prints the figures as JSON.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from benchmarks.cpu import Busy, Usage, children_of, command_of, difference, usage_of


@dataclass(frozen=True)
class Result:
    """``wall_s`` runs from the first grant of the clock to the last figure: without starting the processes."""

    steps: int
    lanes: int
    window: int
    wall_s: float
    cpu: Usage
    others: float
    """CPUs that the rest of the machine kept busy meanwhile."""
    journal_bytes: int = 0
    """On disk when the last step was complete."""

    @property
    def steps_per_s(self) -> float:
        return self.steps / self.wall_s

    @property
    def lane_steps_per_s(self) -> float:
        return self.steps_per_s * self.lanes

    @property
    def cpu_us_per_step(self) -> float:
        return 1e6 * sum(sum(parts.values()) for parts in self.cpu.values()) / self.steps


def run_testbed(scenario: object, *, in_process: bool = False) -> Result:
    """Run a scenario. Raises RuntimeError with what was printed where the run fails."""
    from testbed.scenario import to_toml

    with tempfile.TemporaryDirectory(prefix="testbed-benchmark-") as folder:
        path = Path(folder) / "scenario.toml"
        path.write_text(to_toml(scenario))  # type: ignore[arg-type]
        command = [sys.executable, "-m", "benchmarks.testbed_run", str(path), str(Path(folder) / "out")]
        done = subprocess.run(command + ["--in-process"] * in_process, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"the run failed: {done.stdout[-500:]} {done.stderr[-1500:]}")
    return Result(**json.loads(done.stdout.splitlines()[-1]))


class _Meter:
    """Takes the CPU times at the first and at the last completed step."""

    def __init__(self, journal: Path) -> None:
        self._journal, self.journal_bytes = journal, 0
        self._busy: Busy | None = None
        self._processes: dict[int, str] = {}
        self._before: Usage = {}
        self.cpu: Usage = {}
        self.others = 0.0

    def progress(self, completed: int, steps: int) -> None:
        if self._busy is None:
            self._processes = {os.getpid(): "orchestrator"} | {pid: _role(pid) for pid in children_of(os.getpid())}
            self._before, self._busy = usage_of(self._processes), Busy()
        elif completed == steps:
            self.cpu = difference(usage_of(self._processes), self._before)
            self.others = self._busy.others(sum(sum(parts.values()) for parts in self.cpu.values()))
            self.journal_bytes = sum(path.stat().st_size for path in self._journal.rglob("*") if path.is_file())


def _role(pid: int) -> str:
    """A role's name from its command line: the module and what follows, up to the connection."""
    arguments = command_of(pid)
    if "-m" not in arguments or "--connect" not in arguments:
        return f"process {pid}"
    module, *rest = arguments[arguments.index("-m") + 1 : arguments.index("--connect")]
    short = module.removeprefix("testbed.")
    return f"{ {'channel': 'link'}.get(short, short) }.{rest[1]}" if len(rest) == 2 else short.rsplit(".", 1)[-1]


def main() -> int:
    from testbed.orchestrator.run import Run
    from testbed.scenario import load_scenario

    options = argparse.ArgumentParser()
    options.add_argument("scenario", type=Path)
    options.add_argument("out", type=Path)
    options.add_argument("--in-process", action="store_true")
    given = options.parse_args()
    meter = _Meter(given.out / "journal")
    run = Run(load_scenario(given.scenario), given.out, progress=meter.progress)
    summary = run.in_process() if given.in_process else run.over_zenoh()
    if summary.status != "complete":
        print(summary.reason)
        return 1
    timing = summary.timing
    figures = {"steps": summary.steps, "lanes": summary.lanes, "window": timing.window, "wall_s": timing.wall_s}
    found = {"cpu": meter.cpu, "others": meter.others, "journal_bytes": meter.journal_bytes}
    print(json.dumps(figures | found))
    return 0


if __name__ == "__main__":
    sys.exit(main())
