"""Verdicts name a theorem only where its premises hold."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from testbed.analysis.verdicts import analyze
from testbed.scenario import parse_scenario

M = {"A": [[1.2910, 0.0], [0.0, 1.005]], "C": [[1.0, -1.0], [0.0, 1.0]], "Q": [[20.0, 0.0], [0.0, 20.0]]}
M |= {"B": [[-1.0], [1.0]], "R": M["Q"]}
P3 = {"A": [[1.3, 0.3], [0.0, 1.2]], "C": [[1.0, 1.0]], "Q": [[1.0, 0.0], [0.0, 1.0]], "R": [[1.0]]}
ROTATION = {**P3, "A": [[0.0, -1.3], [1.3, 0.0]], "C": [[1.0, 0.0]]}
SCALAR = {"A": [[1.4]], "C": [[1.0]], "Q": [[1.0]], "R": [[1.0]]}


def markov(recovery: float, failure: float = 0.2) -> dict[str, Any]:
    return {"kind": "markov", "recovery": recovery, "failure": failure}


def bernoulli(arrival: float) -> dict[str, Any]:
    return {"kind": "bernoulli", "arrival": arrival}


def figures(system: dict[str, Any], loss: dict[str, Any] | None = None, **rest: Any) -> dict[str, Any]:
    links = {"observation": {"loss": loss}} if loss else {}
    links |= rest.pop("links", {})
    return analyze(parse_scenario({"system": system, "links": links, **rest}))


def of(found: dict[str, Any], key: str) -> tuple[bool | None, str]:
    return found[key]["stable"], found[key]["theorem"]


@pytest.mark.parametrize(
    ("system", "loss", "expected"),
    [
        (M, markov(0.41), (True, "M Theorem 5")),
        (M, markov(0.39), (False, "M Theorem 5")),
        (M, bernoulli(0.41), (True, "M Theorem 5")),
        (M, None, (True, "Kalman filter")),
        (SCALAR, markov(0.6), (True, "M Theorem 5")),
        (SCALAR, markov(0.32), (False, "M Theorem 5")),
        (SCALAR, markov(1 - 1 / 1.4**2), (None, "none")),
        (SCALAR, {**markov(0.6, 0.0), "start": 0.5}, (True, "P Lemma 5")),
        (SCALAR, {**markov(0.3, 0.0), "start": 0.5}, (False, "bound 1 − ρ^{-2}")),
        (P3, markov(0.65, 0.03), (True, "M Theorem 5")),
        ({**P3, "A": [[1.2, 1.0], [0.0, 1.2]], "C": [[1.0, 0.0], [0.0, 1.0]], "R": P3["Q"]}, markov(0.4), "P Lemma 5"),
        (ROTATION, bernoulli(0.3), (False, "Sinopoli lower bound")),
        (ROTATION, bernoulli(0.5), (None, "none")),
        (ROTATION, bernoulli(0.7), (True, "Sinopoli upper bound")),
        (ROTATION, markov(0.7), (None, "none")),
        (ROTATION, markov(0.3), (False, "bound 1 − ρ^{-2}")),
        ({**P3, "A": [[0.9, 0.0], [0.0, 0.2]], "C": [[0.0, 0.0]]}, bernoulli(0.0), (True, "ρ(A) < 1")),
        ({**P3, "A": [[1.3, 0.0], [0.0, 1.2]], "C": [[1.0, 0.0]]}, bernoulli(0.9), (False, "detectability")),
        ({**P3, "Q": [[0.0, 0.0], [0.0, 0.0]]}, bernoulli(0.2), (None, "none")),
        ({**P3, "A": [[1.0, 0.0], [0.0, 0.5]]}, bernoulli(0.1), (True, "M Theorem 5")),
    ],
)
def test_observation_losses(system: dict[str, Any], loss: dict[str, Any] | None, expected: Any) -> None:
    verdict = of(figures(system, loss), "observation")
    assert verdict == (expected if isinstance(expected, tuple) else (True, expected))


def hidden(to_bad: float, to_good: float, loss_good: float = 0.0, loss_bad: float = 1.0) -> dict[str, Any]:
    return {
        "kind": "gilbert-elliott",
        "to_bad": to_bad,
        "to_good": to_good,
        "loss_good": loss_good,
        "loss_bad": loss_bad,
    }


def four_state(to_good: float, to_pause: float, from_pause: float) -> dict[str, Any]:
    """θ is the probability that a loss in a burst is followed by another."""
    moves = {"to_good": to_good, "to_pause": to_pause, "from_pause": from_pause}
    return {"kind": "four-state", "to_burst": 0.05, "to_isolated": 0.02, **moves}


P3_C2 = {**P3, "C": [[1.0, 0.0], [0.0, 1.0]], "R": P3["Q"]}


@pytest.mark.parametrize(
    ("system", "loss", "expected"),
    [
        (SCALAR, hidden(0.1, 0.2, 0.1, 0.7), (False, "bursts")),
        (SCALAR, hidden(0.1, 0.5, 0.1, 0.7), (True, "bursts")),
        (P3_C2, hidden(0.1, 0.5, 0.1, 0.7), (True, "bursts")),
        (P3, hidden(0.1, 0.5, 0.1, 0.7), (True, "domination, M Theorem 5")),
        (P3, hidden(0.9, 0.9, 0.1, 0.5), (True, "domination, M Theorem 5")),
        (P3, hidden(0.9, 0.9, 0.1, 0.9), (None, "none")),
        (P3, hidden(0.1, 0.2, 0.1, 0.9), (False, "bursts")),
        (SCALAR, four_state(0.1, 0.05, 0.5), (False, "bursts")),
        (SCALAR, four_state(0.5, 0.2, 0.5), (True, "bursts")),
        (P3, four_state(0.5, 0.3, 0.3), (True, "domination, M Theorem 5")),
        (P3, four_state(0.5, 0.3, 0.9), (None, "none")),
        (ROTATION, hidden(0.1, 0.3, 0.05, 0.2), (True, "domination, Sinopoli upper bound")),
        (ROTATION, hidden(0.1, 0.3, 0.05, 0.6), (None, "none")),
        ({**P3, "A": [[0.9, 0.0], [0.0, 0.2]], "C": [[0.0, 0.0]]}, hidden(0.1, 0.2, 0.1, 0.9), (True, "ρ(A) < 1")),
    ],
)
def test_observation_losses_with_a_hidden_state(system: dict[str, Any], loss: dict[str, Any], expected: Any) -> None:
    found = figures(system, loss)
    assert of(found, "observation") == expected
    assert found["peak"]["stable"] is None
    assert json.dumps(found, allow_nan=False)


@pytest.mark.parametrize("system", [M, SCALAR, P3, ROTATION])
@pytest.mark.parametrize(("recovery", "failure"), [(0.3, 0.2), (0.65, 0.03), (0.8, 0.3)])
def test_a_hidden_state_that_is_the_fate_has_the_verdicts_of_the_chain(
    system: dict[str, Any], recovery: float, failure: float
) -> None:
    links = {"links": {"control": {"loss": markov(recovery, failure)}}} if "B" in system else {}
    chain = figures(system, markov(recovery, failure), **links)
    same = figures(system, hidden(failure, recovery), **links)
    assert {**same, "observation": {**same["observation"], "kind": "markov"}} == chain


@pytest.mark.parametrize("system", [M, P3])
def test_what_is_replayed_has_the_verdicts_of_the_assumed_law(system: dict[str, Any]) -> None:
    chain = markov(0.5, 0.125)
    expected = figures(system, chain)
    for loss in (
        {"kind": "trace", "fates": "0011111111"},
        {"kind": "scripted", "pattern": "1111001111"},
        {"kind": "scripted", "lost": [3], "assumed": chain},
    ):
        found = figures(system, loss)
        assert found["observation"].pop("kind") == loss["kind"]
        assert found == {**expected, "observation": {k: v for k, v in expected["observation"].items() if k != "kind"}}


@pytest.mark.parametrize(("to_good", "finite"), [(0.5, True), (0.05, False)])
def test_moments_with_a_hidden_state(to_good: float, finite: bool) -> None:
    """The tail of P(m losses in a row), summed with the growth of the covariance: P_m = a² P_{m−1} + q."""
    loss = hidden(0.1, to_good, 0.1, 0.75)
    found = figures({**SCALAR, "A": [[1.2]]}, loss)
    assert (found["moments"]["finite_mean"], found["moments"]["finite_variance"]) == (finite, finite)
    block = np.array([[0.9 * 0.1, 0.1 * 0.75], [to_good * 0.1, (1 - to_good) * 0.75]])
    tails = [np.linalg.matrix_power(block, m).sum(axis=1).max() * 1.2 ** (4 * m) for m in (40, 80)]
    assert (tails[1] < tails[0]) == finite


def test_control_losses_with_a_hidden_state() -> None:
    links = {"control": {"loss": hidden(0.1, 0.5, 0.1, 0.7)}}
    assert of(figures(M, markov(0.41), links=links), "control") == (True, "S, correlated")
    alternating = {"control": {"loss": hidden(1.0, 1.0, 0.1, 0.7)}}
    assert of(figures(M, markov(0.41), links=alternating), "control") == (None, "S, correlated")


def expected_trace(system: dict[str, Any], recovery: float, failure: float, steps: int) -> float:
    """Mean over 4000 lanes of tr P̄_k of the Kalman filter, the loss chain started at its stationary law."""
    rng = np.random.default_rng(7)
    A, C, Q, R = (np.array(system[key]) for key in ("A", "C", "Q", "R"))
    lanes = 4000
    P = np.broadcast_to(np.eye(len(A)), (lanes, *A.shape))
    arrived = rng.uniform(size=lanes) < recovery / (recovery + failure)
    for _ in range(steps):
        gain = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
        P = np.where(arrived[:, None, None], P - gain @ C @ P, P)
        P = A @ P @ A.T + Q
        arrived = rng.uniform(size=lanes) < np.where(arrived, 1 - failure, recovery)
    return float(np.trace(P, axis1=1, axis2=2).mean())


def test_the_verdicts_are_seen_in_the_covariance() -> None:
    for recovery, stable in ((0.8, True), (0.2, False)):
        assert of(figures(P3, markov(recovery)), "observation")[0] is stable
        ratio = expected_trace(P3, recovery, 0.2, 120) / expected_trace(P3, recovery, 0.2, 40)
        assert (ratio < 2.0) == stable


def test_control_losses_decide_nothing_while_u_is_bounded() -> None:
    source = {"kind": "exponential", "offset": 1.0, "amplitude": 1.0, "tau": 10.0}
    for recovery, stable in ((0.5, True), (0.3, False)):
        for loss, theorem in ((markov(0.1), "M Theorem 4"), (bernoulli(0.01), "D Theorem 2")):
            found = figures(M, markov(recovery), input=source, links={"control": {"loss": loss}})
            assert found["control"]["theorem"] == theorem
            assert (found["control"]["stable"], found["observation"]["stable"]) == (stable, stable)
        assert figures(M, markov(recovery), input=source)["bounds"]["upper"]["stable"] is stable


def test_a_closed_loop_is_not_decided_without_acks() -> None:
    closed = {"input": {"kind": "feedback", "gain": [[0.1, 0.1]]}, "estimators": [{"name": "aoe"}]}
    loss = {"control": {"loss": bernoulli(0.8)}, "observation": {"loss": markov(0.7)}}
    assert of(figures(M, links=loss, **closed), "control") == (None, "D Theorem 2")
    known = figures(M, links={**loss, "ack": {"mode": "perfect"}}, **closed)
    assert of(known, "control") == (True, "separation")
    assert known["bounds"]["upper"]["stable"] is None


def test_the_peak_of_p() -> None:
    found = figures(P3, markov(0.65, 0.03))["peak"]
    assert found["d"] == [pytest.approx(2.008121, abs=5e-7)]
    assert found["series"] == pytest.approx(6.433362, abs=5e-7)
    assert found["failure_max"] == pytest.approx(0.0407, abs=5e-5)
    assert (found["condition_i"], found["condition_ii"], found["stable"]) == (True, True, True)
    assert found["theorem"] == "P Theorem 6"
    above = figures(P3, markov(0.65, 0.05))["peak"]
    assert (above["condition_i"], above["condition_ii"], above["stable"]) == (True, False, None)
    below = figures(P3, markov(0.3, 0.03))["peak"]
    assert (below["condition_i"], below["series"], below["stable"]) == (False, None, None)


def test_the_peak_of_scalar_systems_and_of_invertible_c() -> None:
    assert of(figures(SCALAR, markov(0.6)), "peak") == (True, "P Theorem 8")
    assert of(figures(SCALAR, markov(0.32)), "peak") == (False, "P Theorem 8")
    assert figures(SCALAR, markov(0.6))["critical_recovery"] == pytest.approx(0.489796, abs=5e-7)
    assert of(figures(M, markov(0.5)), "peak") == (True, "P Corollary 7")
    assert figures(M)["peak"]["stable"] is None
    assert figures({**P3, "C": [[0.0, 0.0]]})["peak"]["d"] is None


def moments(system: dict[str, Any], loss: dict[str, Any] | None) -> tuple[bool | None, bool | None]:
    found = figures(system, loss)["moments"]
    return found["finite_mean"], found["finite_variance"]


def test_moments() -> None:
    assert moments(SCALAR, markov(0.32)) == (False, False)
    assert moments(SCALAR, markov(0.6)) == (True, False)
    assert moments(SCALAR, markov(0.8)) == (True, True)
    assert moments(M, markov(0.7, 0.3)) == (True, True)
    assert moments(P3, markov(0.9)) == (True, None)
    assert moments(ROTATION, markov(0.7)) == (None, None)
    assert moments(SCALAR, None) == (True, True)
    assert moments({**P3, "A": [[1.3, 0.0], [0.0, 1.2]], "C": [[1.0, 0.0]]}, None) == (False, False)
    assert moments({**SCALAR, "A": [[0.5]]}, bernoulli(0.1)) == (True, True)
    assert figures({**SCALAR, "A": [[0.5]]}, bernoulli(0.1))["moments"]["order"] is None


def test_noise_enters_through_g() -> None:
    system = {**P3, "A": [[1.3, 0.0], [0.0, 1.2]], "G": [[1.0], [0.0]], "Q": [[1.0]]}
    found = figures(system)
    assert not found["controllable"]
    assert found["uncontrollable_eigenvalues"] == [[pytest.approx(1.2), 0.0]]


@settings(deadline=None, max_examples=60)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(1, 4),
    st.integers(1, 3),
    st.sampled_from([1.0, 1e-160, 1e8, 1e100, 1e200, 1e300]),
    st.sampled_from([0.0, 1e-12, 0.5, 1.0]),
    st.sampled_from([1e-12, 0.3, 1.0]),
)
def test_any_scenario_gives_json(seed: int, n: int, p: int, scale: float, recovery: float, failure: float) -> None:
    rng = np.random.default_rng(seed)
    A = rng.integers(-2, 3, (n, n)) * scale
    system = {"A": A.tolist(), "C": rng.integers(-1, 2, (p, n)).tolist()}
    system |= {"Q": np.diag(rng.integers(0, 2, n)).tolist(), "R": np.eye(p).tolist()}
    rest: dict[str, Any] = {}
    if seed % 3 == 0:
        rest["uncertainty"] = {"dA": (rng.integers(-1, 2, (2, n, n)) * scale).tolist(), "delta": 1.0}
    found = figures(system, markov(recovery, failure), **rest)
    assert (found["robust"] is None) == (not rest)
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    order = found["moments"]["order"]
    if found["observation"]["stable"] and order is not None:
        assert order > 1
    if found["moments"]["finite_variance"]:
        assert found["moments"]["finite_mean"]
