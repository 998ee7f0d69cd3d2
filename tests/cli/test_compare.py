"""`testbed compare`: what it prints, writes and refuses."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from cli.commands import TABLES, Command, testbed
from orchestrator.runs import run
from testbed.scenario import parse_scenario

__all__ = ["testbed"]


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs one and two, which differ in a link, and other, of another seed."""
    out = tmp_path_factory.mktemp("runs")
    link = {"loss": {"kind": "bernoulli", "arrival": 0.9}}
    variants: dict[str, dict[str, Any]] = {"one": {}, "two": {"links": {"observation": link}}, "other": {"seed": 9}}
    for name, changes in variants.items():
        run(parse_scenario({**TABLES, **changes}), out / name)
    return out


@pytest.fixture
def runs(testbed: Command, folders: Path, monkeypatch: pytest.MonkeyPatch) -> Command:
    monkeypatch.chdir(folders)
    return testbed


def test_a_table(runs: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    shown = runs("compare", "one", "two")
    assert (shown.code, shown.err) == (0, "")
    lines = shown.out.splitlines()
    assert lines[0] == "tr P, mean over steps; 3 lanes"
    assert lines[1].split() == [
        "a",
        "b",
        "steps",
        "a",
        "−",
        "b",
        "95",
        "%",
        "interval",
        "a",
        "/",
        "b",
        "a",
        "<",
        "b",
        "p",
    ]
    assert lines[2].startswith("one/aoe ")
    assert "two/aoe" in lines[2]
    assert "10–12" in lines[2]
    assert lines[3].split()[0] == "BCa"
    assert "note: one, two: the noise is the same; what differs: links.control.loss," in shown.out
    assert max(map(len, lines)) <= 80


def test_json_and_a_page(runs: Command, folders: Path) -> None:
    shown = runs("compare", "one", "two", "--figure", "nees", "--whole", "--json", "--report", "page.html")
    found = json.loads(shown.out)
    assert (found["figure"], found["level"], found["lanes"]) == ("nees", 0.95, 3)
    assert [(pair["a"], pair["b"]) for pair in found["pairs"]] == [
        ({"run": "one", "estimator": name}, {"run": "two", "estimator": name}) for name in ("aoe", "kfio")
    ]
    pair = found["pairs"][0]
    assert (pair["steps"], pair["method"], pair["number"]) == ([1, 12], "paired t", 3)
    low, high = pair["interval"]
    assert low < pair["difference"] < high
    assert pair["difference"] == pytest.approx(pair["mean_a"] - pair["mean_b"])
    assert "one/aoe" in (folders / "page.html").read_text()


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([], "Missing argument 'RUN…'"),
        (["absent"], "absent: no such folder; allowed: the folder of a run that is over"),
        (["."], ".: no summary.json in it; allowed: the folder of a run that is over"),
        (["one", "one"], "one: given twice; allowed: each run once"),
        (["one", "other"], "one, other: not the same lanes: seed (5, 9) differs; allowed: the same, or --unpaired"),
        (["one", "--figure", "ness"], "--figure ness: no such figure; allowed: trace_P, squared_error, nees; did you"),
        (["one", "--against", "kfoi"], "--against kfoi: no such estimator; allowed: aoe, kfio; did you mean 'kfio'?"),
        (["one", "--report", "absent/page.html"], "cannot write absent/page.html: no such file or directory"),
    ],
)
def test_refusals(arguments: list[str], expected: str, runs: Command) -> None:
    shown = runs("compare", *arguments)
    assert (shown.code, shown.out) == (2, "")
    (line,) = shown.err.splitlines()
    assert line.startswith(f"testbed: {expected}")
