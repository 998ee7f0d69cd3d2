"""What the commands do, print and leave behind."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from jsonschema import Draft202012Validator

from cli.commands import TABLES, Command, testbed, write
from orchestrator.cutting import cut_run
from testbed import __version__
from testbed.estimator.registry import create, model_of
from testbed.scenario import load_scenario, parse_scenario, scenario_json_schema, to_dict

__all__ = ["testbed"]


@pytest.fixture
def no_report() -> object:
    """Drawing the report takes seconds."""
    with patch("testbed.orchestrator.report.write_report") as writing:
        yield writing


def test_help_and_version(testbed: Command) -> None:
    for arguments in ((), ("--help",)):
        shown = testbed(*arguments)
        assert (shown.code, shown.err) == (0, "")
        for name in ("run", "analyze", "replay", "schema", "link"):
            assert name in shown.out
    assert testbed("--version").out == f"testbed {__version__}\n"
    for command in ("run", "analyze", "replay", "schema", "link"):
        assert testbed(command, "--help").code == 0


def test_a_run_leaves_its_files_and_prints_tables(testbed: Command, tmp_path: Path) -> None:
    shown = testbed("run", "s.toml", "--in-process", "--out", "out")
    assert shown.code == 0
    assert shown.err == ""
    assert "small: 12 steps, 3 lanes, seed 5" in shown.out
    files = {path.name for path in (tmp_path / "out").iterdir()}
    assert files == {"scenario.toml", "summary.json", "lanes.npz", "recording.mcap", "report.html"}
    assert load_scenario(tmp_path / "out" / "scenario.toml") == load_scenario(tmp_path / "s.toml")


def test_json_is_the_summary(testbed: Command, tmp_path: Path, no_report: object) -> None:
    shown = testbed("run", "s.toml", "--in-process", "--json", "--out", "out")
    assert shown.code == 0
    assert shown.out == (tmp_path / "out" / "summary.json").read_text()
    summary = json.loads(shown.out)
    assert (summary["status"], summary["completed_steps"], summary["version"]) == ("complete", 12, 1)
    assert list(summary["estimators"]) == ["aoe", "kfio"]
    assert all(len(summary["estimators"]["aoe"][key]) == 12 for key in ("trace_P_mean", "nees_stderr"))
    Draft202012Validator(json.loads(testbed("schema", "summary").out)).validate(summary)


def test_without_out_a_run_goes_into_a_folder_of_its_own(testbed: Command, tmp_path: Path, no_report: object) -> None:
    write(tmp_path / "odd.toml", name="a/b c", record="none", lanes=1)
    assert testbed("run", "odd.toml", "--in-process", "-q").code == 0
    (made,) = (tmp_path / "runs").iterdir()
    assert made.name.startswith("a-b-c-")
    assert (made / "summary.json").exists()


def test_a_run_that_fails_says_so_and_keeps_what_there_is(testbed: Command, tmp_path: Path, no_report: object) -> None:
    system = {"A": [[1e100]], "C": [[1.0]], "Q": [[1.0]], "R": [[1.0]]}
    lost = {"observation": {"loss": {"kind": "bernoulli", "arrival": 0.0}}}
    write(tmp_path / "wild.toml", system=system, input=None, links=lost, estimators=[{"name": "kfio"}])
    shown = testbed("run", "wild.toml", "--in-process", "--json", "--out", "out")
    assert shown.code == 1
    assert json.loads(shown.out)["status"] == "failed"
    assert shown.err.startswith("testbed: run failed: ")
    assert len(shown.err.splitlines()) == 1


def test_the_scenarios_that_come_with_it_run(testbed: Command, tmp_path: Path, no_report: object) -> None:
    given = sorted((Path(__file__).parents[2] / "scenarios").glob("*.toml"))
    assert given
    for file in given:
        small = {"input": None, **to_dict(load_scenario(file)), "steps": 6, "lanes": 2, "events": []}
        for spec in small["estimators"]:
            spec.pop("until", None)
        write(tmp_path / file.name, **small)
        assert testbed("run", file.name, "--in-process", "--out", f"out-{file.stem}").code == 0


def test_replay_gives_the_estimates_of_the_run(testbed: Command, tmp_path: Path, no_report: object) -> None:
    write(tmp_path / "s.toml", record="all")
    testbed("run", "s.toml", "--in-process", "--out", "out")
    printed = testbed("replay", "s.toml", "out/recording.mcap", "--estimator", "kfio", "--lane", 2)
    assert (printed.code, printed.err) == (0, "")
    written = testbed("replay", "s.toml", "out/recording.mcap", "--estimator", "kfio", "--lane", 2, "--out", "o.jsonl")
    assert (written.code, written.out) == (0, "")
    assert (tmp_path / "o.jsonl").read_text() == printed.out
    assert testbed("replay", "s.toml", "out/recording.mcap", "--estimator", "kfio").out != printed.out
    lines = [json.loads(line) for line in printed.out.splitlines()]
    assert [line["k"] for line in lines] == list(range(1, 13))
    assert np.shape([line["P"] for line in lines]) == (12, 2, 2)


PACKETS = [
    {"k": 1, "u": [1.0], "y": [0.5], "acks": [[0, 1]]},
    {"k": 2, "u": [1.0], "y": None, "acks": [[1, 0]]},
    {"k": 3, "u": [1.0], "y": [2.0], "acks": [[2, 1]]},
]


def test_replay_reads_packets_of_any_origin(testbed: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import io
    import sys

    text = "".join(json.dumps(packet) + "\n" for packet in PACKETS)
    (tmp_path / "p.jsonl").write_text(text)
    model = model_of(parse_scenario(TABLES))
    for name in ("kfio", "oe", "ff"):  # oe and ff are kinds that the scenario does not name
        shown = testbed("replay", "s.toml", "p.jsonl", "--estimator", name)
        assert shown.code == 0
        monkeypatch.setattr(sys, "stdin", io.StringIO(text))
        assert testbed("replay", "s.toml", "-", "--estimator", name).out == shown.out
        made = create(name, model, lanes=1)
        for line, packet in zip(shown.out.splitlines(), PACKETS, strict=True):
            from testbed.estimator.model import Ack

            acks = tuple(Ack(j, np.array([nu]), np.ones(1)) for j, nu in packet["acks"])  # type: ignore[attr-defined]
            y = packet["y"] or [0.0]
            expected = made.step(np.array([packet["u"]]), np.array([y]), np.array([packet["y"] is not None]), acks)
            assert json.loads(line)["x_hat"] == expected.x_hat[0].tolist()


def test_replay_leaves_acks_out_where_the_table_says_none(testbed: Command, tmp_path: Path) -> None:
    write(tmp_path / "s.toml", estimators=[{"name": "aoe"}, {"name": "blind", "kind": "aoe", "acks": "none"}])
    with_acks, without = tmp_path / "with.jsonl", tmp_path / "without.jsonl"
    with_acks.write_text("".join(json.dumps(packet) + "\n" for packet in PACKETS))
    without.write_text("".join(json.dumps({**packet, "acks": []}) + "\n" for packet in PACKETS))
    blind = testbed("replay", "s.toml", "with.jsonl", "--estimator", "blind").out
    assert blind == testbed("replay", "s.toml", "without.jsonl", "--estimator", "aoe").out
    assert blind != testbed("replay", "s.toml", "with.jsonl", "--estimator", "aoe").out


def test_replay_tells_of_acks_that_came_too_late(testbed: Command, tmp_path: Path) -> None:
    late = [{"k": 1, "u": [1.0]}, {"k": 2, "u": [1.0], "acks": [[0, 1]]}]
    (tmp_path / "p.jsonl").write_text("".join(json.dumps(packet) + "\n" for packet in late))
    shown = testbed("replay", "s.toml", "p.jsonl", "--estimator", "aoe")
    assert shown.code == 0
    assert shown.err == "testbed: aoe: late_acks 1\n"


@pytest.mark.parametrize("seed", [None, 5, 6])
def test_a_sample_is_what_a_run_with_that_seed_meets(
    seed: int | None, testbed: Command, tmp_path: Path, no_report: object
) -> None:
    arguments = [] if seed is None else ["--seed", seed]
    shown = testbed(
        "link",
        "sample",
        "s.toml",
        "--link",
        "observation",
        "-n",
        12,
        "--out",
        "t.csv",
        "--lane",
        1,
        "--json",
        *arguments,
    )
    assert (shown.code, shown.err) == (0, "")
    with (tmp_path / "t.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["seq"]) for row in rows] == list(range(12))
    fates = [row["delivered_ns"] != "" for row in rows]
    figures = json.loads(shown.out)
    assert (figures["sent"], figures["delivered"], figures["dropped"]) == (12, sum(fates), 12 - sum(fates))

    from orchestrator.runs import recorded

    write(tmp_path / "s.toml", seed=5 if seed is None else seed, record="all")
    testbed("run", "s.toml", "--in-process", "--out", "out")
    mask = recorded(tmp_path / "out", 3, 12)["observation/delivered"]["mask"]
    assert fates == [bool(bit) for bit in mask[:, 1]]


def test_a_sample_in_words(testbed: Command) -> None:
    shown = testbed("link", "sample", "s.toml", "--link", "control", "-n", 2000, "--out", "t.csv")
    assert shown.code == 0
    assert shown.out.startswith("control: 2000 sent, ")
    assert "(expected 0.3)" in shown.out
    assert len(shown.out.splitlines()) == 1


def test_analyze_prints_figures_as_json(testbed: Command) -> None:
    shown = testbed("analyze", "s.toml", "--json")
    assert (shown.code, shown.err) == (0, "")
    figures = json.loads(shown.out)
    assert figures["spectral_radius"] == pytest.approx(1.1)
    assert figures["critical_arrival"]["exact"] == pytest.approx(1 - 1 / 1.21)
    assert figures["observation"]["stationary_loss"] == pytest.approx(2 / 9)
    assert figures["observation"]["mean_burst"] == pytest.approx(1 / 0.7)
    assert (figures["observation"]["stable"], figures["control"]["stable"]) == (True, True)


def test_analyze_for_a_person(testbed: Command, tmp_path: Path) -> None:
    shown = testbed("analyze", "s.toml")
    assert (shown.code, shown.err) == (0, "")
    for text in ("small", "spectral radius", "P Lemma 5", "stable", "D Theorem 2", "no: fails at 0.7"):
        assert text in shown.out
    assert max(map(len, shown.out.splitlines())) <= 80
    system = {"A": [[0.0, 1.3, 0.0], [-1.3, 0.0, 0.0], [0.0, 0.0, 1.1]], "C": [[1.0, 0.0, 0.0]], "R": [[1.0]]}
    system["Q"] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    write(tmp_path / "[b]odd.toml", name="[b]odd", system=system, input=None, links=None)
    odd = testbed("analyze", "[b]odd.toml")
    assert odd.code == 0
    assert odd.out.startswith("[b]odd\n")
    assert "no: fails at 1.1" in odd.out
    assert "unstable" in odd.out


def test_analyze_leaves_nothing_out_for_a_person(testbed: Command, tmp_path: Path) -> None:
    """Every figure and verdict has its line, those of RSEIO too; a scenario without model error has none of them."""
    common = ("controllable", "observable", "critical arrival rate", "its bounds", "critical recovery rate")
    common += ("strongly observable", "observability index I0", "observation link", "control link")
    common += ("its bursts of losses", "its runs of deliveries", "peak, condition (i)", "peak, condition (ii)")
    common += ("peak, d_1, d_2, …", "peak, series", "peak, largest failure rate", "order of finite moments")
    common += ("observation losses", "control losses", "lower bound", "upper bound", "peak covariance", "convergence")
    shown = testbed("analyze", "s.toml")
    assert [text for text in common if text not in shown.out] == []
    assert "0.7 · 0.3^(l−1), mean 1.42857, 99 % at most 4" in shown.out
    assert "rseio" not in shown.out
    robust = {"dA": [[[0.1, 0.0], [0.0, 0.0]]], "delta": 1.0}
    rseio = [{"name": "mine", "kind": "rseio", "mu": 0.5}]
    system = {**TABLES["system"], "C": [[1.0, 0.0]]}
    write(tmp_path / "r.toml", system=system, uncertainty=robust, estimators=rseio, bounds=False, links=None)
    shown = testbed("analyze", "r.toml")
    assert (shown.code, shown.err) == (0, "")
    common = ("mine forgets P_0", "R Theorem 5", "mine, mu = 0.5", "pairs observable", "pairs controllable", "arrivals")
    common += ("rank of O_b", "rank of C_n", "contraction of δ", "over 8 steps", "δ from P_0", "trace without losses")
    assert [text for text in (*common, "approached as") if text not in shown.out] == []
    assert max(map(len, shown.out.splitlines())) <= 80
    write(tmp_path / "r.toml", uncertainty=robust, estimators=[{"name": "rseio", "nu": 0.5}], links=None)
    shown = testbed("analyze", "r.toml")
    assert (shown.code, shown.out, len(shown.err.splitlines())) == (2, "", 1)
    assert "estimators.rseio: estimator 'rseio': unknown option 'nu'; allowed: mu" in shown.err


def test_analyze_refuses_as_every_command(testbed: Command) -> None:
    shown = testbed("analyze", "none.toml")
    assert (shown.code, shown.out) == (2, "")
    assert shown.err == "testbed: none.toml: no such file\n"


@pytest.mark.parametrize("what", ["scenario", "messages", "summary"])
def test_schemas_are_schemas(what: str, testbed: Command) -> None:
    shown = testbed("schema", what)
    assert (shown.code, shown.err) == (0, "")
    Draft202012Validator.check_schema(json.loads(shown.out))


def test_the_schema_of_the_scenario_is_the_default(testbed: Command) -> None:
    shown = testbed("schema")
    assert shown.out == testbed("schema", "scenario").out
    assert json.loads(shown.out) == scenario_json_schema()


def test_scenarios_are_valid_by_their_schema(testbed: Command, tmp_path: Path) -> None:
    schema = Draft202012Validator(json.loads(testbed("schema").out))
    schema.validate(TABLES)
    schema.validate(to_dict(load_scenario(tmp_path / "s.toml")))
    for file in (Path(__file__).parents[2] / "scenarios").glob("*.toml"):
        import tomllib

        schema.validate(tomllib.loads(file.read_text()))
        schema.validate(to_dict(load_scenario(file)))
    assert not schema.is_valid({**TABLES, "step": 3})


def test_asyncapi_is_an_asyncapi_document(testbed: Command) -> None:
    document = json.loads(testbed("schema", "asyncapi").out)
    assert document["asyncapi"] == "3.0.0"
    assert set(document) >= {"info", "channels", "components"}


RESUMABLE = {"record": "none", "recovery": {"journal": True, "every": 2}, "clock": {"window": 2}}


def test_a_run_that_was_cut_off_is_resumed(testbed: Command, tmp_path: Path, no_report: object) -> None:
    write(tmp_path / "s.toml", **RESUMABLE)
    assert testbed("run", "s.toml", "--in-process", "--json", "--out", "plain").code == 0
    assert cut_run(load_scenario(tmp_path / "s.toml"), tmp_path / "cut", 120, tmp_path / "left", settled=True)
    shown = testbed("resume", "left", "--in-process", "--json", "-q")
    assert shown.code == 0
    (line,) = shown.err.splitlines()
    assert re.fullmatch(r"resuming after step [1-9]\d* of 12", line)
    plain, again = json.loads((tmp_path / "plain" / "summary.json").read_text()), json.loads(shown.out)
    assert again["estimators"] == plain["estimators"]
    assert [entry["role"] for entry in again["recovered"]] == ["orchestrator"]


def test_what_is_damaged_is_said_and_what_it_means(testbed: Command, tmp_path: Path, no_report: object) -> None:
    write(tmp_path / "s.toml", **RESUMABLE)
    assert cut_run(load_scenario(tmp_path / "s.toml"), tmp_path / "cut", 120, tmp_path / "left", settled=True)
    damaged = list((tmp_path / "left" / "journal").glob("checkpoint-*.bin"))
    for path in damaged:
        path.write_bytes(path.read_bytes()[:-1])
    shown = testbed("resume", "left", "--in-process", "-q")
    assert shown.code == 0
    *lines, last = shown.err.splitlines()
    assert len(lines) == len(damaged) > 0
    assert all(line.startswith("damaged: left/journal/checkpoint-") for line in lines)
    assert last == "beginning anew: there is no checkpoint of it"


@pytest.mark.parametrize("folder", ["nowhere", "empty", "s.toml", "plain", "external"])
def test_what_cannot_be_resumed(folder: str, testbed: Command, tmp_path: Path, no_report: object) -> None:
    (tmp_path / "empty").mkdir()
    write(tmp_path / "s.toml", **RESUMABLE)
    if folder == "plain":
        assert testbed("run", "s.toml", "--in-process", "--out", "plain").code == 0
    if folder == "external":
        assert cut_run(load_scenario(tmp_path / "s.toml"), tmp_path / "cut", 120, tmp_path / folder, settled=True)
        begin = tmp_path / folder / "journal" / "begin.json"
        begin.write_text(begin.read_text().replace('"external": []', '"external": ["estimator.aoe"]'))
    shown = testbed("resume", folder, "--in-process", "-q")
    text = {
        "plain": "plain: its run is complete; allowed: the folder of a run that was not finished",
        "external": "estimator.aoe: started by hand in this run; allowed: to go on over processes",
    }.get(folder, f"{folder}: no run to be resumed; allowed: the folder of a run that was not finished")
    assert (shown.code, shown.out, shown.err.splitlines()[-1]) == (2, "", f"testbed: {text}")
