"""Maps of covariances: composition, and the exact factor by which they contract the Riemannian distance."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from analysis.robust_systems import covariance
from testbed.analysis.homography import Homography, homographic, symplectic_form
from testbed.analysis.riemann import riemannian_distance
from testbed.numerics.lanes import Floats

SIZES = [(seed, n) for n in (1, 2, 3, 5) for seed in range(4)]


def random_map(rng: np.random.Generator, n: int, size: float = 1.0) -> Homography:
    return Homography(rng.normal(size=(n, n)), size * covariance(rng, n), size * covariance(rng, n))


def off(found: Floats, wanted: Floats) -> float:
    return float(np.abs(found - wanted).max() / np.abs(wanted).max())


@pytest.mark.parametrize(("seed", "n"), SIZES)
def test_three_forms_of_one_map(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    f, P = random_map(rng, n), covariance(rng, n)
    by_inverses = f.E + f.M @ np.linalg.inv(np.linalg.inv(P) + f.G) @ f.M.T
    assert off(f(P), by_inverses) < 1e-10
    assert off(homographic(f.hamiltonian(), P), by_inverses) < 1e-9


@pytest.mark.parametrize(("seed", "n"), SIZES)
def test_the_matrices_multiply_as_the_maps_compose(seed: int, n: int) -> None:
    """R Lemma 1; the factors and the product are symplectic."""
    rng = np.random.default_rng(seed)
    first, second, P = random_map(rng, n), random_map(rng, n), covariance(rng, n)
    both = first.then(second)
    assert off(both(P), second(first(P))) < 1e-10
    phi = second.hamiltonian() @ first.hamiltonian()
    assert off(both.hamiltonian(), phi) < 1e-9
    J = symplectic_form(n)
    assert np.abs(phi.T @ J @ phi - J).max() < 1e-9 * np.abs(phi).max() ** 2


def test_singular_maps_and_singular_covariances() -> None:
    """A covariance of rank one, moved by a singular matrix, and the product with an update."""
    f = Homography(np.array([[1.0, 0.0], [0.0, 0.0]]), np.diag([0.5, 0.0]), np.diag([0.0, 2.0]))
    assert f(np.diag([1.0, 0.0])) == pytest.approx(np.diag([1.0 / 1.5, 2.0]))
    again = f.then(f)
    assert again(np.diag([1.0, 0.0])) == pytest.approx(f(f(np.diag([1.0, 0.0]))))
    with pytest.raises(np.linalg.LinAlgError):
        f.hamiltonian()


def steepest(f: Homography, rng: np.random.Generator, n: int) -> float:
    """The largest δ(f(P), f(P'))/δ(P, P') that a search over P = e^X and P' near it finds."""

    def exponential(packed: Floats) -> Floats:
        X = np.zeros((n, n))
        X[np.triu_indices(n)] = packed
        values, vectors = np.linalg.eigh(X + X.T)
        return np.asarray((vectors * np.exp(np.clip(values, -30.0, 30.0))) @ vectors.T)

    half = n * (n + 1) // 2

    def loss(packed: Floats) -> float:
        P = exponential(packed[:half])
        root = np.linalg.cholesky(P)
        direction = packed[half:] / np.linalg.norm(packed[half:])
        other = root @ exponential(1e-3 * direction) @ root.T
        return -riemannian_distance(f(other), f(P)) / riemannian_distance(other, P)

    starts = [rng.normal(size=2 * half) for _ in range(3)]
    return max(-minimize(loss, start, method="Nelder-Mead", options={"maxfev": 1500}).fun for start in starts)


@pytest.mark.parametrize(("seed", "n", "size"), [(0, 1, 1.0), (1, 1, 0.05), (2, 2, 0.3), (3, 2, 0.03), (4, 2, 3.0)])
def test_the_contraction_is_the_best_factor(seed: int, n: int, size: float) -> None:
    """No pair of covariances exceeds it, and a search comes as near to it as it likes."""
    rng = np.random.default_rng(seed)
    f = random_map(rng, n, size)
    factor = f.contraction()
    assert 0.0 < factor < 1.0
    assert steepest(f, rng, n) == pytest.approx(factor, rel=2e-3)


@pytest.mark.parametrize(("seed", "n"), SIZES)
def test_no_pair_exceeds_the_contraction(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    f = random_map(rng, n, 0.01)
    for _ in range(50):
        P, other = (covariance(rng, n) * 10.0 ** rng.uniform(-3, 3) for _ in range(2))
        assert riemannian_distance(f(P), f(other)) <= f.contraction() * riemannian_distance(P, other) * (1 + 1e-9)


@pytest.mark.parametrize(("seed", "n"), SIZES)
def test_products_contract_at_least_as_their_factors(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    first, second = random_map(rng, n, 0.1), random_map(rng, n, 0.1)
    assert first.then(second).contraction() <= first.contraction() * second.contraction() * (1 + 1e-9)


def test_what_is_forgotten_need_not_be_seen() -> None:
    """M = [[0, 1], [0, 0]] takes the first state to 0: the map is that of the second state alone."""
    forgets = Homography(np.array([[0.0, 1.0], [0.0, 0.0]]), np.diag([0.0, 0.4]), np.diag([0.5, 0.3]))
    alone = Homography(np.eye(1), np.array([[0.4]]), np.array([[0.5]]))
    assert forgets.contraction() == pytest.approx(alone.contraction())
    assert steepest(forgets, np.random.default_rng(0), 2) <= alone.contraction() * (1 + 1e-9)
    keeps = Homography(np.eye(2), np.diag([0.0, 0.4]), np.eye(2))
    assert keeps.contraction() == 1.0
    nothing = Homography(np.zeros((2, 2)), np.zeros((2, 2)), np.eye(2))
    assert nothing.contraction() == 0.0


def test_a_move_alone_and_an_update_alone_do_not_contract() -> None:
    assert Homography.move(0.5 * np.eye(2), np.eye(2)).contraction() == 1.0
    assert Homography.information(np.eye(2)).contraction() == 1.0
    assert Homography.information(np.diag([1.0, 0.0])).then(Homography.move(np.eye(2), np.eye(2))).contraction() == 1.0


def test_the_scalar_factor_by_hand() -> None:
    """f(p) = (p + 1)/(1 + v(p + 1)): the largest p f'(p)/f(p) over p."""
    v = 0.7
    f = Homography.move(np.eye(1), np.eye(1)).then(Homography.information(np.array([[v]])))
    p = np.geomspace(1e-3, 1e3, 100_001)
    slope = p / ((p + 1.0) * (1.0 + v * (p + 1.0)))
    assert f.contraction() == pytest.approx(slope.max(), rel=1e-6)
