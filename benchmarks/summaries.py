"""``testbed run`` as a user runs it, and the summary that it writes."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from testbed.scenario import Scenario, to_toml


def summary_of(given: Scenario, *options: str) -> dict[str, Any]:
    """Run a scenario in processes of its own. Raises RuntimeError with what was said where the run fails."""
    with tempfile.TemporaryDirectory(prefix="testbed-benchmark-") as folder:
        path, out = Path(folder) / "scenario.toml", Path(folder) / "out"
        path.write_text(to_toml(given))
        command = [sys.executable, "-m", "testbed", "run", str(path), "--out", str(out), "--quiet", *options]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"the run failed: {done.stderr[-1500:]}")
        found: dict[str, Any] = json.loads((out / "summary.json").read_text())
    return found


def changed(given: Scenario, **tables: Any) -> Scenario:
    """The scenario with whole tables replaced; None: left out."""
    data = {**given.model_dump(mode="json", exclude_none=True), **tables}
    made: Scenario = Scenario.model_validate({key: value for key, value in data.items() if value is not None})
    return made
