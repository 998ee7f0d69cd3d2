"""``python -m faults SEED [--processes]``, with tests/ on the path: replay one seed and tell all about it."""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from faults.over_processes import trial as trial_over_processes
from faults.trial import trial
from testbed.scenario import parse_scenario, to_toml


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m faults", description="Replay one random timeline of faults.")
    parser.add_argument("seed", type=int)
    parser.add_argument("--processes", action="store_true", help="over real processes instead of in one")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        made = (trial_over_processes if options.processes else trial)(options.seed, Path(folder))
    events = [*made.table["events"], *made.ends]
    print(to_toml(parse_scenario({**made.table, "recovery": made.recovery, "events": events})))
    print(f"# order of delivery: seed {made.schedule}" if made.schedule is not None else "# over processes")
    for fault in made.faults:
        print(f"# {fault}")
    if made.disturbed is not None:
        summary = made.disturbed.summary
        for line in (*made.disturbed.log, *(recovered.text for recovered in summary.recovered)):
            print(line)
        for event in summary.events:
            print(f"step {event.step}: {event.text}")
        print(f"repeated {summary.repeated}, rejected {summary.rejected}")
        print(summary.status if summary.reason is None else f"{summary.status}: {summary.reason}")
    print("\n".join(made.problems) or "all is as it should be")
    return 1 if made.problems else 0


if __name__ == "__main__":
    sys.exit(main())
