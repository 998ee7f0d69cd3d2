"""Estimators that change while a run over zenoh goes: processes start and leave, and no step is lost."""

from __future__ import annotations

import json
import os
import signal
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from processes.running import children_of, figures_of, finish, start, summary_of, wait_for
from processes.running import write_scenario as write
from testbed.cli.main import run_command
from testbed.orchestrator.recording import read_recording
from testbed.orchestrator.run import Run
from testbed.orchestrator.running import ask
from testbed.scenario import load_scenario

pytestmark = pytest.mark.processes

TWO = '[[estimators]]\nname = "aoe"\n[[estimators]]\nname = "twin"\nkind = "aoe"\n'


def event(at: int, action: str, **keys: str) -> str:
    lines = [f"at = {at}", f'action = "{action}"', *(f"{key} = {value}" for key, value in keys.items())]
    return "[[events]]\n" + "\n".join(lines) + "\n"


THREE = (
    event(40, "swap", estimator='"aoe"', to='{ kind = "aoe" }', handover='"full"')
    + event(60, "shadow", estimator='"aoe"', name='"next"', to='{ kind = "gpb", order = 2 }')
    + event(90, "swap", estimator='"aoe"', to='{ kind = "imm" }', handover='"cold"')
    + event(120, "swap", estimator='"aoe"', to='"next"')
)


def once_each(out: Path, name: str, steps: int, lanes: int) -> bool:
    """Whether the recording has each step of each lane once, up to ``steps`` or, in a run that was stopped, beyond."""
    found: Counter[tuple[int, int]] = Counter()
    for topic, packet, _ in read_recording(out / "recording.mcap"):
        if topic == f"estimate/{name}":
            found.update((packet.step, packet.lane + row) for row in range(packet.lanes))
    last = max(k for k, _ in found)
    return last >= steps and found == {(k, lane): 1 for k in range(1, last + 1) for lane in range(lanes)}


@pytest.mark.parametrize(
    "head", ["[transport]\nlanes_per_packet = 2", '[clock]\nwindow = 1\n[transport]\ndeadline = "30 s"']
)
def test_three_swaps_and_a_shadow_are_as_in_process(head: str, tmp_path: Path) -> None:
    lanes = 3 if "lanes_per_packet" in head else 1
    scenario = write(tmp_path, steps=150, lanes=lanes, head=f'record = "all"\n{head}', tail=TWO + THREE)
    code, _, err = finish(start(scenario, tmp_path / "out"))
    assert code == 0, err
    Run(load_scenario(scenario), tmp_path / "in-process").in_process()
    assert figures_of(tmp_path / "out") == figures_of(tmp_path / "in-process")
    over_zenoh, in_process = summary_of(tmp_path / "out"), summary_of(tmp_path / "in-process")
    assert over_zenoh["events"] == in_process["events"]
    assert [(e["step"], e["ok"]) for e in over_zenoh["events"]] == [(40, True), (60, True), (90, True), (120, True)]
    assert over_zenoh["rejected"] == {}
    assert [down["steps"] for down in over_zenoh["timing"]["swaps"]] == [0, 0, 0, 0]
    assert once_each(tmp_path / "out", "aoe", 150, lanes)
    own, twin = (over_zenoh["estimators"][name]["squared_error_mean"] for name in ("aoe", "twin"))
    assert own[:89] == twin[:89]
    assert own[89:] != twin[89:]


def processes_of(pid: int, part: str) -> list[int] | None:
    return [child for child, command in children_of(pid).items() if part in command] or None


def test_a_new_service_that_is_killed_leaves_the_old_one_in_charge(tmp_path: Path) -> None:
    process = start(write(tmp_path, steps=200_000, tail=TWO), tmp_path / "out")
    wait_for(lambda: (tmp_path / "out" / "run.json").exists())
    question = {"event": {"action": "swap", "estimator": "aoe", "to": {"kind": "imm"}}}
    wait_for(lambda: accepted(tmp_path / "out", question))
    os.kill(wait_for(lambda: processes_of(process.pid, "estimator.aoe.2"))[0], signal.SIGKILL)

    def refused() -> Any:
        return [e for e in ask(tmp_path / "out", {"do": "status"})["events"] if not e["ok"]]

    (refusal,) = wait_for(refused)
    assert "estimator.aoe.2" in refusal["reason"]
    before = ask(tmp_path / "out", {"do": "status"})["completed"]
    wait_for(lambda: ask(tmp_path / "out", {"do": "status"})["completed"] > before)
    assert run_command(["ctl", str(tmp_path / "out"), "stop"]) == 0
    code, _, _ = finish(process)
    summary = summary_of(tmp_path / "out")
    assert (code, summary["status"], summary["reason"]) == (130, "interrupted", "stopped by command")
    own, twin = (summary["estimators"][name]["squared_error_mean"] for name in ("aoe", "twin"))
    assert own == twin


def accepted(out: Path, question: dict[str, Any]) -> bool:
    """Whether the run takes it; it does when it has started."""
    from testbed.errors import UsageError

    try:
        ask(out, question)
    except UsageError:
        return False
    return True


def test_swaps_by_command(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    process = start(write(tmp_path, steps=200_000, tail=TWO), out)
    wait_for(lambda: (out / "run.json").exists())
    wait_for(lambda: ask(out, {"do": "status"})["completed"] > 10)
    assert run_command(["ctl", str(out), "swap", "aoe", "--to", "aoe", "--handover", "full"]) == 0
    assert run_command(["ctl", str(out), "shadow", "aoe", "next", "--to", "gpb", "--option", "order=2"]) == 0
    assert run_command(["ctl", str(out), "swap", "aoe", "--promote", "next"]) == 0
    assert run_command(["ctl", str(out), "swap", "aoe", "--to", "gqb"]) == 2
    assert run_command(["ctl", str(out), "status", "--json"]) == 0
    assert run_command(["ctl", str(out), "stop"]) == 0
    code, _, _ = finish(process)
    said, problems = capfd.readouterr()
    lines = said.splitlines()
    assert code == 130
    assert lines[0].startswith("swap aoe to aoe, full: from step ")
    assert "did you mean 'gpb'?" in problems
    status = next(json.loads(line) for line in lines if line.startswith("{"))
    assert status["estimators"]["aoe"] == {"role": "estimator.next", "kind": "gpb"}
    summary = summary_of(out)
    steps = [e["step"] for e in summary["events"]]
    assert [e["action"] for e in summary["events"]] == ["swap", "shadow", "swap"]
    assert [int(line.split()[-2]) for line in lines[:3]] == steps
    own, twin = (summary["estimators"][name]["squared_error_mean"] for name in ("aoe", "twin"))
    assert own[: steps[2] - 1] == twin[: steps[2] - 1]
    assert once_each(out, "aoe", summary["completed_steps"], 1)
