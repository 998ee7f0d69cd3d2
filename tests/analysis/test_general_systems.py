"""Systems for which no paper has an example: what analyze says of them, from hand calculation."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from testbed.analysis.verdicts import analyze
from testbed.scenario import parse_scenario

FIRST = [[1.0, 0.0, 0.0]]


def figures(A: list[list[float]], C: Any = FIRST, Q: Any = None, loss: Any = None) -> dict[str, Any]:
    n, p = len(A), len(C)
    system = {"A": A, "C": C, "Q": np.eye(n).tolist() if Q is None else Q, "R": np.eye(p).tolist()}
    links = {"observation": {"loss": loss or {"kind": "bernoulli", "arrival": 0.7}}}
    uncertainty = {"dA": [np.diag([0.0] * (n - 1) + [0.1]).tolist()], "delta": 1.0}
    return analyze(parse_scenario({"system": system, "links": links, "uncertainty": uncertainty}))


def test_several_unstable_eigenvalues() -> None:
    """A product of them from one output, in steps of n observations: 1 − 1/(1.2 · 1.1)² from above (Sinopoli)."""
    found = figures([[1.2, 1.0, 0.0], [0.0, 1.1, 1.0], [0.0, 0.0, 0.5]])
    assert [value for value, _ in found["unstable_eigenvalues"]] == pytest.approx([1.2, 1.1])
    assert (found["observable"], found["observability_index"]) == (True, 3)
    critical = found["critical_arrival"]
    assert (critical["lower"], critical["upper"]) == pytest.approx((1 - 1 / 1.44, 1 - (1.2 * 1.1) ** -2))
    assert critical["exact"] == critical["lower"]
    assert len(found["peak"]["d"]) == 2
    assert found["peak"]["d"][0] == pytest.approx(np.linalg.norm([[1.2, 1, 0], [0, 1.1, 1], [0, 0, 0.5]], 2) ** 2)
    assert 0.0 < found["peak"]["failure_max"] < 0.01
    assert found["robust"][0]["converges"] is True


def test_a_matrix_that_is_not_diagonalisable() -> None:
    found = figures([[1.1, 1.0, 0.0], [0.0, 1.1, 1.0], [0.0, 0.0, 1.1]])
    strong = found["strongly_observable"]
    assert not strong["holds"]
    assert strong["reason"] == "A is not diagonalisable: eigenvalue 1.1 has multiplicity 3 and 1 eigenvectors"
    assert [value for value, _ in strong["failing"]] == pytest.approx([1.1] * 3, abs=1e-4)
    assert found["critical_arrival"]["exact"] is None
    assert found["critical_arrival"]["upper"] == pytest.approx(1 - 1.1**-6, abs=1e-4)
    assert found["observation"]["theorem"] == "Sinopoli upper bound"


def test_a_block_of_equal_moduli_is_named() -> None:
    """A turn by a right angle beside an eigenvalue of its modulus: one output sees the three as one."""
    found = figures([[0.0, -1.1, 0.0], [1.1, 0.0, 0.0], [0.0, 0.0, 1.1]], [[1.0, 0.0, 1.0]])
    strong = found["strongly_observable"]
    assert (strong["holds"], len(strong["failing"]), found["observable"]) == (False, 3, True)
    assert "is not one-step observable: C has rank 1 on it, 3 needed" in strong["reason"]
    assert found["critical_arrival"]["upper"] == pytest.approx(1 - 1.1**-6)


def test_a_singular_matrix() -> None:
    """Two delays behind one unstable state: observed at once. R needs A invertible; its Lemma 3 does not."""
    found = figures([[1.2, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    assert found["critical_arrival"]["exact"] == pytest.approx(1 - 1 / 1.44)
    assert (found["observation"]["stable"], found["observation"]["theorem"]) == (True, "P Lemma 5")
    robust = found["robust"][0]
    assert (robust["converges"], robust["theorem"]) == (True, "R Lemma 3")
    assert (robust["pairs"], robust["pattern"]) == ([], None)
    assert robust["window"]["rate"] < 1.0
    nothing = figures(np.zeros((3, 3)).tolist())
    assert (nothing["observation"]["stable"], nothing["observability_index"]) == (True, None)
    assert nothing["robust"][0]["window"]["rate"] == 0.0


def test_what_is_not_observed() -> None:
    """Harmless where it decays, and fatal where it does not."""
    decays = figures(np.diag([1.2, 0.4, 0.5]).tolist())
    assert [value for value, _ in decays["unobservable_eigenvalues"]] == pytest.approx([0.4, 0.5])
    assert (decays["observation"]["stable"], decays["critical_arrival"]["exact"]) == (True, pytest.approx(1 - 1 / 1.44))
    assert decays["peak"]["reason"] == "(A, C) is not observable"
    grows = figures(np.diag([1.2, 1.1, 0.5]).tolist(), [[0.0, 1.0, 1.0]])
    assert [value for value, _ in grows["unobservable_eigenvalues"]] == pytest.approx([1.2])
    assert (grows["observation"]["stable"], grows["observation"]["theorem"]) == (False, "detectability")
    assert (grows["critical_arrival"]["upper"], grows["moments"]["finite_mean"]) == (None, False)
    blind = figures(np.diag([0.9, 0.4, 0.5]).tolist(), [[0.0, 0.0, 0.0]])
    assert (blind["observation"]["stable"], blind["robust"][0]["converges"]) == (True, None)
    assert not blind["robust"][0]["pattern"]["contracts"]


def test_what_no_noise_reaches() -> None:
    found = figures(np.diag([1.2, 0.4, 0.5]).tolist(), [[1.0, 1.0, 1.0]], np.diag([0.0, 1.0, 1.0]).tolist())
    assert [value for value, _ in found["uncontrollable_eigenvalues"]] == pytest.approx([1.2])
    assert (found["observation"]["stable"], found["convergence"]["holds"]) == (None, None)
    assert found["robust"][0]["reason"] == "no pair with G1 or G2 that was tested is controllable"


def test_twenty_states() -> None:
    rng = np.random.default_rng(0)
    found = figures((rng.normal(size=(20, 20)) * 0.3).tolist(), rng.normal(size=(2, 20)).tolist())
    assert found["observability_index"] == 10
    assert found["robust"][0]["converges"] is True
