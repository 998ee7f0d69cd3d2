"""Whole runs with an actuator that holds: estimators are consistent, and bounds bound."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from orchestrator.runs import BERNOULLI, MARKOV, figures, recorded, run, scenario, tables
from testbed.errors import UsageError
from testbed.estimator.registry import model_of
from testbed.orchestrator.preflight import check_parts
from testbed.orchestrator.summary import Summary
from testbed.scenario import parse_scenario

STEPS, LANES = 40, 240
EXACT = [
    {"name": "kfio", "acks": "perfect"},
    {"name": "oe", "acks": "none", "until": 9},
    {"name": "oe-acks", "kind": "oe-exact", "until": 12},
    {"name": "gpb", "acks": "none", "order": 2},
    {"name": "gpb-acks", "kind": "gpb", "order": 2},
    {"name": "lmmse", "acks": "none"},
    {"name": "lmmse-acks", "kind": "lmmse"},
    {"name": "ff", "acks": "none"},
]


def held(**changes: Any) -> dict[str, Any]:
    return {"actuator": {"on_loss": "hold"}, "steps": STEPS, "lanes": LANES, "record": "none", **changes}


@pytest.fixture(scope="module")
def summary(tmp_path_factory: pytest.TempPathFactory) -> Summary:
    return run(scenario(**held(estimators=[*EXACT, {"name": "aoe", "acks": "none"}])), tmp_path_factory.mktemp("held"))


def test_the_squared_error_is_what_p_says(summary: Summary) -> None:
    """In the mean over the steps, each within four standard errors; the steps are correlated, so no less is asked."""
    assert all(check.ok for check in summary.checks), summary.checks
    for spec in EXACT:
        found = summary.estimators[spec["name"]]
        run_for = spec.get("until", STEPS)
        excess = np.array(found.excess_mean[:run_for], dtype=float)
        error = np.array(found.excess_stderr[:run_for], dtype=float)
        assert np.abs(excess / error).max() < 4.5, spec
        assert abs(excess.mean()) < 4.0 * error.mean(), spec


def test_to_take_a_held_input_for_none_is_found_out(tmp_path: Path) -> None:
    """The same estimators told of zero are inconsistent: the check above can fail."""
    given = scenario(**held(estimators=[{"name": "gpb", "acks": "none", "order": 2}]))
    wrong = given.model_copy(update={"actuator": given.actuator.model_copy(update={"on_loss": "zero"})})
    plants = pytest.MonkeyPatch()
    with plants.context() as patch:
        patch.setattr("testbed.estimator.service.model_of", lambda _: model_of(wrong))
        found = run(given, tmp_path).estimators["gpb"]
    ratio = np.array(found.excess_mean[5:], dtype=float) / np.array(found.excess_stderr[5:], dtype=float)
    assert np.abs(ratio).max() > 6.0


def test_the_bounds_are_on_either_side(summary: Summary) -> None:
    assert summary.bounds is not None
    upper = summary.bounds.valid_upper_mean
    assert upper is not None
    for name in ("oe", "gpb", "lmmse", "ff"):
        means = summary.estimators[name].trace_P_mean
        for low, mean, high in zip(summary.bounds.lower_mean, means, upper, strict=True):
            if mean is not None:
                assert low is not None
                assert high is not None
                assert low <= mean * (1.0 + 1e-9)
                assert mean <= high
    assert {check.name for check in summary.checks} >= {"oe within bounds", "aoe within bounds"}
    texts = {check.name: check.text for check in summary.checks}
    assert texts["oe within bounds"].startswith("mean tr P between Pᴬ and S")
    assert texts["aoe within bounds"].startswith("mean tr P above Pᴬ")


def test_no_upper_bound_and_a_reason_where_losses_are_correlated(tmp_path: Path) -> None:
    links = {**tables()["links"], "control": {"loss": MARKOV}}
    estimators = [{"name": name, "acks": "none"} for name in ("aoe", "imm", "gpb")]
    found = run(scenario(**held(steps=20, links=links, estimators=estimators)), tmp_path)
    assert found.bounds is not None
    assert found.bounds.valid_upper_mean is None
    assert found.bounds.upper_mean is None
    assert found.bounds.upper_reason == 'with on_loss = "hold" a bound is known for i.i.d. control losses only'
    assert all(check.ok for check in found.checks)


@pytest.mark.parametrize("loss", [BERNOULLI, MARKOV])
def test_the_plant_applies_the_newest_input_that_arrived(tmp_path: Path, loss: dict[str, Any]) -> None:
    """x_{k+1} − A x_k − B a_k is the process noise, the same as that of the run with zero on loss."""
    links = {**tables()["links"], "control": {"loss": loss}}
    noises = []
    for on_loss in ("hold", "zero"):
        given = scenario(links=links, actuator={"on_loss": on_loss}, estimators=[{"name": "aoe"}])
        run(given, tmp_path / on_loss)
        packets = recorded(tmp_path / on_loss, 6, 20)
        x, nu, u = packets["truth"]["x"], packets["truth"]["nu"], packets["control/sent"]["u"]
        applied = nu[..., None] * u
        if on_loss == "hold":
            for lane in range(6):
                for k in range(20):
                    came = np.flatnonzero(nu[: k + 1, lane])
                    applied[k, lane] = u[came[-1], lane] if len(came) else 0.0
        A, B = np.array(given.system.A), np.array(given.system.B)
        noises.append(x[1:] - x[:-1] @ A.T - applied[1:] @ B.T)
    np.testing.assert_allclose(*noises, atol=1e-11)


def test_in_a_closed_loop_too(tmp_path: Path) -> None:
    source = {"kind": "feedback", "gain": [[0.6, 0.3]], "estimator": "gpb"}
    estimators = [{"name": "gpb", "acks": "none", "order": 2}, {"name": "kfio", "acks": "perfect"}]
    found = run(scenario(**held(input=source, estimators=estimators)), tmp_path)
    for name in ("gpb", "kfio"):
        excess = np.array(found.estimators[name].excess_mean, dtype=float)
        assert np.abs(excess / np.array(found.estimators[name].excess_stderr, dtype=float)).max() < 4.5


def test_where_nothing_is_lost_the_run_is_that_of_zero(tmp_path: Path) -> None:
    links = {**tables()["links"], "control": {"loss": {"kind": "none"}}}
    estimators = [{"name": name, "acks": "none"} for name in ("aoe", "gpb", "lmmse", "kfio")]
    both = [
        figures(run(scenario(links=links, bounds=False, estimators=estimators, actuator={"on_loss": how}), tmp_path))
        for how in ("hold", "zero")
    ]
    assert both[0] == both[1]


def test_what_cannot_run_is_refused_before_the_run() -> None:
    def refused(**spec: Any) -> str:
        with pytest.raises(UsageError) as error:
            check_parts(parse_scenario(tables(**held(estimators=[spec]))))
        return str(error.value)

    assert refused(name="kfio", acks="none").startswith("estimators.kfio: kfio needs every ACK and gets none")
    assert refused(name="oe", acks="none").endswith("allowed: until = 16 or less, a larger max_histories, ACKs, or gpb")
