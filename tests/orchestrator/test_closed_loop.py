"""Whole runs in a closed loop: the same bits however they are run, the cost as recorded, and as the theory has it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from orchestrator.runs import MARKOV, Recorded, figures, recorded, run, scenario
from testbed.control.lqg import Weights, expected_cost, horizon_gains, stationary_gain
from testbed.errors import UsageError
from testbed.estimator.registry import model_of
from testbed.orchestrator.preflight import check_parts
from testbed.orchestrator.run import Run
from testbed.orchestrator.summary import Summary
from testbed.orchestrator.table import end_table
from testbed.wire.memory_bus import MemoryNetwork

OWN = '''
from testbed.numerics.lanes import array_of, clip, vector_of


class Bang:
    """On and off, by the sign of the first entry, and with memory."""

    def __init__(self, model, lanes, level: float = 1.0):
        self.level, self.last = level, [0.0]

    def step(self, k, x_hat, P):
        x = vector_of(x_hat)
        self.last = [0.5 * self.last[0] - self.level * clip(x[0], -1.0, 1.0)]
        return array_of(self.last, len(x_hat))
'''
LQG = {"kind": "lqg", "Qx": [[2.0, 0.1], [0.1, 1.0]], "Ru": [[1.5]]}
HIDDEN = {"kind": "gilbert-elliott", "to_bad": 0.2, "to_good": 0.3, "loss_good": 0.1, "loss_bad": 0.7}
KFIO = [{"name": "kfio", "acks": "perfect"}]
COST = {"Qx": [[1.0, 0.2], [0.2, 2.0]], "Ru": [[0.5]], "terminal": [[7.0, 0.0], [0.0, 7.0]], "reference": [0.5, 0.0]}
LOOPS: dict[str, dict[str, Any]] = {
    "feedback": {
        "input": {"kind": "feedback", "gain": [[0.6, 0.3]], "reference": [1.0, 0.0], "feedforward": 0.2, "high": 0.7},
        "estimators": [{"name": "aoe", "acks": "none"}],
        "cost": COST,
    },
    "lqg": {"input": LQG, "estimators": KFIO},
    "lqg of the run": {
        "input": {**LQG, "horizon": "run", "terminal": [[5.0, 0.0], [0.0, 5.0]], "low": [-2.0], "estimator": "kfio"},
        "estimators": [{"name": "ff", "acks": "none"}, *KFIO],
    },
    "pid": {
        "input": {"kind": "pid", "setpoint": 2.0, "kp": 0.4, "ki": 0.1, "kd": 0.2, "filter": 1.0, "low": -1, "high": 1},
        "estimators": [{"name": "aoe", "acks": "none"}],
        "cost": COST,
        "actuator": {"on_loss": "hold"},
    },
    "python": {
        "input": {"kind": "python", "controller": "bang_controller:Bang", "options": {"level": 0.7}},
        "estimators": KFIO,
        "cost": {"Qx": [[1.0, 0.0], [0.0, 0.0]]},
    },
}


@pytest.fixture(autouse=True)
def own(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """The module of the controller in the working folder."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "bang_controller.py").write_text(OWN)
    monkeypatch.chdir(folder)


def loop(name: str, **changes: Any) -> Any:
    return scenario(**{"steps": 12, **LOOPS[name], **changes})


def assert_equal(one: Recorded, other: Recorded) -> None:
    assert one.keys() == other.keys()
    for topic in one:
        for name, values in one[topic].items():
            np.testing.assert_array_equal(values, other[topic][name], err_msg=f"{topic} {name}")


@pytest.mark.parametrize("name", LOOPS)
def test_a_run_is_a_function_of_scenario_and_seed(name: str, tmp_path: Path) -> None:
    whole = run(loop(name), tmp_path / "whole")
    assert (whole.status, whole.reason, whole.rejected) == ("complete", None, {})
    for schedule, lanes in ((1, 4), (2, 1), (3, None)):
        transport = {} if lanes is None else {"lanes_per_packet": lanes}
        split = run(loop(name, transport=transport), tmp_path / "split", schedule)
        assert figures(split) == figures(whole)
        assert_equal(recorded(tmp_path / "split", 6, 12), recorded(tmp_path / "whole", 6, 12))


def test_figures_of_many_lanes_do_not_depend_on_the_packets(tmp_path: Path) -> None:
    given = {"lanes": 150, "steps": 5, "record": "none"}
    whole = run(loop("lqg", **given), tmp_path)
    split = run(loop("lqg", transport={"lanes_per_packet": 7}, **given), tmp_path, 1)
    assert figures(split) == figures(whole)


