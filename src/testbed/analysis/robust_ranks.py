"""The rank tests of R: which patterns of arrivals make RSEIO's recursion a strict contraction (Theorems 3 to 5).

Patterns are in the order of time, γ_1 first, and stand for the map Φ_N … Φ_1; R writes its theorems for Φ_1 … Φ_N, so
that its sequences t_i are ours from behind. R (14) has one row too many: in its proof (a.23) the term j = 0 stands for
an observation at t_0 = 0 that there is not. With A1 = [[1, 1], [0, 1]], H1 = [1, 0], one arrival does not determine the
state, though (14) has rank 2 for it. Here O_b has a block for each arrival.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from testbed.analysis.robust_recursion import Pairs
from testbed.analysis.structure import TOLERANCE
from testbed.numerics.lanes import Floats


@dataclass(frozen=True)
class Rank:
    """Rank of a matrix that should have rank ``wanted``.

    smallest: its singular value of number ``wanted``, in units of the largest one; 0 if there are not so many. What is
    above ``tolerance`` counts.
    """

    rank: int
    wanted: int
    smallest: float
    tolerance: float = TOLERANCE

    @property
    def full(self) -> bool:
        return self.rank == self.wanted


@dataclass(frozen=True)
class PairTest:
    """One of R's pairs, as text with its m, and the rank of its observability or controllability matrix."""

    name: str
    m: int
    rank: Rank


def rank_of(matrix: Floats, wanted: int) -> Rank:
    """Rank of a matrix (any shape) by its singular values; ``wanted`` is the larger one that it can have."""
    sizes = np.linalg.svd(matrix, compute_uv=False) if matrix.size else np.zeros(0)
    largest = float(sizes.max(initial=0.0))
    if largest == 0.0:
        return Rank(0, wanted, 0.0)
    ratios = sizes / largest
    return Rank(int((ratios > TOLERANCE).sum()), wanted, float(ratios[wanted - 1]) if len(ratios) >= wanted else 0.0)


def observation_matrix(pairs: Pairs, pattern: Sequence[bool]) -> Floats:
    """O_b of R (14) as corrected: H1, H1 A1 A2^{t_2−t_1−1}, …, a block for each arrival t_1 < t_2 < …, (·, n).

    It has full column rank if and only if the product of Φ is in R's 𝓗_l (Theorem 3). A1, A2 and H1 are scaled to norm
    one, which changes no rank.
    """
    A1, A2, H1 = _scaled(pairs.A1), _scaled(pairs.A2), _scaled(pairs.H1)
    n = A1.shape[0]
    blocks, power = [np.zeros((0, n))], None
    for arrived in pattern:
        if power is not None:
            power = (A1 if arrived else A2) @ power
        elif arrived:
            power = np.eye(n)
        if arrived and power is not None:
            blocks.append(H1 @ power)
    return np.vstack(blocks)


def noise_matrix(pairs: Pairs, pattern: Sequence[bool]) -> Floats:
    """C_n of R (15): [G_N, A_N G_{N−1}, A_N A_{N−1} G_{N−2}, …], with A1, G1 at an arrival, A2, G2 at a loss, (n, ·).

    It has full row rank if and only if the product of Φ is in R's 𝓗_r (Theorem 4). Scaled as `observation_matrix`. For
    the pairs of RSEIO its rank does not depend on the pattern: A1 = A2 + G2 K for some K, and G1, G2 span the same
    space. So n steps are enough if (A2, G2) is controllable, and no number of steps is if it is not.
    """
    A1, A2, G1, G2 = _scaled(pairs.A1), _scaled(pairs.A2), _scaled(pairs.G1), _scaled(pairs.G2)
    power = np.eye(A1.shape[0])
    blocks = [np.zeros((A1.shape[0], 0))]
    for arrived in reversed(pattern):
        blocks.append(power @ (G1 if arrived else G2))
        power = power @ (A1 if arrived else A2)
    return np.hstack(blocks)


def pattern_ranks(pairs: Pairs, pattern: Sequence[bool]) -> tuple[Rank, Rank]:
    """Ranks of O_b and C_n. Both full: the product is in 𝓗_lr, a contraction with a factor below 1 (R Lemma 2)."""
    n = pairs.A1.shape[0]
    return rank_of(observation_matrix(pairs, pattern), n), rank_of(noise_matrix(pairs, pattern), n)


def observability_pairs(pairs: Pairs) -> list[PairTest]:
    """R Theorem 5: one of (A1 A2^m, H1), m = 0 … n − 1, should be observable."""
    A1, A2 = _scaled(pairs.A1), _scaled(pairs.A2)
    return [
        PairTest("(A1 A2^m, H1)", m, _krylov_rank((A1 @ power).T, pairs.H1.T)) for m, power in enumerate(_powers(A2))
    ]


def controllability_pairs(pairs: Pairs) -> list[PairTest]:
    """R Theorem 5: one of (A1 A2^m, G1), (A2^m A1, G2), m = 0 … n − 1, or (A2, G2) should be controllable.

    R takes m > 0 in Theorem 5 and m ≥ 0 in its Corollary 2. The latter is right: G1 and G2 span the same space.
    """
    A1, A2 = _scaled(pairs.A1), _scaled(pairs.A2)
    out = []
    for m, power in enumerate(_powers(A2)):
        out.append(PairTest("(A1 A2^m, G1)", m, _krylov_rank(A1 @ power, pairs.G1)))
        out.append(PairTest("(A2^m A1, G2)", m, _krylov_rank(power @ A1, pairs.G2)))
    return [*out, PairTest("(A2, G2)", 1, _krylov_rank(A2, pairs.G2))]


def _krylov_rank(A: Floats, columns: Floats) -> Rank:
    """Rank of [B, A B, …, A^{n−1} B], A (n, n) and B (n, ·) scaled to norm one."""
    A, block = _scaled(A), _scaled(columns)
    blocks = []
    for _ in range(A.shape[0]):
        blocks.append(block)
        block = A @ block
    return rank_of(np.hstack(blocks), A.shape[0])


def _powers(A: Floats) -> list[Floats]:
    """I, A, …, A^{n−1}, each scaled to norm one."""
    out = [np.eye(A.shape[0])]
    while len(out) < A.shape[0]:
        out.append(_scaled(A @ out[-1]))
    return out


def _scaled(matrix: Floats) -> Floats:
    size = float(np.linalg.norm(matrix, 2)) if matrix.size else 0.0
    return matrix / size if size > 0.0 else matrix
