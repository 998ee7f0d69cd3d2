"""Controllability, observability and its strong form, against their definitions."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from testbed.analysis.strong import strong_observability
from testbed.analysis.structure import controllability, covariance_root, observability, unstable_eigenvalues
from testbed.numerics.lanes import Floats

SEEDS = st.integers(0, 2**32 - 1)


def block_ranks(A: Floats, C: Floats) -> list[int]:
    """Rank of [C; CA; …; CA^{i−1}] for i = 1 … n."""
    n = A.shape[0]
    rows = [C @ np.linalg.matrix_power(A, i) for i in range(n)]
    return [int(np.linalg.matrix_rank(np.vstack(rows[: i + 1]))) for i in range(n)]


@settings(deadline=None, max_examples=100)
@given(SEEDS, st.integers(1, 5), st.integers(1, 3))
def test_observability_is_the_rank_of_the_stacked_matrix(seed: int, n: int, p: int) -> None:
    """Small integers, many of them zero, so that every rank occurs."""
    rng = np.random.default_rng(seed)
    A = rng.integers(-1, 2, (n, n)).astype(float)
    C = rng.integers(-1, 2, (p, n)).astype(float)
    ranks, found = block_ranks(A, C), observability(A, C)
    assert found.rank == ranks[-1]
    assert found.full == (ranks[-1] == n)
    if found.full:
        assert found.index == 1 + ranks.index(n)
    for value in found.failing:
        pencil = np.vstack([A - value * np.eye(n), C])
        assert np.linalg.svd(pencil, compute_uv=False)[-1] < 1e-3  # a Jordan block spreads its eigenvalues


@settings(deadline=None, max_examples=50)
@given(SEEDS, st.integers(1, 4))
def test_controllability_is_the_rank_of_the_powers(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    A = rng.integers(-1, 2, (n, n)).astype(float)
    G = rng.integers(-1, 2, (n, 1)).astype(float)
    powers = np.hstack([np.linalg.matrix_power(A, i) @ G for i in range(n)])
    assert controllability(A, G @ G.T).rank == np.linalg.matrix_rank(powers)


def test_the_eigenvalue_that_fails_is_named() -> None:
    found = observability(np.diag([1.2, 0.5, 1.1]), np.array([[1.0, 1.0, 0.0]]))
    assert not found.full
    assert found.failing == (pytest.approx(1.1),)
    assert not found.stable_rest
    assert observability(np.diag([1.2, 0.5]), np.array([[1.0, 0.0]])).stable_rest


def test_nothing_observed() -> None:
    found = observability(np.diag([0.5, 2.0]), np.zeros((1, 2)))
    assert (found.rank, found.index, sorted(v.real for v in found.failing)) == (0, 0, [0.5, 2.0])
    assert observability(np.zeros((2, 2)), np.eye(2)).index == 1


@pytest.mark.parametrize(("A", "C"), [(np.ones((2, 3)), np.ones((1, 3))), (np.eye(2), np.ones((1, 3)))])
def test_shapes_that_do_not_fit(A: Floats, C: Floats) -> None:
    with pytest.raises(ValueError, match="allowed"):
        observability(A, C)


@given(SEEDS, st.integers(1, 4))
def test_the_root_of_a_covariance(seed: int, n: int) -> None:
    half = np.random.default_rng(seed).normal(size=(n, max(1, n - 1)))
    root = covariance_root(half @ half.T)
    np.testing.assert_allclose(root @ root, half @ half.T, atol=1e-10)
    assert np.linalg.matrix_rank(root, tol=1e-6) == half.shape[1]


def rotation(radius: float, angle: float) -> Floats:
    c, s = math.cos(angle), math.sin(angle)
    return radius * np.array([[c, -s], [s, c]])


def definition_on_diagonal(values: list[float], C: Floats) -> bool:
    """M Definition 5 by brute force: every index set of equal moduli has full column rank."""
    n = len(values)
    for size in range(1, n + 1):
        for chosen in itertools.combinations(range(n), size):
            equal = len({abs(values[i]) for i in chosen}) == 1
            if equal and np.linalg.matrix_rank(C[:, list(chosen)]) < size:
                return False
    return True


@settings(deadline=None, max_examples=150)
@given(st.lists(st.sampled_from([1.5, -1.5, 1.2, 0.5, -0.5, 0.0]), min_size=1, max_size=4), st.integers(1, 3), SEEDS)
def test_strong_observability_is_its_definition_in_every_basis(values: list[float], p: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = len(values)
    C = rng.integers(-1, 2, (p, n)).astype(float)
    T = np.linalg.qr(rng.normal(size=(n, n)))[0] @ np.diag(rng.uniform(0.5, 2.0, n))
    expected = definition_on_diagonal(values, C)
    assert strong_observability(np.diag(values), C).holds == expected
    inverse = np.linalg.inv(T)
    assert strong_observability(T @ np.diag(values) @ inverse, C @ inverse).holds == expected


def test_a_rotation_needs_two_outputs() -> None:
    A = rotation(1.2, 0.7)
    seen = strong_observability(A, np.array([[1.0, 0.0]]))
    assert observability(A, np.array([[1.0, 0.0]])).full
    assert not seen.holds
    assert [abs(v) for v in seen.failing] == [pytest.approx(1.2)] * 2
    assert "quasi-equiblock" in seen.reason
    assert strong_observability(A, np.eye(2)).holds


@pytest.mark.parametrize("n", [2, 3, 4])
def test_a_jordan_block_is_not_diagonalisable(n: int) -> None:
    T = np.linalg.qr(np.random.default_rng(n).normal(size=(n, n)))[0]
    jordan = 1.1 * np.eye(n) + np.diag(np.ones(n - 1), 1)
    found = strong_observability(jordan, np.eye(n))
    assert not found.holds
    assert "not diagonalisable" in found.reason
    if n < 4:  # rounding spreads the eigenvalues of a larger one beyond the tolerance
        assert "not diagonalisable" in strong_observability(T @ jordan @ T.T, np.eye(n)).reason


def test_unstable_eigenvalues_come_largest_first() -> None:
    assert unstable_eigenvalues(np.diag([1.0, 1.1, -3.0, 0.2])) == (pytest.approx(-3.0), pytest.approx(1.1))
