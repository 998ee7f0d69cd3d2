"""Maps of covariances by a symplectic matrix, and how much they contract the Riemannian distance δ (R section III).

R calls a (2n, 2n) matrix Φ Hamiltonian if Φ'JΦ = J, J = [[0, I], [−I, 0]]; others say symplectic. Its Homographic
transformation is P ↦ (Φ11 P + Φ12)(Φ21 P + Φ22)^{-1}.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from testbed.analysis.structure import TOLERANCE
from testbed.numerics.lanes import Floats


def homographic(phi: Floats, P: Floats) -> Floats:
    """(Φ11 P + Φ12)(Φ21 P + Φ22)^{-1}, Φ (2n, 2n), P (n, n). Raises numpy.linalg.LinAlgError without that inverse."""
    n = P.shape[0]
    above, below = phi[:n, :n] @ P + phi[:n, n:], phi[n:, :n] @ P + phi[n:, n:]
    return np.asarray(np.linalg.solve(below.T, above.T).T)


def symplectic_form(n: int) -> Floats:
    """J, (2n, 2n)."""
    zero, one = np.zeros((n, n)), np.eye(n)
    return np.block([[zero, one], [-one, zero]])


@dataclass(frozen=True)
class Homography:
    """P ↦ E + M (P^{-1} + G)^{-1} M', with M (n, n), and G, E (n, n) symmetric, positive semi-definite.

    Every Φ of R's set 𝓗 is such a map: M = Φ22^{-T}, G = Φ22^{-1} Φ21, E = Φ12 Φ22^{-1}. In this form P and M may be
    singular, and long products keep their digits, which products of Φ do not.
    """

    M: Floats
    G: Floats
    E: Floats

    @classmethod
    def identity(cls, n: int) -> Homography:
        return cls(np.eye(n), np.zeros((n, n)), np.zeros((n, n)))

    @classmethod
    def move(cls, A: Floats, Q: Floats) -> Homography:
        """P ↦ A P A' + Q."""
        return cls(A, np.zeros_like(A), Q)

    @classmethod
    def information(cls, gain: Floats) -> Homography:
        """P ↦ (P^{-1} + ``gain``)^{-1}, ``gain`` (n, n)."""
        return cls(np.eye(gain.shape[0]), gain, np.zeros_like(gain))

    def __call__(self, P: Floats) -> Floats:
        """The image of P (n, n)."""
        inner = np.linalg.solve((np.eye(P.shape[0]) + P @ self.G).T, self.M.T).T  # M (I + P G)^{-1}
        return _symmetric(self.E + inner @ P @ self.M.T)

    def then(self, later: Homography) -> Homography:
        """The map that does this one first: R Lemma 1, as the star product of two scattering layers."""
        through = np.linalg.solve((np.eye(self.M.shape[0]) + self.E @ later.G).T, later.M.T).T
        information = later.G @ np.linalg.solve(np.eye(self.M.shape[0]) + self.E @ later.G, self.M)
        return Homography(
            through @ self.M,
            _symmetric(self.G + self.M.T @ information),
            _symmetric(later.E + through @ self.E @ later.M.T),
        )

    def hamiltonian(self) -> Floats:
        """Φ (2n, 2n). Raises numpy.linalg.LinAlgError if M is singular: there is none then."""
        back = np.linalg.inv(self.M).T
        return np.block([[self.M + self.E @ back @ self.G, self.E @ back], [back @ self.G, back]])

    def contraction(self) -> float:
        """The least c with δ(f(P), f(P')) ≤ c δ(P, P') for all P, P' > 0: below 1 if G > 0 and E > 0.

        R (Lemma 2) says that there is such a c < 1, not which. δ does not change under congruence and inversion, so f
        may be replaced by P ↦ ((P + I)^{-1} + V)^{-1}, where V has the eigenvalues v of G M^{-1} E M^{-T}. The
        derivative of that map has the norm max_i p/((p+1)(1 + v_i (p+1))) at P = p I and no larger one at any other P
        with least v; the maximum over p is c = (√v + √(1+v))^{-2} = exp(−2 arsinh √v), v the least eigenvalue.

        1/v is the largest x'M'E^{-1}M x / x'G x, which holds for singular M too. A singular G, to ``TOLERANCE`` times
        its norm, gives 1, except where M takes what G does not see to 0, to the same tolerance: f does not depend on
        it. A singular E gives 1.
        """
        try:
            if not _definite(self.E):
                return 1.0
            sizes, vectors = np.linalg.eigh(self.G)
            seen = sizes > TOLERANCE * sizes[-1]
            lost = self.M @ vectors[:, ~seen]
            if not seen.any() or np.linalg.norm(lost) > TOLERANCE * np.linalg.norm(self.M):
                return 1.0 if self.M.any() else 0.0
            whitened = self.M @ (vectors[:, seen] / np.sqrt(sizes[seen]))
            inverse_v = float(np.linalg.eigvalsh(whitened.T @ np.linalg.solve(self.E, whitened))[-1])
        except (np.linalg.LinAlgError, ValueError):  # not finite
            return 1.0
        return math.exp(-2.0 * math.asinh(inverse_v**-0.5)) if inverse_v > 0.0 else 0.0


def _symmetric(matrix: Floats) -> Floats:
    result: Floats = (matrix + matrix.T) / 2.0
    return result


def _definite(matrix: Floats) -> bool:
    values = np.linalg.eigvalsh(matrix)
    return bool(values[0] > TOLERANCE * values[-1])
