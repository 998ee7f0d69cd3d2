"""Wrong input: exit code 2 (or 1 for what fails on the way), nothing on standard output, one line on standard error."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from cli.commands import TABLES, Command, testbed, write

__all__ = ["testbed"]

SAMPLE = ["link", "sample", "s.toml", "--out", "t.csv"]
REPLAY = ["replay", "s.toml", "p.jsonl", "--estimator"]


def refused(testbed: Command, *arguments: object, code: int = 2) -> str:
    """The line of error."""
    shown = testbed(*arguments)
    assert shown.code == code
    assert shown.out == ""
    assert shown.err.startswith("testbed: ")
    assert shown.err.endswith("\n")
    (line,) = shown.err.splitlines()
    assert "Traceback" not in line
    return line.removeprefix("testbed: ")


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["rum"], "No such command 'rum'"),
        (["--colour"], "No such option: --colour"),
        (["run"], "Missing argument 'SCENARIO.toml'"),
        (["run", "s.toml", "--fast"], "No such option: --fast"),
        (["run", "s.toml", "again.toml"], "Got unexpected extra argument"),
        (["run", "s.toml", "--out"], "Option '--out' requires an argument"),
        (["run", "s.toml", "--in-process", "--external", "plant"], "--external needs processes"),
        (
            ["run", "s.toml", "--links", "relais"],
            "--links relais: no such backend; allowed: model, relay, kernel; did you",
        ),
        (["run", "s.toml", "--external", "plan"], "--external plan: no such role; allowed: controller, plant"),
        (["run", "absent.toml"], "absent.toml: no such file"),
        (["run", "."], ".: "),
        (["replay", "s.toml", "p.jsonl"], "Missing option '--estimator'"),
        (["replay", "absent.toml", "p.jsonl", "--estimator", "aoe"], "absent.toml: no such file"),
        ([*REPLAY, "kalman"], "unknown estimator 'kalman'"),
        ([*REPLAY, "aoe"], "cannot read p.jsonl: no such file or directory"),
        ([*REPLAY, "aoe", "--lane", "-1"], "Invalid value for '--lane'"),
        (["replay", "s.toml", "absent.mcap", "--estimator", "aoe"], "cannot read absent.mcap: no such file"),
        (["replay", "s.toml", ".", "--estimator", "aoe"], "cannot read .: is a directory"),
        (["replay", "s.toml", "s.toml", "--estimator", "aoe"], "s.toml: line 1: line: Invalid JSON"),
        (["link"], "Missing command"),
        (["link", "simple"], "No such command 'simple'"),
        ([*SAMPLE, "-n", "5"], "Missing option '--link'"),
        ([*SAMPLE, "--link", "control"], "Missing option '-n'"),
        (
            [*SAMPLE, "--link", "observations", "-n", "5"],
            "--link observations: no such link; allowed: control, observation, ack; did you mean 'observation'?",
        ),
        ([*SAMPLE, "--link", "ack", "-n", "5"], "--link ack: the scenario has none; allowed: with [links.ack]"),
        ([*SAMPLE, "--link", "control", "-n", "0"], "Invalid value for '-n'"),
        ([*SAMPLE, "--link", "control", "-n", "many"], "Invalid value for '-n'"),
        ([*SAMPLE, "--link", "control", "-n", "5", "--seed", "-1"], "Invalid value for '--seed'"),
        ([*SAMPLE, "--link", "control", "-n", "5", "--lane", str(2**31)], "--lane 2147483648: "),
        ([*SAMPLE, "--link", "control", "-n", "5", "--lane", str(10**40)], "--lane 1000"),
        (["link", "sample", "s.toml", "--link", "control", "-n", "5"], "Missing option '--out'"),
        (
            ["link", "sample", "s.toml", "--link", "control", "-n", "5", "--out", "s.toml/t"],
            "cannot write s.toml/t: not a directory",
        ),
        (["link", "sample", "s.toml", "--link", "control", "-n", "5", "--out", "."], "cannot write .: is a directory"),
        (
            ["schema", "scenery"],
            "unknown schema 'scenery'; allowed: scenario, messages, asyncapi, summary; did you mean 'scenario'?",
        ),
        (["schema", "yaml"], "unknown schema 'yaml'; allowed: scenario, messages, asyncapi, summary"),
        (["schema", "scenario", "messages"], "Got unexpected extra argument"),
    ],
)
def test_a_wrong_command_line(arguments: list[str], expected: str, testbed: Command) -> None:
    assert refused(testbed, *arguments).startswith(expected)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"stepps": 3}, "wrong.toml: unknown key 'stepps'; did you mean 'steps'?"),
        ({"steps": 0}, "wrong.toml: steps: got 0; allowed: an integer, 1 … "),
        (
            {"links": {"control": {"loss": {"kind": "bernoulli", "arrival": 1.5}}}},
            "wrong.toml: links.control.loss.arrival: got 1.5; allowed: 0 … 1",
        ),
        (
            {"links": {"control": {"loss": {"kind": "bernoully"}}}},
            "wrong.toml: links.control.loss.kind: got 'bernoully'; allowed: none, bernoulli, markov, gilbert-elliott, "
            "four-state, trace, scripted; did you mean",
        ),
        (
            {"links": {"control": {"los": {"kind": "none"}}}},
            "wrong.toml: links.control: unknown key 'los'; did you mean 'loss'?",
        ),
        ({"system": None}, "wrong.toml: system: missing"),
        ({"system": {**TABLES["system"], "A": [[1.0]]}}, "wrong.toml: system.B: got 2 × 1; allowed: 1 row"),
        ({"estimators": []}, "the scenario has no [[estimators]]"),
        (
            {"estimators": [{"name": "kalman"}]},
            "estimators.kalman: unknown estimator 'kalman'; "
            "allowed: aoe, ff, gpb, gpb1, gpb2, imm, kf, kfio, lmmse, oe, oe-exact, pf, rse, rseio, rsemm",
        ),
        ({"estimators": [{"name": "aoe", "depht": 1}]}, "estimators.aoe: estimator 'aoe': unknown option 'depht'"),
        (
            {"estimators": [{"name": "aoe", "untill": 1}]},
            "estimators.aoe: estimator 'aoe': unknown option 'untill'; allowed: none; did you mean 'until'?",
        ),
        ({"estimators": [{"name": "kfio"}]}, "estimators.kfio: kfio needs every ACK"),
        ({"estimators": [{"name": "oe-exact"}], "steps": 40}, "estimators.oe-exact: oe-exact enumerates 2^k histories"),
    ],
)
@pytest.mark.parametrize("how", [["--in-process"], []])
def test_a_wrong_scenario(
    how: list[str], changes: dict[str, Any], expected: str, testbed: Command, tmp_path: Path
) -> None:
    write(tmp_path / "wrong.toml", **changes)
    assert refused(testbed, "run", "wrong.toml", "--out", "out", *how).startswith(expected)
    assert not (tmp_path / "out").exists()


def test_a_scenario_that_is_not_toml(testbed: Command, tmp_path: Path) -> None:
    (tmp_path / "wrong.toml").write_text("steps = = 3\n")
    assert refused(testbed, "run", "wrong.toml").startswith("wrong.toml: not valid TOML")
    (tmp_path / "wrong.toml").write_bytes(b"\xff\xfe\x00")
    assert refused(testbed, "run", "wrong.toml").startswith("wrong.toml: ")


@pytest.mark.parametrize("how", [["--in-process"], []])
def test_a_folder_that_cannot_be_written(how: list[str], testbed: Command) -> None:
    assert (
        refused(testbed, "run", "s.toml", "--out", "s.toml/out", *how)
        == "cannot write into s.toml/out: not a directory"
    )
    assert refused(testbed, "run", "s.toml", "--out", "s.toml", *how).startswith("cannot write into s.toml: ")


def replayed(
    testbed: Command, tmp_path: Path, lines: list[dict[str, Any] | str], *arguments: str, code: int = 2
) -> str:
    (tmp_path / "p.jsonl").write_text(
        "".join((line if isinstance(line, str) else json.dumps(line)) + "\n" for line in lines)
    )
    return refused(testbed, *REPLAY, *(arguments or ("aoe",)), code=code)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("{", "p.jsonl: line 1: line: Invalid JSON"),
        ({"k": 2, "u": [1.0]}, "p.jsonl: line 1: k: got 2; allowed: 1"),
        ({"k": 1}, "p.jsonl: line 1: u: got 0 numbers; allowed: 1"),
        ({"k": 1, "u": [1.0], "y": [1.0, 2.0]}, "p.jsonl: line 1: y: got 2 numbers; allowed: 1, or null"),
        (
            {"k": 1, "u": [1.0], "acks": [[1, 1]]},
            "p.jsonl: line 1: acks: got control packet 1 at step 1; allowed: 0 … 0",
        ),
        ({"k": 1, "u": [1.0], "x": 1}, "p.jsonl: line 1: x: Extra inputs are not permitted"),
    ],
)
def test_a_wrong_line_of_packets(line: dict[str, Any] | str, expected: str, testbed: Command, tmp_path: Path) -> None:
    assert replayed(testbed, tmp_path, [line]).startswith(expected)


def test_lines_before_a_wrong_one_are_not_written_to_a_file(testbed: Command, tmp_path: Path) -> None:
    lines: list[dict[str, Any] | str] = [{"k": 1, "u": [1.0]}, {"k": 3, "u": [1.0]}]
    text = replayed(testbed, tmp_path, lines, "aoe", "--out", "o.jsonl")
    assert text.startswith("p.jsonl: line 2: k: got 3; allowed: 2")
    assert not (tmp_path / "o.jsonl").exists()


def test_what_an_estimator_refuses_on_the_way(testbed: Command, tmp_path: Path) -> None:
    text = replayed(testbed, tmp_path, [{"k": 1, "u": [1.0], "y": [1.0]}], "kfio", code=1)
    assert text.startswith("step 1: kfio needs the ACK of control packet 0")


def test_an_output_that_cannot_be_written(testbed: Command, tmp_path: Path) -> None:
    text = replayed(testbed, tmp_path, [{"k": 1, "u": [1.0]}], "aoe", "--out", "s.toml/o")
    assert text == "cannot write s.toml/o: not a directory"


def test_packets_that_are_not_text(testbed: Command, tmp_path: Path) -> None:
    (tmp_path / "p.jsonl").write_bytes(b"\xff\xfe\x00")
    assert refused(testbed, *REPLAY, "aoe") == "cannot read p.jsonl: not a text file"
    (tmp_path / "p.mcap").write_bytes(b"\xff\xfe\x00")
    text = refused(testbed, "replay", "s.toml", "p.mcap", "--estimator", "aoe")
    assert text.startswith("p.mcap: not a whole recording")


def test_an_option_of_an_estimator_that_is_wrong(testbed: Command, tmp_path: Path) -> None:
    write(tmp_path / "s.toml", estimators=[{"name": "oe", "max_histories": "many"}])
    text = replayed(testbed, tmp_path, [{"k": 1, "u": [1.0]}], "oe")
    assert text.startswith("estimator 'oe': max_histories: got 'many'; ")


def test_an_interruption_is_130_without_a_traceback(testbed: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("testbed.scenario.load_scenario", interrupted)
    shown = testbed("run", "s.toml", "--in-process")
    assert (shown.code, shown.out) == (130, "")
    assert "Traceback" not in shown.err
