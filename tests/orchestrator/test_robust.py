"""Runs with model error, and with noise received in place of lost observations."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from orchestrator.runs import figures, recorded, run
from testbed.estimator.packets import read_packets, replay
from testbed.estimator.registry import create, model_of
from testbed.orchestrator.recording import packets_of_recording
from testbed.scenario import Scenario, load_scenario, parse_scenario, to_dict

R1 = load_scenario(Path(__file__).parents[2] / "scenarios" / "robust.toml")
KINDS = ["kf", "kfio", "rse", "rsemm", "rseio"]


def scenario(**changes: Any) -> Scenario:
    return parse_scenario({**to_dict(R1), "steps": 30, "lanes": 6, "record": "all", **changes})


def links(on_loss: str) -> dict[str, Any]:
    return {"observation": {"loss": {"kind": "bernoulli", "arrival": 0.8}, "on_loss": on_loss}}


def test_the_scenario_is_the_papers_example() -> None:
    system = R1.system
    assert R1.uncertainty is not None
    np.testing.assert_allclose(R1.uncertainty.dA[0], np.outer([0.0198, 0.0], [0.0, 5.0]), rtol=1e-15)
    assert (system.G, R1.uncertainty.dG, R1.uncertainty.dC, R1.uncertainty.delta) == (None, (), (), 10.0)
    assert [spec.kind for spec in R1.estimators] == KINDS


def test_at_a_large_model_error_the_robust_estimator_that_knows_gamma_is_best(tmp_path: Path) -> None:
    """R's figure at δ = 10, μ = 0.8: RSEIO clearly best; KFIO better than KF."""
    summary = run(scenario(lanes=64, steps=60, record="none"), tmp_path)
    error = {
        name: float(np.mean([e for e in found.squared_error_mean if e is not None]))
        for name, found in summary.estimators.items()
    }
    assert error["rseio"] < 0.9 * min(error[name] for name in ("kf", "kfio", "rse", "rsemm"))
    assert error["kfio"] < error["kf"]


def test_what_is_received_in_place_of_a_lost_observation_is_its_noise(tmp_path: Path) -> None:
    given = scenario()
    run(given, tmp_path)
    found = recorded(tmp_path, 6, 30)
    sent, delivered = found["observation/sent"], found["observation/delivered"]
    lost = delivered["mask"] == 0
    assert 0 < lost.sum() < lost.size
    np.testing.assert_array_equal(delivered["y"][~lost], sent["y"][~lost])
    np.testing.assert_array_equal(delivered["y"][lost], sent["noise"][lost])
    assert "noise" not in delivered
    np.testing.assert_allclose(sent["noise"], sent["y"] - found["truth"]["x"] @ np.array(given.system.C).T, atol=1e-9)


def test_noise_in_place_of_lost_observations_is_nothing_to_those_that_know_gamma(tmp_path: Path) -> None:
    noise, nothing = (
        figures(run(scenario(links=links(on_loss)), tmp_path / on_loss))["estimators"]
        for on_loss in ("noise", "nothing")
    )
    for name in ("kfio", "rseio"):
        assert noise[name] == nothing[name]
    for name in ("kf", "rse", "rsemm"):
        assert noise[name] != nothing[name]
    assert {**nothing["kf"], "kind": "kfio"} == nothing["kfio"]
    assert {**nothing["rse"], "kind": "rseio"} == nothing["rseio"]


def test_no_packets_split_changes_a_figure(tmp_path: Path) -> None:
    whole = run(scenario(), tmp_path / "whole")
    for size in (1, 4):
        split = run(scenario(transport={"lanes_per_packet": size}), tmp_path / str(size))
        assert figures(split) == figures(whole)


@pytest.mark.parametrize("on_loss", ["noise", "nothing"])
def test_replay_gives_the_estimates_of_the_run(on_loss: str, tmp_path: Path) -> None:
    given = scenario(links=links(on_loss))
    run(given, tmp_path)
    model, found = model_of(given), recorded(tmp_path, 6, 30)
    lines = packets_of_recording(tmp_path / "recording.mcap", 2, perfect_acks=False)
    lost = found["observation/delivered"]["mask"][:, 2] == 0
    assert lost.any()
    for line, gone in zip(read_packets(lines, model), lost, strict=True):
        assert line.gamma == (0 if gone and on_loss == "noise" else None)
        assert (line.y is None) == (gone and on_loss == "nothing")
    for spec in given.estimators:
        made = create(spec.kind, model, lanes=1, options=spec.options)
        x_hat = [json.loads(out)["x_hat"] for out in replay(made, model, read_packets(lines, model), use_acks=False)]
        np.testing.assert_array_equal(x_hat, found[f"estimate/{spec.name}"]["x_hat"][:, 2])