@pytest.mark.parametrize("lanes", [1, 6])
@pytest.mark.parametrize("name", LOOPS)
def test_the_cost_is_that_of_the_recording(name: str, lanes: int, tmp_path: Path) -> None:
    """By numpy, from x and u as recorded; the applied input from u, ν and the actuator's rule."""
    given = loop(name, lanes=lanes)
    found = run(given, tmp_path).cost
    assert found is not None
    packets = recorded(tmp_path, lanes, 12)
    x, nu, u = packets["truth"]["x"], packets["truth"]["nu"], packets["control/sent"]["u"]
    applied, held = np.zeros_like(u), np.zeros_like(u[0])
    for k in range(12):
        otherwise = held if given.actuator.on_loss == "hold" else np.zeros_like(held)
        applied[k] = held = np.where(nu[k][:, None] == 1, u[k], otherwise)
    np.testing.assert_array_equal(packets["truth"]["applied"], applied)
    own = given.cost
    W = np.tile(np.array(own.Qx), (12, 1, 1))
    W[-1] = np.array(own.terminal) if own.terminal is not None else W[-1]
    away = x - (np.zeros(2) if own.reference is None else np.array(own.reference))
    R = np.zeros((1, 1)) if own.Ru is None else np.array(own.Ru)
    state = np.einsum("kmi,kij,kmj->km", away, W, away)
    pushed = np.einsum("kmi,ij,kmj->km", applied, R, applied)
    for series, values in ((found.state_mean, state), (found.input_mean, pushed), (found.step_mean, state + pushed)):
        np.testing.assert_allclose(np.array(series, dtype=float), values.mean(axis=1), rtol=1e-12, atol=1e-12)
    sums = (state + pushed).sum(axis=0)
    np.testing.assert_allclose([found.total, found.a_step], [sums.mean(), sums.mean() / 12], rtol=1e-12)
    if lanes == 1:
        assert (found.total_stderr, found.total_interval_95, found.a_step_stderr) == (None, None, None)
        return
    stderr = sums.std(ddof=1) / np.sqrt(lanes)
    np.testing.assert_allclose([found.total_stderr, found.a_step_stderr], [stderr, stderr / 12], rtol=1e-10)
    assert found.total_interval_95 is not None
    interval = np.array(found.total_interval_95, dtype=float)
    np.testing.assert_allclose(interval, sums.mean() + 1.96 * stderr * np.array([-1, 1]), rtol=1e-10)


@pytest.mark.parametrize("name", ["feedback", "lqg of the run", "pid"])
def test_no_input_is_beyond_the_limits_and_those_cut_are_counted(name: str, tmp_path: Path) -> None:
    given = loop(name, steps=20)
    summary = run(given, tmp_path)
    u = recorded(tmp_path, 6, 20)["control/sent"]["u"]
    low = -np.inf if given.input.low is None else np.min(given.input.low)
    high = np.inf if given.input.high is None else np.max(given.input.high)
    assert u.min() >= low
    assert u.max() <= high
    assert summary.controller is not None
    at_a_limit = np.count_nonzero((u == low) | (u == high))
    assert summary.controller.counters == {"saturated": at_a_limit}
    assert 0 < at_a_limit < u.size


@pytest.mark.parametrize("horizon", ["run", "stationary"])
@pytest.mark.parametrize("loss", [{"kind": "bernoulli", "arrival": 0.7}, MARKOV])
def test_the_cost_of_lqg_is_what_the_theory_says(horizon: str, loss: dict[str, Any], tmp_path: Path) -> None:
    """Within four standard errors; no observation is lost, so that P_k is known beforehand."""
    links = {"control": {"loss": loss}}
    given = scenario(
        steps=15, lanes=900, record="none", links=links, input={**LQG, "horizon": horizon}, estimators=KFIO
    )
    model = model_of(given)
    weights = Weights(np.array(LQG["Qx"]), np.array(LQG["Ru"]), np.array(LQG["Qx"]))
    gains = [stationary_gain(model, weights)] * 15 if horizon == "stationary" else horizon_gains(model, weights, 15)
    P, covariances = model.P0, [model.P0]
    for _ in range(14):
        P = model.A @ P @ model.A.T + model.Q
        P = np.linalg.inv(np.linalg.inv(P) + model.C.T @ np.linalg.inv(model.R) @ model.C)
        covariances.append(P)
    expected = expected_cost(model, weights, gains[::-1], covariances)
    summary = run(given, tmp_path)
    found = summary.cost
    assert found is not None
    assert found.total is not None
    assert found.total_stderr is not None
    assert found.total_stderr < 0.03 * expected
    assert abs(found.total - expected) < 4.0 * found.total_stderr
    assert summary.controller is not None
    assert str(summary.controller.statement).startswith("optimal: ")
    np.testing.assert_allclose(np.array(summary.controller.gain), gains[-1], rtol=1e-12)


def test_a_cost_without_a_closed_loop(tmp_path: Path) -> None:
    """And without an input: only the state costs."""
    summary = run(scenario(cost=COST), tmp_path)
    assert summary.controller is None
    assert summary.cost is not None
    system = {"A": [[0.5]], "C": [[1.0]], "Q": [[1.0]], "R": [[1.0]]}
    given = {"system": system, "input": None, "links": {}, "estimators": [{"name": "kfio"}], "lanes": 1}
    free = run(scenario(cost={"Qx": [[2.0]]}, **given), tmp_path / "free")
    assert free.cost is not None
    x = recorded(tmp_path / "free", 1, 20)["truth"]["x"]
    assert "applied" not in recorded(tmp_path / "free", 1, 20)["truth"]
    np.testing.assert_allclose(free.cost.total, 2.0 * (x**2).sum(), rtol=1e-12)


