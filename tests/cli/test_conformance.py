"""``testbed conformance``: what it prints, its exit codes, and what it says of wrong use."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from cli.commands import Command, testbed
from testbed.conformance.kit import CHECKS

__all__ = ["testbed"]

SCALED = """
from testbed.estimator.aoe import Aoe

class Scaled:
    def __init__(self, model, lanes, scale: float = 1.0):
        self.inner, self.scale = Aoe(model, lanes), scale
        self.counters = self.inner.counters

    def step(self, u, y, arrived, acks=()):
        out = self.inner.step(u, y, arrived, acks)
        out.p = [[self.scale * entry for entry in row] for row in out.p]
        return out

number = 3
"""


@pytest.fixture(autouse=True)
def module(tmp_path: Path) -> Iterator[str]:
    """A module in the working folder, forgotten afterwards."""
    (tmp_path / "scaled_estimator.py").write_text(SCALED)
    (tmp_path / "broken_module.py").write_text("raise ValueError('two\\nlines')\n")
    (tmp_path / "needy_module.py").write_text("import absent_package\n")
    path = list(sys.path)
    yield "scaled_estimator"
    assert sys.path == path
    for name in ("scaled_estimator", "broken_module", "needy_module"):
        sys.modules.pop(name, None)


def test_one_that_conforms(testbed: Command) -> None:
    shown = testbed("conformance", "scaled_estimator:Scaled")
    assert (shown.code, shown.err) == (0, "")
    for check in CHECKS:
        assert f"\n{check.__name__} " in shown.out
    assert shown.out.endswith("scaled_estimator:Scaled: 17 passed, 0 failed, 3 skipped, 0 not claimed\n")


def test_one_that_does_not(testbed: Command) -> None:
    shown = testbed("conformance", "scaled_estimator:Scaled", "--option", "scale=0.25", "--json")
    assert (shown.code, shown.err) == (1, "")
    report = json.loads(shown.out)
    assert (report["estimator"], report["conforms"]) == ("scaled_estimator:Scaled", False)
    failed = {check["name"] for check in report["checks"] if check["status"] == "failed"}
    assert failed == {"kfio_with_acks", "ack_bound", "consistency", "long_losses"}
    assert (report["passed"], report["failed"], report["skipped"], report["not_claimed"]) == (13, 4, 3, 0)
    text = testbed("conformance", "scaled_estimator:Scaled", "--option", "scale=0.25")
    assert text.code == 1
    assert "wanted: " in text.out


def test_a_kind_with_its_options(testbed: Command) -> None:
    shown = testbed("conformance", "gpb", "--option", "order=1", "--json")
    assert (shown.code, json.loads(shown.out)["conforms"]) == (0, True)


def test_what_is_registered_is_said(testbed: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    info = tmp_path / "scaled-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: scaled\nVersion: 1.0\n")
    points = "[testbed.estimators]\nscaled = scaled_estimator:Scaled\n"
    (info / "entry_points.txt").write_text(points)
    for name in ("scaled_estimator:Scaled", "scaled"):
        report = json.loads(testbed("conformance", name, "--json").out)
        (check,) = (check for check in report["checks"] if check["name"] == "entry_point")
        assert (check["status"], check["text"]) == ("passed", "registered as 'scaled'")
    (info / "entry_points.txt").write_text(points.replace("scaled =", "kfio ="))
    report = json.loads(testbed("conformance", "scaled_estimator:Scaled", "--json").out)
    assert report["checks"][-1]["text"] == "it is registered as 'kfio', which is the name of a built-in one"


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([], "Missing argument 'MODULE:OBJECT'"),
        (["kfi"], "kfi: no such estimator; allowed: MODULE:OBJECT, or aoe, "),
        (["scaled_estimatr:Scaled"], "scaled_estimatr:Scaled: no module 'scaled_estimatr'; did you mean 'scaled_esti"),
        (
            ["testbed.estimator.aeo:Aoe"],
            "testbed.estimator.aeo:Aoe: no module 'testbed.estimator.aeo'; did you mean 'aoe'",
        ),
        (["scaled_estimator:Scale"], "scaled_estimator:Scale: scaled_estimator has no 'Scale'; did you mean 'Scaled'?"),
        (["scaled_estimator:"], "scaled_estimator:: scaled_estimator has no ''"),
        ([":Scaled"], ":Scaled: allowed: MODULE:OBJECT"),
        (["scaled_estimator:number"], "scaled_estimator:number: is a int; allowed: what is called with (model, lanes)"),
        (["broken_module:X"], "broken_module:X: cannot be imported: ValueError: two lines"),
        (["needy_module:X"], "needy_module:X: cannot be imported: No module named 'absent_package'"),
        (
            ["scaled_estimator:Scaled", "--option", "scal=1"],
            "estimator 'scaled_estimator:Scaled': unknown option 'scal'",
        ),
        (["scaled_estimator:Scaled", "--option", "scale=x"], "estimator 'scaled_estimator:Scaled': scale: got 'x'; "),
        (["scaled_estimator:Scaled", "--option", "scale"], "--option scale: allowed: NAME=VALUE"),
    ],
)
def test_wrong_use_is_said_in_one_line(arguments: list[str], expected: str, testbed: Command) -> None:
    shown = testbed("conformance", *arguments)
    assert (shown.code, shown.out) == (2, "")
    assert shown.err.startswith(f"testbed: {expected}")
    assert len(shown.err.splitlines()) == 1
