"""Scenarios that are made in Python, from plain tables."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import testbed
from testbed import Scenario, UsageError, load_scenario
from testbed.scenario import parse_scenario, to_toml

SYSTEM: dict[str, Any] = {
    "A": [[0.9, 0.1], [-0.1, 0.8]],
    "B": [[-1.0], [1.0]],
    "C": [[0.0, 1.0]],
    "Q": [[1.0, 0.0], [0.0, 2.0]],
    "R": [[1.0]],
}


def test_keywords_are_the_tables_of_the_file(tmp_path: Path) -> None:
    links = {"control": {"loss": {"kind": "bernoulli", "loss": 0.2}}, "observation": {"preset": "airline-wifi"}}
    made = Scenario(name="a", steps=9, system=SYSTEM, links=links, estimators=[{"name": "aoe"}])
    assert made == parse_scenario(
        {"name": "a", "steps": 9, "system": SYSTEM, "links": links, "estimators": [{"name": "aoe"}]}
    )
    (tmp_path / "scenario.toml").write_text(to_toml(made))
    assert load_scenario(tmp_path / "scenario.toml") == made
    assert Scenario(steps=9, name="a", system=made.system, links=made.links, estimators=made.estimators) == made


def test_numbers_and_arrays_of_numpy_are_taken() -> None:
    arrays = {key: np.array(value) for key, value in SYSTEM.items()}
    loss = {"kind": "bernoulli", "arrival": np.float64(0.8)}
    made = Scenario(steps=np.int64(9), system=arrays, links={"control": {"loss": loss}})
    plain = Scenario(steps=9, system=SYSTEM, links={"control": {"loss": {"kind": "bernoulli", "arrival": 0.8}}})
    assert made == plain


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({}, "system: missing; needed: The system"),
        ({"stesp": 3}, "unknown key 'stesp'; did you mean 'steps'?"),
        ({"system": {**SYSTEM, "A": 1.0}}, "system.A: got 1.0; allowed: nested arrays"),
        ({"links": {"control": {"preset": "nowhere"}}}, "links.control.preset: got 'nowhere'"),
        ({"input": {"kind": "table", "file": "none.csv"}}, "input.file: none.csv: no such file"),
        ({"estimators": {"name": "aoe"}}, "estimators: got a table; allowed: an array of tables"),
    ],
)
def test_errors_are_one_line(wrong: dict[str, Any], text: str) -> None:
    with pytest.raises(UsageError) as refused:
        Scenario(**({"system": SYSTEM, **wrong} if wrong else {}))
    assert str(refused.value).startswith(text)
    assert "\n" not in str(refused.value)


def test_names_at_the_top_are_loaded_when_they_are_asked_for() -> None:
    code = (
        "import sys, testbed; print(sorted(m for m in sys.modules if m.startswith(('testbed.', 'numpy', 'pydantic'))))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
    for name in testbed.__all__:
        assert getattr(testbed, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'scenaro'"):
        _ = testbed.scenaro  # type: ignore[attr-defined]
