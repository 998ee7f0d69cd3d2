"""D Theorem 3: the limit is the solution of the Riccati equation, and the expected covariance goes there."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from testbed.analysis.convergence import fading_of, settled
from testbed.analysis.verdicts import analyze
from testbed.channel.loss import Chain
from testbed.estimator.model import Model
from testbed.estimator.registry import create, model_of
from testbed.numerics.lanes import Floats
from testbed.scenario import Scenario, parse_scenario

FADING = {"kind": "exponential", "amplitude": 10.0, "tau": 30.0}
SIGMAS = [1.0541, 1.1952, 1.4142]


def d3(sigma: float, control: dict[str, Any] | None, source: dict[str, Any] | None = None, **rest: Any) -> Scenario:
    """D's example without losses of observations."""
    system = {"A": [[sigma, 0.5], [0.0, 0.1]], "B": [[1.0], [1.0]], "C": [[-1.0, 1.0]], "R": [[20.0]]}
    system |= {"Q": [[20.0, 0.0], [0.0, 20.0]]}
    links = {"control": {"loss": control}} if control else {}
    links |= rest.pop("links", {})
    extra = {"input": source} if source else {}
    return parse_scenario({"system": system, "links": links, "estimators": [{"name": "aoe"}], **extra, **rest})


def bernoulli(arrival: float) -> dict[str, Any]:
    return {"kind": "bernoulli", "arrival": arrival}


def said(scenario: Scenario) -> dict[str, Any]:
    found: dict[str, Any] = analyze(scenario)["convergence"]
    return found


@pytest.mark.parametrize("sigma", SIGMAS)
def test_the_limit_is_where_the_riccati_recursion_goes(sigma: float) -> None:
    scenario = d3(sigma, bernoulli(0.5), FADING)
    model = model_of(scenario)
    P = 1000.0 * np.eye(2)
    for _ in range(400):
        gain = P @ model.C.T @ np.linalg.inv(model.C @ P @ model.C.T + model.R)
        updated = P - gain @ model.C @ P
        P = model.A @ updated @ model.A.T + model.Q
    found = said(scenario)
    assert np.array(found["limit"]) == pytest.approx(P, rel=1e-9)
    assert found["limit_trace"] == pytest.approx(np.trace(P))
    assert found["updated_trace"] == pytest.approx(np.trace(updated))


def control_variance(model: Model, u: Floats, law: Chain) -> Floats:
    """tr of the variance of Σ_i 𝒜 … 𝒜 B ν_i u_i, k = 1, 2, …, summed over all pairs of ν_i, ν_j; gains of Pᴬ.

    Cov(ν_i, ν_j) = λ (1 − λ) r^|i−j|, r = 1 − recovery − failure, λ the stationary arrival probability.
    """
    assert model.B is not None
    P, terms, out = model.P0, np.zeros((0, model.n)), []
    rate, r = law.arrival, 1.0 - law.recovery - law.failure
    for k in range(len(u)):
        P = model.A @ P @ model.A.T + model.Q
        gain = P @ model.C.T @ np.linalg.inv(model.C @ P @ model.C.T + model.R)
        P = P - gain @ model.C @ P
        terms = np.vstack([terms @ model.A.T, model.B[:, 0] * u[k]])  # before the update, as D's P̄
        steps = np.arange(k + 1)
        covariances = rate * (1.0 - rate) * r ** np.abs(steps[:, None] - steps)
        out.append(float(np.einsum("in,ij,jn->", terms, covariances, terms)))
        terms = terms @ (np.eye(model.n) - gain @ model.C).T
    return np.array(out)


@pytest.mark.parametrize("sigma", SIGMAS)
@pytest.mark.parametrize("loss", [bernoulli(0.3), bernoulli(0.8), {"kind": "markov", "recovery": 0.2, "failure": 0.1}])
def test_the_auxiliary_covariance_goes_there_as_fast_as_said(sigma: float, loss: dict[str, Any]) -> None:
    """D's upper bound Pᵃ = P̄ᴬ + M (theory.md 3.3): M_k is below a constant times k² rate^k, and M_k → 0."""
    scenario = d3(sigma, loss, FADING)
    found, model = said(scenario), model_of(scenario)
    assert found["holds"]
    assert found["theorem"] == ("D Theorem 3" if model.control.independent else "D Theorem 3, for Markov losses")
    assert found["rate"] == pytest.approx(max(np.exp(-1 / 15), settled_radius(model) ** 2))
    k = np.arange(200)
    M = control_variance(model, 10.0 * np.exp(-k / 30.0), model.control)
    assert M[150:].max() < 1e-2 * M[:30].max()
    assert M[150:] / M[149:-1] == pytest.approx(np.full(50, found["rate"]), rel=1e-4)
    steady = control_variance(model, np.full(200, 10.0), model.control)
    assert steady[-1] == pytest.approx(steady[-50])
    assert steady[-1] > 1.0


def settled_radius(model: Model) -> float:
    """ρ(A (I − K C)) from the recursion's gain."""
    P = model.P0
    for _ in range(400):
        P = model.A @ P @ model.A.T + model.Q
        gain = P @ model.C.T @ np.linalg.inv(model.C @ P @ model.C.T + model.R)
        P = P - gain @ model.C @ P
    return float(np.abs(np.linalg.eigvals(model.A - model.A @ gain @ model.C)).max())


