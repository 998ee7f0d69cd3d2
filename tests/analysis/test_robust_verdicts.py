"""R Theorem 5: where its conditions hold, RSEIO's pseudo-covariance forgets its start."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import ks_2samp

from analysis.robust_systems import example_of_r
from testbed.analysis.riemann import riemannian_distance
from testbed.analysis.robust_ranks import PairTest, Rank
from testbed.analysis.robust_recursion import RobustRecursion
from testbed.analysis.robust_verdicts import theorem_5
from testbed.analysis.robust_windows import contraction_window, possible_patterns, product, shortest_contraction
from testbed.analysis.verdicts import analyze
from testbed.channel.loss import Chain
from testbed.errors import UsageError
from testbed.estimator.registry import create
from testbed.numerics.lanes import Floats
from testbed.scenario import parse_scenario

STARTS = (0.1, 1.0, 10.0, 100.0)
"""P_0 of R's second experiment, in units of I."""
R2: dict[str, Any] = {
    "system": {
        "A": [[0.9802, 0.0196], [0.0, 0.9802]],
        "C": [[1.0, -1.0]],
        "Q": [[1.9608, 0.0195], [0.0195, 1.9605]],
        "R": [[1.0]],
    },
    "uncertainty": {"dA": [[[0.0, 0.099], [0.0, 0.0]]], "delta": 10.0},
}
ARRIVAL = Chain.bernoulli(0.8)


def said(loss: dict[str, Any] | None = None, system: dict[str, Any] | None = None, **rest: Any) -> dict[str, Any]:
    links = {"observation": {"loss": loss}} if loss else {}
    table = {**R2, "system": {**R2["system"], **(system or {})}, "links": links, **rest}
    found: list[dict[str, Any]] = analyze(parse_scenario(table))["robust"]
    assert len(found) == 1
    return found[0]


def bernoulli(arrival: float) -> dict[str, Any]:
    return {"kind": "bernoulli", "arrival": arrival}


def pseudo_covariances(start: float, arrived: Any) -> Floats:
    """P_{k|k} (K, M, 2, 2) of R's example from ``start`` times I, arrivals (K, M)."""
    steps, lanes = arrived.shape
    made = create("rseio", example_of_r(start), lanes=lanes, options={"mu": 0.8})
    y, u = np.zeros((lanes, 1)), np.zeros((lanes, 0))
    return np.array([made.step(u, y, arrived[k]).P for k in range(steps)])


def test_four_starts_meet_on_the_same_losses() -> None:
    """δ falls to rounding, in the mean over lanes at least as fast as the window says, and never grows."""
    arrived = (np.random.default_rng(5).random((200, 40)) < 0.8).astype(np.uint8)
    runs = [pseudo_covariances(start, arrived) for start in STARTS]
    window = contraction_window(RobustRecursion.of(example_of_r(), 0.25), ARRIVAL, 8)
    for run, start in zip(runs[1:], STARTS[1:], strict=True):
        first = riemannian_distance(start * np.eye(2), STARTS[0] * np.eye(2))
        pairs = [zip(run[k], runs[0][k], strict=True) for k in (0, 1, 7, 39, 79, 199)]
        distances = np.array([[first] * 40, *([riemannian_distance(P, other) for P, other in pair] for pair in pairs)])
        assert (np.diff(distances[:6], axis=0) < 0.0).all()
        assert distances[-1].max() < 1e-7
        assert np.log(distances[4] / first).mean() < 40 * np.log(window.rate)


def test_four_starts_have_one_law_in_the_end() -> None:
    """R Figure 2: the entries of P have the same law from each start, on losses of their own; not so after one step."""
    rng = np.random.default_rng(6)
    ends = [pseudo_covariances(start, (rng.random((120, 400)) < 0.8).astype(np.uint8)) for start in STARTS]
    for i, j in ((0, 0), (0, 1), (1, 1)):
        for other in ends[1:]:
            assert ks_2samp(ends[0][-1, :, i, j], other[-1, :, i, j]).pvalue > 1e-3
        assert ks_2samp(ends[0][0, :, i, j], ends[3][0, :, i, j]).pvalue < 1e-6


