"""Runs over zenoh with a process a role."""

from __future__ import annotations

import os
import shlex
import subprocess
from pathlib import Path

import pytest
import trustme

from processes.running import ESTIMATORS, children_of, figures_of, finish, free_port, start, summary_of, wait_for
from processes.running import write_scenario as write
from testbed.orchestrator.run import Run
from testbed.scenario import load_scenario

pytestmark = pytest.mark.processes
WITH_OE = ESTIMATORS + '[[estimators]]\nname = "oe"\nuntil = 8\n'


def test_figures_are_the_same_to_the_bit_over_zenoh_and_in_process_and_for_any_split(tmp_path: Path) -> None:
    ways = {"a": "", "b": "", "split": "[transport]\nlanes_per_packet = 5", "window": "[clock]\nwindow = 1"}
    for way, head in ways.items():
        code, _, err = finish(start(write(tmp_path, steps=40, lanes=12, head=head, tail=WITH_OE), tmp_path / way))
        assert code == 0, err
    scenario = write(tmp_path, steps=40, lanes=12, tail=WITH_OE)
    code, _, err = finish(start(scenario, tmp_path / "in-process", "--in-process"))
    assert code == 0, err
    expected = figures_of(tmp_path / "a")
    assert expected["estimators"]["oe"]["trace_P_mean"][7] > 0
    for way in ("b", "split", "window", "in-process"):
        assert figures_of(tmp_path / way) == expected, way


def test_every_role_is_a_process_of_its_own(tmp_path: Path) -> None:
    process = start(write(tmp_path, steps=30_000), tmp_path / "out")

    def roles() -> dict[int, str] | None:
        found = {pid: command for pid, command in children_of(process.pid).items() if "--connect" in command}
        return found if len(found) == 7 else None

    commands = wait_for(roles)
    process.terminate()
    finish(process)
    links = ("--link control", "--link observation")
    parts = ("testbed.control", "plant --", *links, "bounds", "--name aoe", "--name kfio")
    for part in parts:
        assert sum(part in command for command in commands.values()) == 1, part


def test_a_closed_loop_follows_the_estimate(tmp_path: Path) -> None:
    loop = write(tmp_path, steps=60, lanes=3)
    text = loop.read_text()
    begin, end = text.index("[input]"), text.index("[links.observation]")
    loop.write_text(text[:begin] + '[input]\nkind = "feedback"\ngain = [[0.1, 0.4]]\nestimator = "aoe"\n' + text[end:])
    code, _, err = finish(start(loop, tmp_path / "out"))
    assert code == 0, err
    Run(load_scenario(loop), tmp_path / "in-process").in_process()
    assert figures_of(tmp_path / "out") == figures_of(tmp_path / "in-process")
    assert summary_of(tmp_path / "out")["bounds"]["upper_mean"] is None


def test_a_role_started_by_hand_joins(tmp_path: Path) -> None:
    process = start(write(tmp_path, steps=30), tmp_path / "out", "--external", "estimator.aoe")
    assert process.stderr is not None
    line = process.stderr.readline()
    assert line.startswith("start estimator.aoe by hand: ")
    by_hand = subprocess.run(shlex.split(line.split(": ", 1)[1]), stdin=subprocess.DEVNULL, timeout=60, check=False)
    code, _, err = finish(process)
    assert (by_hand.returncode, code) == (0, 0), err
    assert summary_of(tmp_path / "out")["completed_steps"] == 30


@pytest.fixture
def certificates(tmp_path: Path) -> dict[str, Path]:
    authority = trustme.CA()
    files = {"ca": tmp_path / "ca.pem"}
    authority.cert_pem.write_to_path(files["ca"])
    for who in ("server", "client"):
        issued = authority.issue_cert("127.0.0.1", "localhost")
        files[f"{who}_key"], files[f"{who}_certificate"] = tmp_path / f"{who}.key", tmp_path / f"{who}.pem"
        issued.private_key_pem.write_to_path(files[f"{who}_key"])
        issued.cert_chain_pems[0].write_to_path(files[f"{who}_certificate"])
    return files


def secured(tmp_path: Path, files: dict[str, Path], password_env: str) -> Path:
    (tmp_path / "users.txt").write_text("lab:secret-word\n")
    head = f"""
[transport]
user = "lab"
password_env = "{password_env}"
users_file = "users.txt"
deadline = "16 s"
[transport.tls]
ca = "{files["ca"]}"
certificate = "{files["server_certificate"]}"
key = "{files["server_key"]}"
client_certificate = "{files["client_certificate"]}"
client_key = "{files["client_key"]}"
"""
    return write(tmp_path, steps=20, head=head)


def test_mutual_tls_and_users(tmp_path: Path, certificates: dict[str, Path]) -> None:
    scenario = secured(tmp_path, certificates, "LAB_PASSWORD")
    code, _, err = finish(start(scenario, tmp_path / "out", LAB_PASSWORD="secret-word"))
    assert code == 0, err
    for file in (tmp_path / "out").iterdir():
        assert b"secret-word" not in file.read_bytes(), file


def test_a_wrong_password_ends_in_a_clear_failure(tmp_path: Path, certificates: dict[str, Path]) -> None:
    scenario = secured(tmp_path, certificates, "LAB_PASSWORD")
    code, _, err = finish(start(scenario, tmp_path / "out", LAB_PASSWORD="guess"))
    assert code == 1
    assert "cannot connect" in err


def test_a_password_that_is_not_set_is_refused_before_anything_starts(
    tmp_path: Path, certificates: dict[str, Path]
) -> None:
    os.environ.pop("NO_SUCH_PASSWORD", None)
    code, out, err = finish(start(secured(tmp_path, certificates, "NO_SUCH_PASSWORD"), tmp_path / "out"))
    assert (code, out) == (2, "")
    assert err.splitlines() == ["testbed: transport.password_env: the environment has no variable 'NO_SUCH_PASSWORD'"]


def test_a_free_port_is_found_without_being_told(tmp_path: Path) -> None:
    assert free_port() != 7447
    runs = [start(write(tmp_path, steps=20), tmp_path / f"out{i}") for i in range(2)]
    assert [finish(run)[0] for run in runs] == [0, 0]