def test_no_cost_is_asked_for(tmp_path: Path) -> None:
    summary = run(scenario(input={"kind": "feedback", "gain": [[0.6, 0.3]]}, estimators=KFIO), tmp_path)
    assert summary.cost is None
    assert summary.controller is not None
    assert (summary.controller.statement, summary.controller.gain) == (None, ((0.6, 0.3),))
    assert "applied" not in recorded(tmp_path, 6, 20)["truth"]


def test_steps_that_were_not_completed_cost_nothing(tmp_path: Path) -> None:
    """A run that is cut short: the total is over the completed steps."""

    class Cut(MemoryNetwork):
        def step(self) -> bool:
            self.count = getattr(self, "count", 0) + 1
            return super().step() if self.count < 150 else False

    summary = run(loop("lqg", lanes=3), tmp_path, None, Cut)
    assert summary.status == "failed"
    assert summary.cost is not None
    assert 0 < summary.completed_steps < 12
    assert summary.cost.total == pytest.approx(sum(v for v in summary.cost.step_mean if v is not None), rel=1e-12)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"estimators": [{"name": "lmmse", "acks": "none"}]}, "lmmse gets no ACKs"),
        ({"estimators": [{"name": "lmmse"}]}, "lmmse gets some ACKs only"),
        ({"estimators": [{"name": "pf", "acks": "perfect"}]}, "the x̂ of pf is not known to be"),
        ({"input": {**LQG, "high": 2.0}}, "the input has limits"),
        ({"actuator": {"on_loss": "hold"}}, "the actuator holds"),
        ({"links": {"control": {"loss": HIDDEN}}}, "the losses have a hidden state"),
        (
            {"events": [{"at": 2, "action": "set", "link": "control", "set": {"loss": {"arrival": 0.9}}}]},
            "the losses of control change",
        ),
        ({"uncertainty": {"dA": [[[0.1, 0.0], [0.0, 0.0]]], "delta": 1.0}}, "the plant departs from its model"),
    ],
)
def test_what_keeps_it_from_being_optimal_is_said(changes: dict[str, Any], reason: str, tmp_path: Path) -> None:
    summary = run(loop("lqg", steps=4, lanes=2, record="none", **changes), tmp_path)
    assert summary.controller is not None
    assert str(summary.controller.statement).startswith("not optimal: ")
    assert reason in str(summary.controller.statement)


def test_without_losses_of_control_it_is_optimal_without_acks(tmp_path: Path) -> None:
    links = {"observation": {"loss": MARKOV}}
    summary = run(loop("lqg", steps=4, links=links, estimators=[{"name": "ff", "acks": "none"}]), tmp_path)
    assert summary.controller is not None
    assert str(summary.controller.statement).startswith("optimal: ")


def test_losses_with_a_hidden_state_count_by_their_rate(tmp_path: Path) -> None:
    """0.4 · 0.7 + 0.6 · 0.1 of the packets are lost in the long run."""
    gains = []
    for loss in (HIDDEN, {"kind": "bernoulli", "loss": 0.4 * 0.7 + 0.6 * 0.1}):
        summary = run(loop("lqg", steps=2, links={"control": {"loss": loss}}), tmp_path)
        assert summary.controller is not None
        gains.append(summary.controller.gain)
    np.testing.assert_allclose(np.array(gains[0]), np.array(gains[1]), rtol=1e-10)


def test_losses_that_no_gain_stands_are_refused_before_the_run(tmp_path: Path) -> None:
    links = {"control": {"loss": {"kind": "bernoulli", "arrival": 0.15}}}
    with pytest.raises(UsageError) as refusal:
        Run(loop("lqg", links=links), tmp_path / "out")
    assert str(refusal.value).startswith("input: no gain keeps the mean square of the state bounded: ")
    assert len(str(refusal.value).splitlines()) == 1
    assert not (tmp_path / "out").exists()
    check_parts(loop("lqg of the run", links=links))


def test_a_controller_that_fails_while_the_run_goes(tmp_path: Path) -> None:
    Path("late_controller.py").write_text(
        "class Late:\n"
        "    def __init__(self, model, lanes): pass\n"
        "    def step(self, k, x_hat, P):\n"
        "        return -x_hat[:, :1] if k < 3 else None\n"
    )
    source = {"kind": "python", "controller": "late_controller:Late"}
    summary = run(scenario(input=source, estimators=KFIO), tmp_path)
    assert (summary.status, summary.completed_steps) == ("failed", 3)
    assert summary.reason == "the controller returned nothing at step 3; needed: u of the shape (6, 1)"


def test_the_table_has_a_line_for_it(tmp_path: Path) -> None:
    from rich.console import Console

    summary: Summary = run(loop("pid"), tmp_path)
    console = Console(width=100, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    console.print(end_table(summary, tmp_path))
    (line,) = (line for line in console.export_text().splitlines() if line.startswith("cost: "))
    assert "a step" in line
    assert summary.controller is not None
    assert line.endswith(f"(pid on aoe, {summary.controller.counters['saturated']} at a limit)")
