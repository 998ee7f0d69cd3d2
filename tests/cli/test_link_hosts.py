"""``testbed link hosts``, ``doctor`` and ``clean``."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from cli.commands import Command, testbed

__all__ = ["testbed"]

SEND = "import socket\ns = socket.socket(2, 2)\nfor k in range(60): s.sendto(b'x', ('10.0.0.2', 9))"


@pytest.mark.root
def test_the_losses_are_those_of_the_sampled_link(testbed: Command, tmp_path: Path) -> None:
    """The scenario's clock would give every packet its period, which a chain by packets does not look at."""
    done = testbed(
        *("link", "hosts", "s.toml", "--link", "observation", "--trace", "wire.csv", "--json"),
        *("--", sys.executable, "-S", "-c", SEND),
    )
    assert (done.code, done.err) == (0, "")
    figures = json.loads(done.out)
    assert testbed("link", "sample", "s.toml", "--link", "observation", "-n", 60, "--out", "model.csv").code == 0
    lost = []
    for name in ("wire.csv", "model.csv"):
        with (tmp_path / name).open() as file:
            lost.append({int(row["seq"]) for row in csv.DictReader(file) if not row["delivered_ns"]})
    assert lost[0] == lost[1]
    assert figures["forward"]["dropped"] == figures["forward"]["dropped_loss"] == len(lost[0]) > 0
    assert figures["forward"]["sent"] == 60
    assert (figures["link"], figures["back"], figures["exit_codes"]) == ("observation", None, {"a": 0})


@pytest.mark.root
def test_exit_code_and_end_of_both_commands(testbed: Command) -> None:
    command = ("link", "hosts", "s.toml", "--link", "control", "--back", "observation", "--head-start", "1 ms")
    done = testbed(*command, "--b", "sleep 1000", "--", "sh", "-c", "exit 7")
    assert done.code == 7
    assert "a: exit code 7" in done.out
    assert "b: ended with the hosts" in done.out
    head = next(line for line in done.out.splitlines() if "forward" in line)
    assert head.split() == ["forward", "backward"]
    killed = testbed(*command, "--", "sh", "-c", "kill -9 $$")
    assert killed.code == 137
    assert "a: killed by SIGKILL" in killed.out


@pytest.mark.root
def test_the_books_are_printed_after_an_interrupt(testbed: Command, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "testbed", "link", "hosts", "s.toml", "--link", "control", "--json"]
    command += ["--", "sh", "-c", "echo started; exec sleep 1000"]
    with subprocess.Popen(command, stdout=-1, stderr=-1, text=True, start_new_session=True, cwd=tmp_path) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "started\n"
        os.killpg(process.pid, signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (130, "testbed: interrupted\n")
    assert json.loads(out)["exit_codes"] == {"a": None}
    assert json.loads(out)["forward"]["sent"] == 0


@pytest.mark.parametrize(
    ("options", "error"),
    [
        (("--link", "obs"), "--link obs: no such link; allowed: control, observation, ack; did you mean"),
        (("--link", "control", "--back", "ack"), '--back ack: the scenario has none; allowed: with [links.ack] mode'),
        (("--link", "control", "--backend", "netm"), "--backend netm: no such backend; allowed: tun, netem; did you"),
        (("--link", "control", "--head-start", "soon"), "--head-start soon: allowed: a duration such as '500 ms'"),
        (("--link", "control", "--congestion", "no"), "congestion: got 'no'; allowed: "),
        (("--link", "control", "--trace", "no/such/t.csv"), "cannot write no/such/t.csv: no such file or directory"),
        (("--link", "control", "--mtu", "1"), "mtu: got 1; allowed: 576 … 65535"),
    ],
)  # fmt: skip
def test_wrong_input_is_one_line(testbed: Command, options: tuple[str, ...], error: str) -> None:
    refused = testbed("link", "hosts", "s.toml", *options, "--", "true")
    assert (refused.code, refused.out) == (2, "")
    assert error in refused.err
    assert refused.err.count("\n") == 1


def test_doctor_prints_the_findings(testbed: Command) -> None:
    given = json.loads(testbed("link", "doctor", "--json").out)
    assert {"what": "relay", "ok": True, "found": "sockets on loopback; needs no rights", "advice": ""} in given
    shown = testbed("link", "doctor")
    assert (shown.code, shown.err) == (0, "")
    for finding in given:
        assert any(line.startswith(finding["what"]) for line in shown.out.splitlines())


@pytest.mark.root
def test_clean_says_what_it_ended(testbed: Command) -> None:
    mark = "tb-4194305-1-00000000"  # beyond the greatest process number
    with subprocess.Popen(["sleep", "1000"], env={**os.environ, "TESTBED_HOSTS": mark}) as left:
        try:
            finding = next(f for f in json.loads(testbed("link", "doctor", "--json").out) if f["what"] == "left behind")
            assert not finding["ok"]
            assert f"{left.pid} sleep 1000" in finding["found"]
            assert f"ended: {left.pid} sleep 1000, left by {mark}" in testbed("link", "clean").out
            assert left.wait(30) == -15
        finally:
            left.kill()
    assert not [one for one in json.loads(testbed("link", "clean", "--json").out) if one["hosts"] == mark]