def test_the_verdict_on_r2() -> None:
    found = said(bernoulli(0.8))
    assert (found["name"], found["mu"], found["converges"], found["theorem"]) == ("rseio", 0.8, True, "R Theorem 5")
    assert {(test["of"], test["pair"], test["m"]) for test in found["pairs"]} == {
        ("observable", "(A1 A2^m, H1)", 0),
        ("observable", "(A1 A2^m, H1)", 1),
        ("controllable", "(A1 A2^m, G1)", 0),
        ("controllable", "(A1 A2^m, G1)", 1),
        ("controllable", "(A2^m A1, G2)", 0),
        ("controllable", "(A2^m A1, G2)", 1),
        ("controllable", "(A2, G2)", 1),
    }
    assert all(test["rank"] == 2 and test["smallest"] > found["tolerance"] for test in found["pairs"])
    assert (found["pattern"]["arrivals"], found["pattern"]["contracts"]) == ("1", True)
    assert 0.0 < found["window"]["best"] < found["pattern"]["contraction"] < 1.0
    assert found["window"]["patterns"] == 256


def test_the_distance_is_that_of_the_start_to_the_fixed_point() -> None:
    P = np.eye(2)
    arrived = np.ones((300, 1), dtype=np.uint8)
    assert said(bernoulli(0.8))["distance"] == pytest.approx(
        riemannian_distance(P, pseudo_covariances(1.0, arrived)[-1, 0]), rel=1e-9
    )
    assert said(bernoulli(0.8), {"P0": [[1.0, 0.0], [0.0, 0.0]]})["distance"] is None


@pytest.mark.parametrize(
    ("loss", "system", "expected"),
    [
        (None, {}, (True, "R Theorem 5")),
        (bernoulli(0.01), {}, (True, "R Theorem 5")),
        (bernoulli(0.0), {}, (None, "R Theorem 5")),
        ({"kind": "markov", "recovery": 0.3, "failure": 0.1}, {}, (True, "R Theorem 5")),
        ({"kind": "markov", "recovery": 1.0, "failure": 0.1}, {}, (True, "R Lemma 3")),
        ({"kind": "markov", "recovery": 1.0, "failure": 1.0}, {}, (None, "R Theorem 5")),
        (bernoulli(0.8), {"A": [[0.0, 1.0], [0.0, 0.0]]}, (True, "R Lemma 3")),
        (bernoulli(0.8), {"A": [[0.0, 1.0], [0.0, 0.0]], "Q": [[0.0, 0.0], [0.0, 0.0]]}, (None, "R Theorem 5")),
        (bernoulli(0.8), {"A": [[0.5, 0.0], [0.0, 0.7]], "C": [[0.0, 1.0]]}, (None, "R Theorem 5")),
        (bernoulli(0.8), {"A": [[0.5, 0.0], [0.0, 0.7]], "Q": [[1.0, 0.0], [0.0, 0.0]]}, (None, "R Theorem 5")),
        (bernoulli(0.8), {"A": [[1e200, 0.0], [0.0, 1e200]]}, (None, "R Theorem 5")),
    ],
)
def test_where_the_conditions_hold(loss: dict[str, Any] | None, system: dict[str, Any], expected: Any) -> None:
    """R's dA, but where A has one state less: there the pairs must fail for the nominal system alone."""
    diagonal = system.get("A", [[1.0]])[0] == [0.5, 0.0]
    uncertainty = {"dA": [[[0.0, 0.0], [0.0, 0.1]]], "delta": 1.0} if diagonal else R2["uncertainty"]
    found = said(loss, system, uncertainty=uncertainty)
    assert (found["converges"], found["theorem"]) == expected
    assert found["reason"]


