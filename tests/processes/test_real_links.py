"""Runs whose links are real: between zenoh sessions over a relay, and through the kernel."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w

from processes.agreement import ARRIVAL, ESTIMATORS, Outcome, compare, run, tables, z_late, z_steps
from processes.running import alive, children_of, finish, start, summary_of, wait_for

pytestmark = pytest.mark.processes
SIZES: dict[str, Any] = {"lanes": 4, "steps": 40, "period": "30 ms"}
CONTROL = {"loss": {"kind": "bernoulli", "arrival": 0.8}}


def checked(outcome: Outcome) -> None:
    """The books of a run in which each lane has a packet of its own."""
    assert all(check["ok"] for check in outcome.summary["checks"] if check["name"] == "books")
    for link in outcome.links.values():
        packets = SIZES["lanes"] * SIZES["steps"]
        assert link["sent"] == packets
        assert link["delivered"] + link["dropped"] + link["in_flight"] == packets
        assert link["dropped"] >= link["causes"].get("loss", 0) > 0
        assert link["real"]["forward_dropped_loss"] >= link["causes"]["loss"]
        assert link["real"]["forward_sent"] >= packets
    assert outcome.summary["rejected"] == {}


def test_over_the_relay(tmp_path: Path) -> None:
    outcome = run(tmp_path, "relay", seed=1, **SIZES)
    checked(outcome)
    assert all(abs(outcome.loss_z(link)) < 4.5 for link in ARRIVAL)


@pytest.mark.slow
@pytest.mark.root
def test_the_same_seed_loses_the_same_packets_over_model_relay_and_kernel(tmp_path: Path) -> None:
    """With one packet a step the whole runs are the same, to the bit."""
    sizes = {**SIZES, "lanes": 1}
    bursty = {"kind": "gilbert-elliott", "to_bad": 0.2, "to_good": 0.4, "loss_good": 0.05, "loss_bad": 0.7}
    over = {backend: run(tmp_path, backend, seed=2, loss=bursty, **sizes) for backend in ("model", "relay", "kernel")}
    for backend in ("relay", "kernel"):
        for link in ARRIVAL:
            here, there = over[backend].links[link], over["model"].links[link]
            assert here["real"]["forward_sent"] == sizes["steps"]
            assert here["causes"]["loss"] == there["causes"]["loss"] > 0
        if not any(link["late"] for link in over[backend].links.values()):
            np.testing.assert_array_equal(over[backend].traces["aoe"], over["model"].traces["aoe"])


@pytest.mark.slow
def test_late_observations_are_handed_over_and_a_change_holds(tmp_path: Path) -> None:
    """Packets take longer than a period until step 15; none arrives from step 30 on."""
    given = tables(**SIZES, seed=3)
    delay = {"kind": "constant", "by": "45 ms"}
    given["links"] = {"control": CONTROL, "observation": {"backend": "relay", "delay": delay}}
    change = {"action": "set", "link": "observation"}
    given["events"] = [
        {"at": 15, "set": {"delay": "none"}, **change},
        {"at": 30, "set": {"loss": {"kind": "bernoulli", "arrival": 0.0}}, **change},
    ]
    scenario, out = tmp_path / "s.toml", tmp_path / "out"
    scenario.write_text(tomli_w.dumps(given))
    code, _, err = finish(start(scenario, out, "--quiet"))
    assert code == 0, err
    link, lanes = summary_of(out)["links"]["observation"], SIZES["lanes"]
    assert 11 * lanes <= link["late"]
    assert 10 * lanes <= link["causes"]["loss"] <= 12 * lanes
    assert link["transitions"]["00"] >= (11 + 8) * lanes


@pytest.mark.parametrize("end", ["--listen", pytest.param("--connect", marks=pytest.mark.slow)])
def test_a_dead_end_fails_the_run_in_one_line_and_leaves_nothing(tmp_path: Path, end: str) -> None:
    given = {**tables(**{**SIZES, "steps": 100_000}, seed=1), "record": "none"}
    given["links"] = {"control": CONTROL, "observation": {"backend": "relay"}}
    scenario, out = tmp_path / "s.toml", tmp_path / "out"
    scenario.write_text(tomli_w.dumps(given))
    process = start(scenario, out, "--quiet")

    def ends() -> dict[int, str]:
        roles = [pid for pid, command in children_of(process.pid).items() if "--link observation" in command]
        return {pid: command for role in roles for pid, command in children_of(role).items()}

    both = wait_for(lambda: found if len(found := ends()) == 2 and "--connect" in "".join(found.values()) else None)
    os.kill(next(pid for pid, command in both.items() if end in command), signal.SIGKILL)
    code, _, err = finish(process)
    what = "receiving" if end == "--listen" else "sending"
    assert code == 1
    assert f"link.observation: its {what} end ended (killed by signal 9)" in err.splitlines()[-1]
    wait_for(lambda: not any(map(alive, both)))


@pytest.mark.slow
def test_the_ends_leave_when_their_role_is_killed(tmp_path: Path) -> None:
    given = {**tables(**{**SIZES, "steps": 100_000}, seed=1), "record": "none"}
    given["links"] = {"control": CONTROL, "observation": {"backend": "relay"}}
    scenario, out = tmp_path / "s.toml", tmp_path / "out"
    scenario.write_text(tomli_w.dumps(given))
    process = start(scenario, out, "--quiet")

    def roles() -> list[int]:
        return [pid for pid, command in children_of(process.pid).items() if "--link observation" in command]

    (role,) = wait_for(roles)
    both = wait_for(lambda: found if len(found := children_of(role)) == 2 else None)
    os.kill(role, signal.SIGKILL)
    code, _, _ = finish(process)
    assert code == 1
    wait_for(lambda: not any(map(alive, both)))


def test_in_process_there_are_no_real_links(tmp_path: Path) -> None:
    scenario = tmp_path / "s.toml"
    scenario.write_text(tomli_w.dumps(tables(**SIZES, seed=1)))
    code, out, err = finish(start(scenario, tmp_path / "out", "--links", "relay", "--in-process"))
    assert (code, out) == (2, "")
    assert err.splitlines()[-1].startswith("testbed: links.control.backend: got 'relay' with --in-process; allowed")
    assert len(err.splitlines()) == 1


@pytest.mark.slow
@pytest.mark.root
@pytest.mark.timeout(400)
def test_model_relay_and_kernel_agree(tmp_path: Path) -> None:
    """With a seed of its own for each: tr P over the last half, and step by step; and the losses."""
    outcomes = compare(tmp_path, ("model", "relay", "kernel"), runs=2, lanes=24, steps=60, period="100 ms")
    for outcome in outcomes.values():
        assert all(abs(outcome.loss_z(link)) < 3.5 for link in ARRIVAL)
    for backend in ("relay", "kernel"):
        for name in ESTIMATORS:
            assert abs(z_late(outcomes[backend], outcomes["model"], name)) < 3.0
            steps = z_steps(outcomes[backend], outcomes["model"], name)
            assert np.mean(np.abs(steps) <= 1.96) > 0.75
            assert np.abs(steps).max() < 5.0
