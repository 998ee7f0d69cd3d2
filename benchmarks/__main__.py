"""``python -m benchmarks [NAME …] [--quick] [--json FILE]``: run the benchmarks and print their tables.

``fidelity`` also takes ``--seconds S`` and ``--cells PATTERN …``.
"""

from __future__ import annotations

import argparse
import json
import sys
from functools import partial
from pathlib import Path

from rich.console import Console

from benchmarks import (
    codec,
    estimators,
    fidelity,
    journal,
    lanes,
    links,
    lockstep,
    realtime,
    recovery,
    streaming,
    timeline,
)
from benchmarks.figures import machine

BENCHMARKS = {
    "codec": codec.run,
    "lockstep": lockstep.run,
    "streaming": streaming.run,
    "lanes": lanes.run,
    "estimators": estimators.run,
    "links": links.run,
    "realtime": realtime.run,
    "timeline": timeline.run,
    "recovery": recovery.run,
    "journal": journal.run,
    "fidelity": fidelity.run,
}


def main() -> int:
    options = argparse.ArgumentParser(prog="python -m benchmarks", description="Performance of the testbed.")
    options.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(BENCHMARKS)}; default: all")
    options.add_argument("--quick", action="store_true", help="fewer and shorter repetitions: a rough idea")
    options.add_argument("--json", type=Path, metavar="FILE", help="write the figures, with machine and versions")
    options.add_argument("--seconds", type=float, metavar="S", help="fidelity: length of a cell; default: 300")
    options.add_argument("--cells", nargs="+", metavar="PATTERN", help="fidelity: only these, such as 'tcp 10 ms*'")
    given = options.parse_args()
    for name in given.names:
        if name not in BENCHMARKS:
            options.error(f"no benchmark {name!r}; there are: {', '.join(BENCHMARKS)}")
    if "fidelity" not in (given.names or BENCHMARKS) and (given.seconds is not None or given.cells is not None):
        options.error("--seconds and --cells are for fidelity")
    if given.seconds is not None and not 1 <= given.seconds <= 86400:
        options.error(f"--seconds: got {given.seconds:g}; allowed: 1 … 86400")
    if given.cells is not None and (wrong := fidelity.unmatched(given.cells)) is not None:
        options.error(f"no cell {wrong!r}; there are: {', '.join(fidelity.names())}")
    runs = BENCHMARKS | {"fidelity": partial(fidelity.run, seconds=given.seconds, cells=given.cells)}
    console, found = Console(width=None if sys.stdout.isatty() else 150), {}
    about = machine()
    console.print(", ".join(f"{key} {value}" for key, value in about.items()), highlight=False)
    for name in given.names or BENCHMARKS:
        figures = runs[name](quick=given.quick)
        figures.print(console)
        found[name] = figures.to_json()
    if given.json is not None:
        given.json.write_text(json.dumps({"machine": about, "quick": given.quick, "benchmarks": found}, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
