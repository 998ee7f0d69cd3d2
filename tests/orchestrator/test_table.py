import io
from pathlib import Path

import numpy as np
import pytest
from rich.cells import cell_len
from rich.console import Console

from orchestrator.fabricated_summary import estimator, fabricate
from testbed.orchestrator.table import end_table

RNG = np.random.default_rng(3)


def printed(summary, width=80):
    out = io.StringIO()
    Console(file=out, width=width, no_color=True).print(end_table(summary, Path("out/run-1")))
    return out.getvalue()


def test_figures_of_an_ordinary_run():
    output = printed(fabricate())
    row = next(line for line in output.splitlines() if line.startswith("kfio"))
    assert "perfect" in row
    assert "76–100" in row
    assert "±" in row
    assert "NEES [1.76, 2.25]" in output
    assert "100 steps, 256 lanes, seed 1" in output
    assert "Files: out/run-1" in output


def test_only_checks_that_are_not_ok_are_told():
    output = " ".join(printed(fabricate()).split())
    assert "not ok: finite variance: ρ(A)⁴" in output
    assert "books balance" not in output


def test_links():
    summary = fabricate()
    control = summary.links["control"]
    row = next(line for line in printed(summary).splitlines() if line.startswith("control"))
    assert row.replace("\u2009", "").split() == ["control", "25600", str(control.dropped), f"{control.loss_rate:.4f}"]


@pytest.mark.parametrize("width", [40, 80, 200])
def test_no_line_is_wider_than_the_terminal(width):
    names = {"a-rather-long-name-of-an-estimator": estimator(RNG, np.full(4, 1e9)), "b": estimator(RNG, np.ones(4))}
    for line in printed(fabricate(steps=4, estimators=names), width).splitlines():
        assert cell_len(line) <= width


def test_names_are_no_markup():
    names = {"[red]x[/red]": estimator(RNG, np.ones(4))}
    output = printed(fabricate(steps=4, name="[bold]n", estimators=names, rejected={"[a]": {"[b]": 2}}))
    for name in ("[red]x[/red]", "[bold]n", "rejected: [a]: 2 × [b]"):
        assert name in output


def test_a_run_that_failed_before_its_first_step():
    nothing = {"estimators": {"a": estimator(RNG, np.ones(0))}, "bounds": None, "links": {}, "checks": ()}
    output = printed(fabricate(steps=9, completed_steps=0, status="failed", reason="plant did not answer", **nothing))
    assert "failed after 0 of 9 steps" in output
    assert "plant did not answer" in output
    assert "none" in output


def test_figures_that_overflowed_are_told():
    names = {"wild": estimator(RNG, np.array([1.0, 1e300, np.inf, np.inf]))}
    assert "note: wild has no finite tr P at 2 of its steps" in printed(fabricate(steps=4, estimators=names))


def test_bands_that_differ_stand_in_their_rows():
    names = {"a": estimator(RNG, np.ones(4)), "b": estimator(RNG, np.ones(4), states=4)}
    assert printed(fabricate(steps=4, estimators=names)).count("[") == 3
