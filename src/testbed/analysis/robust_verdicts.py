"""What R's theorems say of RSEIO in a scenario: whether its pseudo-covariance forgets where it started."""

from __future__ import annotations

from typing import Any

import numpy as np

from testbed.analysis.riemann import riemannian_distance
from testbed.analysis.robust_ranks import PairTest, Rank, controllability_pairs, observability_pairs
from testbed.analysis.robust_recursion import Pairs, RobustRecursion
from testbed.analysis.robust_windows import (
    LONGEST,
    Pattern,
    contraction_window,
    product,
    shortest_contraction,
)
from testbed.analysis.structure import TOLERANCE, covariance_root
from testbed.channel.loss import Chain
from testbed.errors import UsageError
from testbed.estimator.model import Model
from testbed.estimator.registry import create, model_of
from testbed.estimator.rseio import Rseio
from testbed.scenario import EstimatorSpec, Scenario

_KIND = Rseio.KIND
_DOUBLINGS = 60


def robust_figures(scenario: Scenario) -> list[dict[str, Any]] | None:
    """One table for each RSEIO of the scenario; for its default μ if there is none. None without [uncertainty].

    Raises UsageError where the options of an RSEIO are wrong.
    """
    if scenario.uncertainty is None:
        return None
    model = model_of(scenario)
    specs = [spec for spec in scenario.estimators if spec.kind == _KIND] or [EstimatorSpec(name=_KIND)]
    out = []
    for spec in specs:
        made = _made(spec, model)
        entry: dict[str, Any] = {"name": spec.name, "mu": made.mu}
        try:
            recursion = RobustRecursion.of(model, made.weight)
            chain = model.observation.as_chain
            if chain is None:
                reason = "R is about independent and Markov arrivals, not ones with a hidden state"
                out.append({**entry, **_NOTHING, **_answer(None, "R Theorem 5", reason)})
            else:
                out.append({**entry, **_figures(recursion, chain, model.P0)})
        except (np.linalg.LinAlgError, ValueError):
            out.append({**entry, **_NOTHING, **_answer(None, "R Theorem 5", "the numbers overflow")})
    return out


def _made(spec: EstimatorSpec, model: Model) -> Rseio:
    try:
        made = create(_KIND, model, lanes=1, options=spec.options)
    except UsageError as error:
        raise UsageError(f"estimators.{spec.name}: {error}") from None
    assert isinstance(made, Rseio)
    return made


_NOTHING: dict[str, Any] = {"tolerance": TOLERANCE, "pairs": [], "pattern": None, "window": None, "distance": None}


def _figures(recursion: RobustRecursion, chain: Chain, P0: Any) -> dict[str, Any]:
    out, n = dict(_NOTHING), recursion.A.shape[0]
    answer = _answer(None, "R Theorem 5", "A or Ǎ is singular")
    steps = min(LONGEST, 4 * n)
    if recursion.invertible:
        pairs = recursion.pairs
        seen, driven = observability_pairs(pairs), controllability_pairs(pairs)
        out["pairs"] = [_pair("observable", test) for test in seen] + [_pair("controllable", test) for test in driven]
        out["pattern"] = _pattern(recursion, pairs, chain)
        answer = theorem_5(seen, driven, chain)
    window = contraction_window(recursion, chain, steps)
    out["window"] = {
        "steps": window.steps,
        "patterns": window.patterns,
        "best": window.best,
        "mean_log": window.mean_log,
        "rate": window.rate,
    }
    if answer["converges"] is None and window.mean_log < -TOLERANCE and _keeps_definite(recursion) and mixes(chain):
        value = f"{window.mean_log:.3g} < 0" if window.best > 0.0 else "−∞"
        reason = f"E log of the contraction over {steps} steps is {value}; {answer['reason']}"
        answer = _answer(True, "R Lemma 3", reason)
    return {**out, "distance": start_distance(recursion, P0), **answer}


def theorem_5(seen: list[PairTest], driven: list[PairTest], chain: Chain) -> dict[str, Any]:
    """R Theorem 5, for A, Ǎ and Ã invertible, with the pairs that were tested.

    Arrivals i.i.d. with 0 < arrival < 1, or a Markov chain with both rates inside 0 … 1. R also allows arrival 1; then
    no loss occurs and the pairs must do without one: m = 0.
    """
    if chain.never_loses:
        seen, driven = ([test for test in tests if test.m == 0] for tests in (seen, driven))
    elif not (0.0 < chain.recovery < 1.0 and 0.0 < chain.failure < 1.0):
        return _answer(None, "R Theorem 5", "recovery and failure are not both inside 0 … 1")
    observable = next((test for test in seen if test.rank.full), None)
    controllable = next((test for test in driven if test.rank.full), None)
    if observable is None:
        return _answer(None, "R Theorem 5", "no pair (A1 A2^m, H1) that was tested is observable")
    if controllable is None:
        return _answer(None, "R Theorem 5", "no pair with G1 or G2 that was tested is controllable")
    reason = f"{_named(observable)} is observable, {_named(controllable)} controllable"
    return _answer(True, "R Theorem 5", reason)


def mixes(chain: Chain) -> bool:
    """Whether R Lemma 3 takes the chain of arrivals: irreducible and aperiodic, or constant."""
    moves = chain.recovery > 0.0 and chain.failure > 0.0 and chain.recovery + chain.failure < 2.0
    return chain.never_loses or moves


def start_distance(recursion: RobustRecursion, P0: Any) -> float | None:
    """δ(P_0, P*), P* the pseudo-covariance to which the recursion tends while nothing is lost; None if there is none.

    By doubling: the map of 2^60 steps, or the last one before it no longer changes.
    """
    many = recursion.arrived
    for _ in range(_DOUBLINGS):
        longer = many.then(many)
        settled = np.allclose(longer.E, many.E, rtol=1e-14, atol=0.0)
        many = longer
        if settled:
            break
    try:
        return riemannian_distance(np.asarray(P0), many.E) if many.contraction() < 1.0 else None
    except (np.linalg.LinAlgError, ValueError):
        return None


def _keeps_definite(recursion: RobustRecursion) -> bool:
    """Whether P > 0 stays so: δ is a distance of definite matrices."""
    root = recursion.G @ covariance_root(recursion.W)
    sizes = np.linalg.svd(root, compute_uv=False)
    return recursion.invertible or bool(len(sizes) == root.shape[0] and sizes[-1] > TOLERANCE * sizes[0])


def _pattern(recursion: RobustRecursion, pairs: Pairs, chain: Chain) -> dict[str, Any]:
    found = shortest_contraction(pairs, chain)
    return {
        "arrivals": shown_pattern(found.pattern),
        "checked": found.checked,
        "contracts": found.contracts,
        "O_b": _rank(found.observation),
        "C_n": _rank(found.noise),
        "contraction": product(recursion, found.pattern).contraction(),
    }


def shown_pattern(pattern: Pattern) -> str:
    """γ_1 γ_2 … as 0 and 1."""
    return "".join("1" if arrived else "0" for arrived in pattern)


def _answer(converges: bool | None, theorem: str, reason: str) -> dict[str, Any]:
    return {"converges": converges, "theorem": theorem, "reason": reason}


def _pair(of: str, test: PairTest) -> dict[str, Any]:
    return {"of": of, "pair": test.name, "m": test.m, **_rank(test.rank), "full": test.rank.full}


def _rank(rank: Rank) -> dict[str, Any]:
    return {"rank": rank.rank, "smallest": rank.smallest}


def _named(test: PairTest) -> str:
    return test.name if "m" not in test.name else f"{test.name} with m = {test.m}"
