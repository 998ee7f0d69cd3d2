"""``python -m benchmarks [NAME …] [--quick] [--json FILE]``: run the benchmarks and print their tables."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from rich.console import Console

from benchmarks import codec, estimators, lanes, links, lockstep, realtime, streaming
from benchmarks.figures import machine

BENCHMARKS = {
    "codec": codec.run,
    "lockstep": lockstep.run,
    "streaming": streaming.run,
    "lanes": lanes.run,
    "estimators": estimators.run,
    "links": links.run,
    "realtime": realtime.run,
}


def main() -> int:
    options = argparse.ArgumentParser(prog="python -m benchmarks", description="Performance of the testbed.")
    options.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(BENCHMARKS)}; default: all")
    options.add_argument("--quick", action="store_true", help="fewer and shorter repetitions: a rough idea")
    options.add_argument("--json", type=Path, metavar="FILE", help="write the figures, with machine and versions")
    given = options.parse_args()
    for name in given.names:
        if name not in BENCHMARKS:
            options.error(f"no benchmark {name!r}; there are: {', '.join(BENCHMARKS)}")
    console, found = Console(width=None if sys.stdout.isatty() else 150), {}
    about = machine()
    console.print(", ".join(f"{key} {value}" for key, value in about.items()), highlight=False)
    for name in given.names or BENCHMARKS:
        figures = BENCHMARKS[name](quick=given.quick)
        figures.print(console)
        found[name] = figures.to_json()
    if given.json is not None:
        given.json.write_text(json.dumps({"machine": about, "quick": given.quick, "benchmarks": found}, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
