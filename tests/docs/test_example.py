"""examples/print_estimates.py against a real run."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from docs.blocks import ROOT
from processes.running import finish, free_port, start, summary_of, write_scenario

STEPS = 40
LINE = re.compile(r"estimator\.(\w+) k=(\d+) x_hat=\[(.*)\] tr_P=(.*)")


@pytest.mark.processes
def test_the_example_prints_every_estimate_of_the_first_lane(tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    scenario = write_scenario(tmp_path, steps=STEPS)
    scenario.write_text(scenario.read_text() + f'[transport]\nendpoint = "{endpoint}"\n')
    example = subprocess.Popen(
        [sys.executable, str(ROOT / "examples" / "print_estimates.py"), endpoint],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        code, _, err = finish(start(scenario, tmp_path / "out"))
        assert code == 0, err
        printed, errors = example.communicate(timeout=30)
    finally:
        example.kill()
    assert (example.returncode, errors) == (0, "")
    found = [LINE.fullmatch(line) for line in printed.splitlines()]
    assert all(found), printed
    traces = {(m[1], int(m[2])): float(m[4]) for m in found if m}
    figures = summary_of(tmp_path / "out")["estimators"]
    expected = {(name, k): figures[name]["trace_P_mean"][k - 1] for name in figures for k in range(1, STEPS + 1)}
    assert traces == pytest.approx(expected, rel=1e-5)
    assert all(len(m[3].split()) == 2 for m in found if m)
