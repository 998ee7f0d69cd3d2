"""The rank tests of R Theorems 3 and 4, held against the sets of matrices that they characterise."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from analysis.robust_systems import example_of_r, random_model
from testbed.analysis.homography import Homography
from testbed.analysis.robust_ranks import (
    Rank,
    controllability_pairs,
    observability_pairs,
    observation_matrix,
    pattern_ranks,
    rank_of,
)
from testbed.analysis.robust_recursion import Pairs, RobustRecursion
from testbed.analysis.robust_windows import product
from testbed.estimator.model import Model
from testbed.numerics.lanes import Floats


def definite(matrix: Floats) -> bool:
    values = np.linalg.eigvalsh((matrix + matrix.T) / 2.0)
    return bool(values[0] > 1e-9 * values[-1])


def hard_systems() -> list[Model]:
    """Systems in which some patterns determine the state and others do not."""
    base = random_model(0, 3, 1, 1, 1)
    chain = np.array([[0.9, 1.0, 0.0], [0.0, 0.8, 1.0], [0.0, 0.0, 0.7]])
    last, first = np.array([[0.0], [0.0], [1.0]]), np.array([[1.0, 0.0, 0.0]])
    plain = replace(base, A=chain, C=first, G=last, W=np.eye(1), Q=last @ last.T, R=np.eye(1), dA=(), dG=(), dC=())
    leak = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.4, 0.0, 0.0]])
    return [
        plain,
        replace(plain, dA=(leak,)),
        replace(plain, C=np.array([[0.0, 1.0, 0.0]])),
        replace(plain, C=np.array([[0.0, 1.0, 0.0]]), dA=(leak.T,)),
        replace(plain, dC=(np.array([[0.0, 0.0, 0.3]]),)),
        replace(plain, G=first.T, Q=first.T @ first),
        random_model(2, 3, 1, 1, 1),
        random_model(4, 2, 1, 1, 1),
    ]


@pytest.mark.parametrize("model", hard_systems())
def test_full_ranks_are_strict_contraction(model: Model) -> None:
    """O_b full ⇔ Φ11'Φ21 > 0, C_n full ⇔ Φ12Φ11' > 0, for the Φ of every pattern of up to 5 steps.

    The forms are congruent to G and E of the map, which keep more digits than Φ.
    """
    recursion = RobustRecursion.of(model, 0.5)
    seen = set()
    for steps in range(1, 6):
        for pattern in itertools.product((False, True), repeat=steps):
            observation, noise = pattern_ranks(recursion.pairs, pattern)
            whole = product(recursion, pattern)
            assert observation.full == definite(whole.G), pattern
            assert noise.full == definite(whole.E), pattern
            assert (observation.full and noise.full) == (whole.contraction() < 1.0), pattern
            seen.add((observation.full, noise.full))
    assert len(seen) > 1


def test_the_forms_of_r_for_short_patterns() -> None:
    """R's own sets 𝓗_l and 𝓗_r from Φ."""
    for model in hard_systems():
        recursion = RobustRecursion.of(model, 0.5)
        n = model.n
        for pattern in itertools.product((False, True), repeat=3):
            phi = np.eye(2 * n)
            for arrived in pattern:
                phi = recursion.pairs.hamiltonian(arrived) @ phi
            observation, noise = pattern_ranks(recursion.pairs, pattern)
            assert observation.full == definite(phi[:n, :n].T @ phi[n:, :n])
            assert noise.full == definite(phi[:n, n:] @ phi[:n, :n].T)


@pytest.mark.parametrize("seed", range(6))
def test_the_order_of_a_pattern_is_that_of_time(seed: int) -> None:
    """Pairs of no RSEIO, with many zeros, so that the ranks depend on the order of losses and arrivals."""
    rng = np.random.default_rng(seed)

    def sparse(rows: int, columns: int) -> Floats:
        return np.asarray(rng.normal(size=(rows, columns)) * (rng.random((rows, columns)) < 0.3))

    turn = np.eye(3)[[1, 2, 0]]
    pairs = Pairs(np.diag([1.0, 2.0, 3.0]) + sparse(3, 3), sparse(3, 1), sparse(1, 3), turn, np.eye(3)[:, :1])
    arrived = Homography.move(pairs.A1, pairs.G1 @ pairs.G1.T).then(Homography.information(pairs.H1.T @ pairs.H1))
    lost = Homography.move(pairs.A2, pairs.G2 @ pairs.G2.T)
    for pattern in itertools.product((False, True), repeat=4):
        whole = Homography.identity(3)
        for gamma in pattern:
            whole = whole.then(arrived if gamma else lost)
        observation, noise = pattern_ranks(pairs, pattern)
        assert (observation.full, noise.full) == (definite(whole.G), definite(whole.E)), pattern


