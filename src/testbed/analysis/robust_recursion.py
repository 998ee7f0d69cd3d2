"""RSEIO's pseudo-covariance as a product of symplectic matrices (R Theorems 1 and 2, Corollary 1)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from testbed.analysis.homography import Homography
from testbed.analysis.structure import TOLERANCE, covariance_root
from testbed.estimator.model import Model
from testbed.estimator.rseio import innovation_derivatives
from testbed.numerics.lanes import Floats


@dataclass(frozen=True, eq=False)
class RobustRecursion:
    """P_{t+1|t+1} as a map of P_{t|t}, for γ_{t+1} = 0 (``lost``) and γ_{t+1} = 1 (``arrived``).

    With S, T as in theory.md 3.7, W the covariance of w, G its entry (R's Q and B) and λ = (1 − μ)/μ, R Theorem 2 has

        Q̌ = (W^{-1} + λ T'T)^{-1},  Ǎ = A − λ G Q̌ T'S,  S̃'S̃ = λ S'(I + λ T W T')^{-1} S

    and its proof (a.19): γ = 1 is P ↦ (P^{-1} + S̃'S̃)^{-1}, then P ↦ Ǎ P Ǎ' + G Q̌ G', then the update by C and R.
    """

    A: Floats
    A_check: Floats
    G: Floats
    W: Floats
    Q_check: Floats
    S_tilde: Floats
    C_white: Floats

    @classmethod
    def of(cls, model: Model, weight: float) -> RobustRecursion:
        """``weight``: λ ≥ 0; with 0 it is KFIO's recursion. W may be singular.

        Raises numpy.linalg.LinAlgError where numbers overflow.
        """
        n = model.n
        G = np.eye(n) if model.G is None else model.G
        W = model.Q if model.W is None else model.W
        rows, _ = innovation_derivatives(model)
        S, T = np.sqrt(weight) * rows[:, :n], np.sqrt(weight) * rows[:, n:]
        Q_check = np.linalg.solve((np.eye(W.shape[0]) + W @ T.T @ T), W)
        Q_check = (Q_check + Q_check.T) / 2.0
        S_tilde = np.linalg.solve(np.linalg.cholesky(np.eye(len(T)) + T @ W @ T.T), S)
        C_white = np.linalg.solve(np.linalg.cholesky(model.R), model.C)
        return cls(model.A, model.A - G @ Q_check @ T.T @ S, G, W, Q_check, S_tilde, C_white)

    @cached_property
    def lost(self) -> Homography:
        return Homography.move(self.A, self.G @ self.W @ self.G.T)

    @cached_property
    def arrived(self) -> Homography:
        penalty = Homography.information(self.S_tilde.T @ self.S_tilde)
        move = Homography.move(self.A_check, self.G @ self.Q_check @ self.G.T)
        return penalty.then(move).then(Homography.information(self.C_white.T @ self.C_white))

    @property
    def invertible(self) -> bool:
        """Whether A and Ǎ are, as R asks; then so is Ã = Ǎ (I + Ǎ^{-1} G Q̌ G' Ǎ^{-T} S̃'S̃)."""
        return _regular(self.A) and _regular(self.A_check)

    @cached_property
    def pairs(self) -> Pairs:
        """Raises numpy.linalg.LinAlgError where Ǎ is singular."""
        B_tilde = np.linalg.solve(self.A_check, self.G)
        seen = self.S_tilde @ B_tilde @ self.Q_check
        spread = np.linalg.cholesky(np.eye(len(self.S_tilde)) + seen @ B_tilde.T @ self.S_tilde.T)
        penalty = np.linalg.solve(spread, np.linalg.solve(self.A_check.T, self.S_tilde.T).T)
        return Pairs(
            A1=self.A_check + self.G @ seen.T @ self.S_tilde,
            G1=self.G @ covariance_root(self.Q_check + seen.T @ seen),
            H1=np.vstack([penalty, self.C_white]),
            A2=self.A,
            G2=self.G @ covariance_root(self.W),
        )


@dataclass(frozen=True, eq=False)
class Pairs:
    """R's A^[1] = Ã, G^[1] = G Q̃^{1/2}, H^[1] = R̃^{-1/2} C̃, A^[2] = A, G^[2] = G W^{1/2} (after its Theorem 2).

    An arrival is P ↦ {[A1 P A1' + G1 G1']^{-1} + H1'H1}^{-1}, a loss is P ↦ A2 P A2' + G2 G2'.
    """

    A1: Floats
    G1: Floats
    H1: Floats
    A2: Floats
    G2: Floats

    def hamiltonian(self, arrived: bool) -> Floats:
        """Φ_{t+1} of R (10), (2n, 2n), with P_{t|t} = Homographic(Φ_t … Φ_1, P_{0|0}).

        Raises numpy.linalg.LinAlgError where A1, or A2, is singular.
        """
        move, noise = (self.A1, self.G1 @ self.G1.T) if arrived else (self.A2, self.G2 @ self.G2.T)
        back, n = np.linalg.inv(move).T, move.shape[0]
        information = self.H1.T @ self.H1 if arrived else np.zeros((n, n))
        return np.block(
            [[move, noise @ back], [information @ move, (np.eye(n) + information @ noise) @ back]],
        )


def _regular(matrix: Floats) -> bool:
    sizes = np.linalg.svd(matrix, compute_uv=False)
    return bool(sizes[-1] > TOLERANCE * sizes[0])
