"""``testbed link fit``: the tables, the JSON, and errors in one line."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import pytest

from cli.commands import Command, testbed, write

__all__ = ["testbed"]

LOSS = {"kind": "gilbert-elliott", "to_bad": 0.05, "to_good": 0.3, "loss_good": 0.02, "loss_bad": 0.8}


@pytest.fixture
def trace(testbed: Command, tmp_path: Path) -> Path:
    write(tmp_path / "s.toml", links={"observation": {"loss": LOSS}})
    testbed("link", "sample", "s.toml", "--link", "observation", "-n", 4000, "--out", "t.csv")
    return tmp_path / "t.csv"


def test_json_and_tables_say_the_same(testbed: Command, trace: Path) -> None:
    rows = trace.read_text().splitlines()
    seq, sent, _ = rows[1].split(",")
    trace.write_text("\n".join([*rows, f"{seq},{sent},{sent}"]) + "\n")
    given = testbed("link", "fit", "t.csv", "--json")
    assert (given.code, given.err) == (0, "")
    figures = json.loads(given.out)
    assert (figures["packets"], figures["duplicates"], figures["chosen"]) == (4000, 1, "gilbert-elliott")
    assert [model["kind"] for model in figures["models"]] == ["bernoulli", "markov", "gilbert-elliott", "four-state"]
    assert figures["lost"] == sum(row.endswith(",") for row in rows) - (rows[1].endswith(","))
    shown = testbed("link", "fit", "t.csv")
    assert (shown.code, shown.err) == (0, "")
    lines = shown.out.splitlines()
    assert lines[0] == f"t.csv: 4000 packets, {figures['lost']} lost, 1 duplicate"
    assert lines[-1] == figures["models"][2]["toml"]
    assert "gilbert-elliott has the least BIC" in shown.out
    for model in figures["models"]:
        assert f"{model['bic']:.2f}" in shown.out
        for parameter in model["parameters"]:
            if parameter["interval"] is None:
                assert parameter["note"]
                continue
            low, high = parameter["interval"]
            assert low <= parameter["value"] <= high
            assert f"{parameter['value']:.4g}" in shown.out
            assert f"{low:.4g} … {high:.4g}" in shown.out


def test_the_last_line_is_a_loss_of_a_scenario(testbed: Command, trace: Path, tmp_path: Path) -> None:
    line = testbed("link", "fit", "t.csv").out.splitlines()[-1]
    write(tmp_path / "again.toml", links={"observation": tomllib.loads(line)})
    again = testbed("link", "sample", "again.toml", "--link", "observation", "-n", 50, "--out", "u.csv")
    assert (again.code, again.err) == (0, "")


@pytest.mark.parametrize(
    ("rows", "error"),
    [
        (["1,2,3"] * 30, "testbed: t.csv: got 1 packet; allowed: 20 or more\n"),
        ([f"{k},{k},{k}" for k in range(300)], "the loss rate is at most 0.01 with 95 % confidence"),
        ([f"{k},{k}," for k in range(300)], "the arrival rate is at most 0.01 with 95 % confidence"),
        (["1;2;3"], "testbed: t.csv:2: got 1 field; allowed: 3\n"),
    ],
)
def test_what_cannot_be_fitted_is_one_line(testbed: Command, tmp_path: Path, rows: list[str], error: str) -> None:
    (tmp_path / "t.csv").write_text("\n".join(["seq,sent_ns,delivered_ns", *rows]) + "\n")
    refused = testbed("link", "fit", "t.csv")
    assert (refused.code, refused.out) == (2, "")
    assert error in refused.err
    assert refused.err.count("\n") == 1
