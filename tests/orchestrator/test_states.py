"""Every service goes on from the state that it gave after any step, to the bits of one that was never interrupted."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from orchestrator.resuming import Whole, check_resumed, live, packets_of, whole_run
from orchestrator.runs import MARKOV, scenario
from orchestrator.test_late import LINKS as LATE
from orchestrator.test_robust import scenario as robust
from orchestrator.test_swaps import able, swap
from orchestrator.wall_clock import Simulated
from testbed.errors import UsageError
from testbed.wire.state import pack

STEPS = 20
SPLIT = {"transport": {"lanes_per_packet": 4}}
GIVEN: dict[str, Any] = {"steps": STEPS, "record": "first", "bounds": True}
FOUR_STATE = {"kind": "four-state", "to_burst": 0.3, "to_good": 0.4, "to_pause": 0.2, "from_pause": 0.5}
GILBERT = {"kind": "gilbert-elliott", "to_bad": 0.3, "to_good": 0.4, "loss_good": 0.1, "loss_bad": 0.8}
CHANGED = [
    {"action": "set", "at": 4, "link": "observation", "set": {"loss": {"kind": "bernoulli", "arrival": 0.4}}},
    {"action": "set", "at": 9, "link": "observation", "set": {"loss": FOUR_STATE}},
    {"action": "set", "at": 6, "link": "control", "set": {"loss": GILBERT}},
    {"action": "set", "at": 12, "link": "ack", "set": {"loss": {"kind": "scripted", "pattern": "0110"}}},
]


def check(run: Whole, *steps: int) -> None:
    for role, life in run.lives.items():
        assert life.service.gives_state
        given = [step for step in steps if step in life.states]
        assert given
        assert packets_of(life.published, role, given[0])
        for step in given:
            check_resumed(life, run.setup, role, run.messages, step)


CASES: dict[str, dict[str, Any]] = {
    "plain": {},
    "split": SPLIT,
    "schedule": {**SPLIT, "lanes": 9},
    "one lane": {"lanes": 1},
    "late": {"links": LATE["messy"]},
    "late split": {"links": LATE["batches"], **SPLIT},
    "slots": {"links": LATE["slots"]},
    "hold": {"actuator": {"on_loss": "hold"}, "cost": {"Qx": [[1.0, 0.0], [0.0, 1.0]]}},
    "correlated": {"links": {"control": {"loss": MARKOV}}},
    "changed": {"events": CHANGED},
    "drift": {
        "events": [
            {"at": 3, "action": "plant", "A": [[0.9, 0.1], [0.0, 0.5]], "R": [[0.8]], "over": 8},
            {"at": 10, "action": "input", "input": {"kind": "constant", "value": [2.0]}},
        ]
    },
}


@pytest.mark.parametrize("case", CASES)
def test_every_service_goes_on_to_the_same_bits(case: str, tmp_path: Path) -> None:
    changes = CASES[case]
    specs = able(**changes)
    assert len(specs) >= (2 if case == "hold" else 8)
    if "late" in case or case == "slots":
        specs = [spec for spec in specs if spec["name"] in ("aoe", "gpb", "kfio", "oe", "pf")]
        specs += [{"name": "acked", "kind": "aoe"}, {"name": "short", "kind": "gpb", "order": 1, "buffer": 2}]
    run = whole_run(scenario(**GIVEN, **changes, estimators=specs), tmp_path, 3 if case == "schedule" else None)
    check(run, *((6, 15) if "late" in case else (1, 7, 13, STEPS)))
    if case == "late":
        counters = run.lives["estimator.acked"].counters
        assert min(counters["late_observations"], counters["refiltered"]) > 0


@pytest.mark.parametrize("on_loss", ["zero", "noise"])
def test_model_error_and_noise_in_place_of_what_was_lost(on_loss: str, tmp_path: Path) -> None:
    links = {"observation": {"loss": MARKOV, "on_loss": on_loss if on_loss == "noise" else "nothing"}}
    check(whole_run(robust(links=links, bounds=True), tmp_path), 1, 11, 29)


INPUTS: dict[str, dict[str, Any]] = {
    "feedback": {"gain": [[0.3, 0.1]], "reference": [1.0, 0.0], "low": -1.0, "high": 0.5},
    "lqg": {"Qx": [[1.0, 0.0], [0.0, 1.0]], "Ru": [[0.5]], "horizon": "run", "low": -0.5},
    "pid": {"output": [[1.0, 0.0]], "kp": 0.5, "ki": 0.3, "kd": 0.2, "filter": 2.0, "high": 0.4, "low": -0.4},
}


@pytest.mark.parametrize("kind", INPUTS)
@pytest.mark.parametrize("lanes", [1, 6])
def test_the_loop_is_closed_again(kind: str, lanes: int, tmp_path: Path) -> None:
    source = {"kind": kind, "estimator": "aoe", **INPUTS[kind]}
    given = scenario(**GIVEN, **SPLIT, lanes=lanes, input=source, estimators=[{"name": "aoe", "acks": "none"}])
    run = whole_run(given, tmp_path)
    check(run, *range(1, STEPS + 1, 3))
    assert lanes == 1 or run.lives["controller"].counters["saturated"] > 0


def test_services_that_joined_go_on_under_the_names_that_they_have(tmp_path: Path) -> None:
    """From a snapshot, from the prior, and a shadow that is promoted."""
    specs = [{"name": "aoe", "acks": "none"}, {"name": "kfio", "acks": "perfect"}]
    events = [
        swap(4, "aoe", {"kind": "gpb", "order": 1}),
        {"action": "shadow", "at": 5, "estimator": "kfio", "name": "second", "to": {"kind": "aoe"}},
        swap(11, "kfio", "second"),
        swap(13, "aoe", {"kind": "gpb", "order": 1}, "full"),
    ]
    run = whole_run(scenario(**GIVEN, **SPLIT, estimators=specs, events=events), tmp_path)
    begins = {role: min(life.states) for role, life in run.lives.items() if role.startswith("estimator.")}
    ends = {role: max(life.states) for role, life in run.lives.items() if role.startswith("estimator.")}
    assert set(begins.values()) == {1, 4, 5, 13}
    assert set(ends.values()) == {3, 10, 12, STEPS}
    check(run, 1, 2, 4, 8, 9, 12, 14, 17)


def in_real_time(tmp_path: Path, **changes: Any) -> Whole:
    clock = {"mode": "real", "period": "10 ms"}
    given = scenario(**GIVEN, **SPLIT, **changes, clock=clock, estimators=[{"name": "aoe", "acks": "none"}])
    return whole_run(given, tmp_path, network=Simulated)


def test_in_real_time_a_controller_without_feedback_sends_the_same(tmp_path: Path) -> None:
    run = in_real_time(tmp_path)
    for step in (1, 8, 19):
        check_resumed(run.lives["controller"], run.setup, "controller", run.messages, step, network=Simulated)


def test_in_real_time_a_controller_knows_again_what_it_knew(tmp_path: Path) -> None:
    """What it sends then depends on when estimates come; its state says all that it knows."""
    source = {"kind": "pid", "kp": 0.3, "ki": 0.1, "kd": 0.2, "high": 1.5, "estimator": "aoe"}
    run = in_real_time(tmp_path, input=source)
    life = run.lives["controller"]
    for step in (1, 8, 19):
        again = live(life, run.setup, "controller", [], step, life.states[step], Simulated)
        assert {lane: again.service.state(lane) for lane in life.states[step]} == life.states[step]


def test_a_controller_without_a_state_gives_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "stateless.py").write_text(
        "class Plain:\n"
        "    def __init__(self, model, lanes):\n        pass\n\n"
        "    def step(self, k, x_hat, P):\n        return -0.1 * x_hat[:, :1]\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    source = {"kind": "python", "controller": "stateless:Plain", "estimator": "aoe"}
    run = whole_run(scenario(**GIVEN, input=source, estimators=[{"name": "aoe", "acks": "none"}]), tmp_path / "out")
    life = run.lives["controller"]
    assert not life.service.gives_state
    assert not life.states
    with pytest.raises(UsageError, match="set_state"):
        life.service.resume(0, 3, pack({}, step=3))
