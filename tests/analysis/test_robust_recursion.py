"""RSEIO's pseudo-covariance as a product of symplectic matrices, held against the estimator (R Theorem 2)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from analysis.robust_systems import example_of_r, random_model
from testbed.analysis.homography import Homography, homographic, symplectic_form
from testbed.analysis.robust_recursion import RobustRecursion
from testbed.analysis.robust_windows import product
from testbed.estimator.model import Model
from testbed.estimator.registry import create
from testbed.numerics.lanes import Floats

CASES = [
    (seed, n, g, p, parameters, mu)
    for seed, (n, g, p, parameters) in enumerate([(1, 1, 1, 1), (2, 2, 1, 1), (2, 1, 2, 2), (3, 2, 1, 2), (4, 3, 2, 2)])
    for mu in (0.05, 0.5, 0.8, 0.99, 1.0)
]
PATTERN = (True, False, True, True, False, False, True, False)


def covariances(model: Model, mu: float, pattern: tuple[bool, ...]) -> list[Floats]:
    """P_{1|1}, P_{2|2}, … of the estimator itself, for the arrivals of ``pattern``."""
    made = create("rseio", model, lanes=1, options={"mu": mu})
    y = np.zeros((1, model.p))
    return [made.step(np.zeros((1, 0)), y, np.array([int(arrived)])).P[0] for arrived in pattern]


def off(found: Floats, wanted: Floats) -> float:
    return float(np.abs(found - wanted).max() / np.abs(wanted).max())


def recursion_of(model: Model, mu: float) -> RobustRecursion:
    return RobustRecursion.of(model, (1.0 - mu) / mu)


@pytest.mark.parametrize(("seed", "n", "g", "p", "parameters", "mu"), CASES)
def test_each_step_is_the_estimators(seed: int, n: int, g: int, p: int, parameters: int, mu: float) -> None:
    """By the map, and by Φ of R (10)."""
    model = random_model(seed, n, g, p, parameters)
    recursion, P = recursion_of(model, mu), model.P0
    for arrived, wanted in zip(PATTERN, covariances(model, mu, PATTERN), strict=True):
        assert off((recursion.arrived if arrived else recursion.lost)(P), wanted) < 1e-10
        assert off(homographic(recursion.pairs.hamiltonian(arrived), P), wanted) < 1e-10
        P = wanted


@pytest.mark.parametrize(("seed", "n", "g", "p", "parameters", "mu"), CASES)
def test_the_product_is_the_estimators(seed: int, n: int, g: int, p: int, parameters: int, mu: float) -> None:
    """R Corollary 1: P_{t|t} = Homographic(Φ_t … Φ_1, P_{0|0})."""
    model = random_model(seed, n, g, p, parameters)
    recursion, phi = recursion_of(model, mu), np.eye(2 * n)
    for t, wanted in enumerate(covariances(model, mu, PATTERN), start=1):
        phi = recursion.pairs.hamiltonian(PATTERN[t - 1]) @ phi
        assert off(homographic(phi, model.P0), wanted) < 1e-10 * np.linalg.cond(phi)
        assert off(product(recursion, PATTERN[:t])(model.P0), wanted) < 1e-10


@pytest.mark.parametrize(("seed", "n", "g", "p", "parameters", "mu"), CASES)
def test_both_matrices_are_symplectic_and_in_the_set_of_r(
    seed: int, n: int, g: int, p: int, parameters: int, mu: float
) -> None:
    """Φ'JΦ = J; Φ11 invertible, Φ12 Φ11' ≥ 0, Φ11' Φ21 ≥ 0; and Φ is the product of its three factors."""
    recursion, J = recursion_of(random_model(seed, n, g, p, parameters), mu), symplectic_form(n)
    for arrived in (True, False):
        phi = recursion.pairs.hamiltonian(arrived)
        assert np.abs(phi.T @ J @ phi - J).max() < 1e-10 * np.abs(phi).max() ** 2
        assert np.linalg.svd(phi[:n, :n], compute_uv=False)[-1] > 0.0
        for form in (phi[:n, n:] @ phi[:n, :n].T, phi[:n, :n].T @ phi[n:, :n]):
            assert np.abs(form - form.T).max() <= 1e-8 * np.abs(form).max()
            assert np.linalg.eigvalsh((form + form.T) / 2.0)[0] >= -1e-9 * np.abs(form).max()
        same = (recursion.arrived if arrived else recursion.lost).hamiltonian()
        assert off(phi, same) < 1e-8


def test_without_weight_it_is_the_kalman_filter() -> None:
    model = random_model(3, 3, 2, 1, 2)
    recursion = recursion_of(model, 1.0)
    predicted = model.A @ model.P0 @ model.A.T + model.Q
    gain = predicted @ model.C.T @ np.linalg.inv(model.C @ predicted @ model.C.T + model.R)
    assert off(recursion.arrived(model.P0), predicted - gain @ model.C @ predicted) < 1e-10
    assert pytest.approx(model.A) == recursion.pairs.A1


def test_a_singular_system_has_the_map_but_no_matrix() -> None:
    model = replace(random_model(5, 2, 2, 1, 1), A=np.array([[1.0, 2.0], [0.5, 1.0]]))
    recursion = recursion_of(model, 0.5)
    assert not recursion.invertible
    for wanted, t in zip(covariances(model, 0.5, PATTERN), range(1, len(PATTERN) + 1), strict=True):
        assert off(product(recursion, PATTERN[:t])(model.P0), wanted) < 1e-10
    with pytest.raises(np.linalg.LinAlgError):
        recursion.lost.hamiltonian()


def test_a_long_product_keeps_its_digits() -> None:
    """500 steps of R's example."""
    model = example_of_r(100.0)
    pattern = tuple(np.random.default_rng(1).random(500) < 0.8)
    whole: Homography = product(recursion_of(model, 0.8), pattern)
    assert off(whole(model.P0), covariances(model, 0.8, pattern)[-1]) < 1e-10