def mean_traces(scenario: Scenario, u: Floats, kind: str, lanes: int) -> Floats:
    """Mean over lanes of the estimator's own tr P_k, on simulated packets."""
    model = model_of(scenario)
    assert model.B is not None
    rng = np.random.default_rng(3)
    made = create(kind, model, lanes=lanes)
    x = rng.normal(size=(lanes, model.n)) @ np.linalg.cholesky(model.P0).T
    root_q, root_r, traces = np.linalg.cholesky(model.Q), np.linalg.cholesky(model.R), []
    for k in range(len(u)):
        nu = rng.random(lanes) < model.control.arrival
        x = x @ model.A.T + np.outer(nu * u[k], model.B[:, 0]) + rng.normal(size=x.shape) @ root_q.T
        y = x @ model.C.T + rng.normal(size=(lanes, model.p)) @ root_r.T
        out = made.step(np.full((lanes, 1), u[k]), y, np.ones(lanes, dtype=np.uint8))
        traces.append(float(np.trace(out.P, axis1=1, axis2=2).mean()))
    return np.array(traces)


@pytest.mark.parametrize("arrival", [0.2, 0.5, 0.9])
def test_aoe_and_oe_of_d3_reach_the_limit(arrival: float) -> None:
    """tr E[P_k] of AOE for every arrival rate of controls, and of the exact OE, whose input fades in 11 steps."""
    scenario = d3(1.1952, bernoulli(arrival), FADING)
    limit = said(scenario)["updated_trace"]
    traces = mean_traces(scenario, 30.0 * np.exp(-np.arange(250) / 30.0), "aoe", 300)
    assert traces[5:15].mean() > 1.05 * limit
    assert traces[-1] == pytest.approx(limit, rel=1e-3)
    quick = 30.0 * np.exp(-np.arange(11) / 1.0)
    exact = mean_traces(scenario, quick, "oe", 40)
    assert exact[1] > 1.05 * limit
    assert exact[-1] == pytest.approx(limit, rel=1e-2)
    steady = mean_traces(scenario, np.full(60, 30.0), "aoe", 300)
    assert steady[-10:].mean() > 1.05 * limit


@pytest.mark.parametrize(
    ("source", "holds", "reason"),
    [
        (FADING, True, "u tends to 0 exponentially"),
        ({"kind": "exponential", "offset": 1.0, "tau": 30.0}, None, "an offset that is not zero"),
        ({"kind": "constant", "value": [0.0]}, True, "u = 0"),
        ({"kind": "constant", "value": [1.0]}, None, "constant"),
        ({"kind": "sine", "period": 20}, None, "sine"),
        ({"kind": "sine", "period": 20, "amplitude": 0.0}, True, "u = 0"),
        ({"kind": "uniform", "low": -1.0, "high": 1.0}, None, "drawn afresh"),
        ({"kind": "uniform", "low": 0.0, "high": 0.0}, True, "u = 0"),
        ({"kind": "table", "values": [[0.0]] * 100}, None, "a table"),
        ({"kind": "feedback", "gain": [[0.1, 0.1]]}, None, "fed back"),
        (None, True, "u = 0"),
    ],
)
def test_the_input(source: dict[str, Any] | None, holds: bool | None, reason: str) -> None:
    scenario = d3(1.1952, bernoulli(0.5), source)
    found = said(scenario)
    assert (found["holds"], found["exponential"]) == (holds, holds is True)
    assert reason in found["reason"]
    assert (fading_of(scenario.input).vanishes is True) == (holds is True)
    assert (found["rate"] is None) == (holds is None)
    assert found["limit_trace"] > 0.0
    lossy = d3(1.1952, bernoulli(0.5), source, links={"observation": {"loss": bernoulli(0.9)}})
    assert (said(lossy)["holds"], said(lossy)["reason"], said(lossy)["limit"]) == (None, "observations are lost", None)


def test_with_every_ack_or_no_loss_the_input_does_not_matter() -> None:
    constant = {"kind": "constant", "value": [1.0]}
    for scenario in (d3(1.2, None, constant), d3(1.2, bernoulli(0.5), constant, links={"ack": {"mode": "perfect"}})):
        assert (said(scenario)["holds"], said(scenario)["theorem"]) == (True, "Kalman filter")
    assert said(d3(1.2, bernoulli(0.5), constant, links={"ack": {"mode": "link"}}))["holds"] is None


def test_the_slowest_channel_that_does_something_sets_the_pace() -> None:
    slow = {"kind": "exponential", "amplitude": [0.0, 1.0, 2.0], "tau": [500.0, 5.0, 20.0]}
    system = {"A": [[0.5]], "B": [[1.0, 1.0, 1.0]], "C": [[1.0]], "Q": [[1.0]], "R": [[1.0]]}
    scenario = parse_scenario({"system": system, "input": slow, "estimators": [{"name": "aoe"}]})
    assert fading_of(scenario.input).factor == pytest.approx(np.exp(-1 / 20.0))


def test_no_limit() -> None:
    """Not observed, and far too large numbers."""
    assert settled(np.diag([1.2, 0.5]), np.array([[0.0, 1.0]]), np.eye(2), np.eye(1)) is None
    assert settled(np.full((2, 2), 1e300), np.eye(2), np.eye(2), np.eye(2)) is None
    found = settled(np.zeros((2, 2)), np.eye(2), np.eye(2), np.eye(2))
    assert found is not None
    assert found.predicted == pytest.approx(np.eye(2))