@pytest.mark.parametrize("model", hard_systems())
def test_the_noise_of_rseio_reaches_the_same_whatever_is_lost(model: Model) -> None:
    """A1 = A2 + G2 K and G1, G2 span the same space: so C_n spans [G2, A2 G2, …, A2^{N−1} G2] for every pattern."""
    pairs = RobustRecursion.of(model, 0.5).pairs
    inside = np.linalg.pinv(pairs.G2)
    assert pairs.G2 @ inside @ (pairs.A1 - pairs.A2) == pytest.approx(pairs.A1 - pairs.A2, abs=1e-9)
    for steps in range(1, 5):
        ranks = {pattern_ranks(pairs, pattern)[1].rank for pattern in itertools.product((False, True), repeat=steps)}
        assert len(ranks) == 1


def test_one_arrival_is_not_two() -> None:
    """R (14) has the row H1 A1 too for one arrival, and so rank 2; the map does not contract."""
    one = np.eye(2)
    pairs = Pairs(np.array([[1.0, 1.0], [0.0, 1.0]]), one, np.array([[1.0, 0.0]]), one, one)
    assert np.linalg.matrix_rank(np.vstack([pairs.H1, pairs.H1 @ pairs.A1])) == 2
    assert observation_matrix(pairs, (True,)).shape == (1, 2)
    assert not pattern_ranks(pairs, (True,))[0].full
    assert pattern_ranks(pairs, (True, True))[0].full
    after = Homography.information(pairs.H1.T @ pairs.H1)
    once = Homography.move(pairs.A1, one).then(after)
    assert (once.contraction(), once.then(once).contraction() < 1.0) == (1.0, True)


@pytest.mark.parametrize("model", [*hard_systems(), example_of_r()])
def test_a_pair_that_passes_has_a_pattern_that_passes(model: Model) -> None:
    """R Corollary 2, with n arrivals: its proof takes n − 1."""
    pairs, n = RobustRecursion.of(model, 0.5).pairs, model.n
    for test in observability_pairs(pairs):
        pattern = ((True,) + (False,) * test.m) * n
        assert test.rank.full == pattern_ranks(pairs, pattern[::-1])[0].full
    for test in controllability_pairs(pairs):
        if "(A2, G2)" in test.name:
            pattern = (False,) * n
        else:
            pattern = ((False,) * test.m + (True,)) * n if "G2)" in test.name else ((True,) + (False,) * test.m) * n
        if test.rank.full:
            assert pattern_ranks(pairs, pattern[::-1])[1].full


def test_the_kalman_filter_has_its_own_pairs() -> None:
    """Without model error (A1 A2^0, H1) is (A, C) and (A2, G2) is (A, G W^{1/2}); m = 1 is (A², C)."""
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    model = replace(example_of_r(), A=turn, C=np.array([[1.0, 0.0]]), dA=())
    pairs = RobustRecursion.of(model, 0.5).pairs
    assert [test.rank.rank for test in observability_pairs(pairs)] == [2, 1]
    hidden = replace(model, A=np.diag([0.5, 0.7]))
    assert not any(test.rank.full for test in observability_pairs(RobustRecursion.of(hidden, 0.5).pairs))
    quiet = replace(model, A=np.diag([0.5, 0.7]), Q=np.diag([1.0, 0.0]))
    assert not any(test.rank.full for test in controllability_pairs(RobustRecursion.of(quiet, 0.5).pairs))


def test_rank() -> None:
    assert rank_of(np.diag([2.0, 1.0, 1e-13]), 3) == Rank(2, 3, 5e-14)
    assert rank_of(np.ones((1, 2)), 2) == Rank(1, 2, 0.0)
    assert rank_of(np.zeros((0, 2)), 2) == Rank(0, 2, 0.0)
