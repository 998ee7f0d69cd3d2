"""What is said of scenarios whose actuator holds, against recursions that are exact for such."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from analysis.test_convergence import FADING, bernoulli, d3, said, settled_radius
from testbed.analysis.verdicts import analyze
from testbed.estimator.registry import create, model_of
from testbed.numerics.lanes import Floats
from testbed.scenario import Scenario

HOLD: dict[str, Any] = {"actuator": {"on_loss": "hold"}}
MARKOV = {"kind": "markov", "recovery": 0.3, "failure": 0.2}
ENDLESS = {"kind": "markov", "recovery": 0.0, "failure": 0.2}


def excess(scenario: Scenario, u: Floats) -> Floats:
    """tr P̃ − tr Pᴬ of the fast filter, an upper bound of what the optimal estimator has more than with every ACK."""
    model = model_of(scenario)
    blind = create("ff", model, lanes=1)
    knowing = create("ff", replace(model, control=type(model.control).lossless()), lanes=1)
    none, here, out = np.zeros((1, model.p)), np.ones(1, dtype=np.bool_), []
    for value in u:
        traces = [np.trace(est.step(np.array([[value]]), none, here).P[0]) for est in (blind, knowing)]
        out.append(traces[0] - traces[1])
    return np.array(out)


@pytest.mark.parametrize("arrival", [0.02, 0.3, 0.9])
def test_a_fading_input_that_is_held_is_forgotten_as_fast_as_said(arrival: float) -> None:
    """By the input where bursts are short, by the bursts where they are long: 0.98 is above exp(−1/15)."""
    scenario = d3(1.1952, bernoulli(arrival), FADING, **HOLD)
    found, model = said(scenario), model_of(scenario)
    assert (found["holds"], found["theorem"]) == (True, "D Theorem 3, for held inputs")
    assert found["rate"] == pytest.approx(max(np.exp(-1 / 15), 1.0 - arrival, settled_radius(model) ** 2))
    rest = excess(scenario, 10.0 * np.exp(-np.arange(301) / 30.0))
    assert (rest[300] / rest[250]) ** 0.02 == pytest.approx(found["rate"], abs=1e-3)


def test_what_does_not_fade_is_not_forgotten() -> None:
    scenario = d3(1.1952, bernoulli(0.5), {"kind": "sine", "amplitude": 5.0, "period": 7.0}, **HOLD)
    assert said(scenario)["holds"] is None
    rest = excess(scenario, 5.0 * np.sin(2.0 * np.pi * np.arange(300) / 7.0))
    assert rest[250:].max() == pytest.approx(rest[150:200].max(), rel=1e-6)
    assert rest[250:].max() > 1.0


def test_a_constant_input_is_forgotten_in_truth_though_not_said() -> None:
    """No theorem is claimed there: None, not False."""
    scenario = d3(1.1952, bernoulli(0.5), {"kind": "constant", "value": [5.0]}, **HOLD)
    assert said(scenario)["holds"] is None
    assert excess(scenario, np.full(200, 5.0))[-1] == pytest.approx(0.0, abs=1e-9)


def test_bursts_that_never_end_forget_nothing() -> None:
    found = said(d3(1.1952, ENDLESS, FADING, **HOLD))
    assert found["holds"] is None
    assert found["reason"] == "the actuator holds, and control losses may never end"


@pytest.mark.parametrize(("control", "stable"), [(bernoulli(0.4), True), (MARKOV, None)])
def test_stability_is_said_where_a_bound_is_known(control: dict[str, Any], stable: bool | None) -> None:
    figures = analyze(d3(1.1952, control, {"kind": "sine", "amplitude": 5.0, "period": 7.0}, **HOLD))
    for verdict in (figures["control"], figures["bounds"]["upper"]):
        assert (verdict["stable"], verdict["theorem"]) == (stable, "S, held inputs")
    assert figures["bounds"]["lower"]["stable"] is True
    if stable:
        assert figures["bounds"]["upper"]["reason"] == "the recursion with every ACK, and 4 · ¼ U more noise"


@pytest.mark.parametrize(
    "changes",
    [{"links": {"ack": {"mode": "perfect"}}}, {"control": None}],
)
def test_where_every_fate_is_known_nothing_changes(changes: dict[str, Any]) -> None:
    control = changes.pop("control", MARKOV)
    held, zero = (analyze(d3(1.1952, control, FADING, **changes, **extra)) for extra in (HOLD, {}))
    assert held["control"] == zero["control"]
    assert held["convergence"] == zero["convergence"]


def test_feedback_has_no_bound_of_what_is_held() -> None:
    source = {"kind": "feedback", "gain": [[0.5, 0.0]]}
    figures = analyze(d3(1.1952, bernoulli(0.5), source, **HOLD))
    assert figures["control"]["stable"] is None
    assert figures["bounds"]["upper"]["reason"] == "u is fed back: no bound of what is held is known"