def test_a_loss_that_never_comes_proves_nothing() -> None:
    """A pair with m = 1 needs a loss between arrivals, and (A2, G2) needs losses alone."""
    full, short = Rank(2, 2, 0.5), Rank(1, 2, 0.0)
    seen = [PairTest("(A1 A2^m, H1)", 0, short), PairTest("(A1 A2^m, H1)", 1, full)]
    driven = [PairTest("(A1 A2^m, G1)", 0, short), PairTest("(A2, G2)", 1, full)]
    assert theorem_5(seen, driven, ARRIVAL)["converges"] is True
    assert theorem_5(seen, driven, Chain.lossless())["converges"] is None
    assert theorem_5(seen[1:] * 2, driven, Chain.lossless())["converges"] is None
    good = [PairTest("(A1 A2^m, H1)", 0, full)]
    assert theorem_5(good, driven, Chain.lossless())["converges"] is None
    assert theorem_5(good, good, Chain.lossless())["converges"] is True


def test_each_rseio_of_the_scenario_has_its_mu() -> None:
    specs = [{"name": "a", "kind": "rseio", "mu": 0.5}, {"name": "rse"}, {"name": "rseio"}]
    found = analyze(parse_scenario({**R2, "estimators": specs}))["robust"]
    assert [(entry["name"], entry["mu"]) for entry in found] == [("a", 0.5), ("rseio", 0.8)]
    assert found[0]["window"] != found[1]["window"]
    wrong = parse_scenario({**R2, "estimators": [{"name": "rseio", "mu": 2.0}]})
    with pytest.raises(UsageError, match=r"estimators\.rseio: .*mu: got 2"):
        analyze(wrong)
    assert analyze(parse_scenario({"system": R2["system"]}))["robust"] is None


@pytest.mark.parametrize("chain", [ARRIVAL, Chain.markov(0.3, 0.1), Chain.markov(1.0, 0.2), Chain.lossless()])
def test_patterns_have_the_law_of_the_chain(chain: Chain) -> None:
    """R Lemma 4 by the stationary law times the transitions, with γ̄ that law; impossible patterns are left out."""
    found = dict(possible_patterns(chain, 4))
    assert sum(found.values()) == pytest.approx(1.0)
    for pattern, chance in found.items():
        wanted = chain.arrival if pattern[0] else 1.0 - chain.arrival
        for before, after in itertools.pairwise(pattern):
            up = 1.0 - chain.failure if before else chain.recovery
            wanted *= up if after else 1.0 - up
        assert chance == pytest.approx(wanted)
    assert list(found.values()) == sorted(found.values(), reverse=True)
    assert len(found) == {1.0: 8, 0.3: 16, 0.8: 16}[chain.recovery] if chain.failure else 1


def test_the_window_is_the_mean_over_patterns() -> None:
    recursion, chain = RobustRecursion.of(example_of_r(), 0.25), Chain.markov(0.3, 0.1)
    window = contraction_window(recursion, chain, 4)
    factors = {pattern: product(recursion, pattern).contraction() for pattern, _ in possible_patterns(chain, 4)}
    assert window.best == min(factors.values())
    mean = sum(chance * np.log(factors[pattern]) for pattern, chance in possible_patterns(chain, 4))
    assert window.mean_log == pytest.approx(mean)
    assert window.rate == pytest.approx(np.exp(mean / 4))


def test_the_shortest_pattern() -> None:
    """Two arrivals for a state that one does not determine; none for one that no pattern does."""
    model = replace(example_of_r(), C=np.array([[1.0, 0.0]]), A=np.array([[0.9, 1.0], [0.0, 0.9]]), dA=())
    found = shortest_contraction(RobustRecursion.of(model, 0.0).pairs, ARRIVAL)
    assert (found.pattern, found.contracts, found.checked) == ((True, True), True, 3)
    rare = shortest_contraction(RobustRecursion.of(model, 0.0).pairs, Chain.markov(1.0, 1.0))
    assert (rare.pattern, rare.contracts) == ((True, False, True), True)
    hidden = replace(model, A=np.diag([0.9, 0.8]))
    never = shortest_contraction(RobustRecursion.of(hidden, 0.0).pairs, ARRIVAL, longest=3)
    assert (never.pattern, never.contracts, never.checked) == ((True, True, True), False, 14)
