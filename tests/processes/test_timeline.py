"""Events over zenoh: the same steps and the same bits as in process; and by command."""

from __future__ import annotations

from pathlib import Path

import pytest

from processes.running import figures_of, finish, start, summary_of, wait_for
from processes.running import write_scenario as write
from testbed.cli.main import run_command
from testbed.orchestrator.run import Run
from testbed.orchestrator.running import ask
from testbed.scenario import load_scenario

pytestmark = pytest.mark.processes

AOE = '[[estimators]]\nname = "aoe"\n'


def event(action: str, **keys: str) -> str:
    lines = [f'action = "{action}"', *(f"{key} = {value}" for key, value in keys.items())]
    return "[[events]]\n" + "\n".join(lines) + "\n"


EVENTS = (
    event("partition", at="20", links='["observation"]')
    + event("heal", when='"loss_rate(observation, last 5 steps) >= 1 and step >= 24"')
    + event("plant", when='"trace_P(aoe) > 0 for 30 steps"', R="[[3.0, 0.0], [0.0, 3.0]]", over="8")
    + event("swap", when='"step == 50"', estimator='"aoe"', to='{ kind = "imm" }')
    + event("snapshot", at="60", estimator='"aoe"')
    + event("mark", when='"error(aoe) > 0 and step > 70"', name='"end"')
)


@pytest.mark.parametrize("lanes", [1, 3])
def test_events_are_as_in_process(lanes: int, tmp_path: Path) -> None:
    head = 'record = "all"\n[transport]\nlanes_per_packet = 2' if lanes > 1 else 'record = "all"'
    scenario = write(tmp_path, steps=80, lanes=lanes, head=head, tail=AOE + EVENTS)
    code, _, err = finish(start(scenario, tmp_path / "out"))
    assert code == 0, err
    Run(load_scenario(scenario), tmp_path / "in-process").in_process()
    assert figures_of(tmp_path / "out") == figures_of(tmp_path / "in-process")
    events = summary_of(tmp_path / "out")["events"]
    assert events == summary_of(tmp_path / "in-process")["events"]
    assert [(e["action"], e["step"], e["ok"]) for e in events] == [
        ("partition", 20, True),
        ("heal", 25, True),
        ("plant", 31, True),
        ("swap", 51, True),
        ("snapshot", 60, True),
        ("mark", 72, True),
    ]
    names = [tmp_path / where / "snapshots" / "aoe-60.bin" for where in ("out", "in-process")]
    assert names[0].read_bytes() == names[1].read_bytes()


def test_events_by_command(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    process = start(write(tmp_path, steps=200_000, tail=AOE), out)
    wait_for(lambda: (out / "run.json").exists())
    wait_for(lambda: ask(out, {"do": "status"})["completed"] > 10)
    assert run_command(["ctl", str(out), "mark", "here"]) == 0
    assert run_command(["ctl", str(out), "partition", "observation"]) == 0
    assert run_command(["ctl", str(out), "heal"]) == 0
    assert run_command(["ctl", str(out), "hold"]) == 0
    assert (
        run_command(["ctl", str(out), "event", 'action = "plant", R = [[2.0, 0.0], [0.0, 2.0]]', "--when", "step > 5"])
        == 0
    )
    assert run_command(["ctl", str(out), "acks", "perfect", "--at", "1"]) == 2
    assert run_command(["ctl", str(out), "release"]) == 0
    assert run_command(["ctl", str(out), "event", "nonsense"]) == 2
    wait_for(lambda: any(e["action"] == "plant" for e in ask(out, {"do": "status"})["events"]))
    assert run_command(["ctl", str(out), "stop"]) == 0
    code, _, _ = finish(process)
    said, problems = capfd.readouterr()
    assert code == 130
    assert "mark: here: from step " in said
    assert "event 3: to come" in said
    assert "allowed: " in problems
    assert [e["action"] for e in summary_of(out)["events"]] == ["mark", "partition", "heal", "plant"]
