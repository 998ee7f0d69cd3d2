"""Which part of a system is observed, and which part the noise reaches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from testbed.numerics.lanes import Floats

TOLERANCE = 1e-10
"""A direction counts if its singular value is above this, with A, C and sqrt(Q) scaled to norm one."""
_ROUNDING = 1e-14
MARGINAL = 1e-9
"""An eigenvalue is unstable if its modulus is above 1 by more than this."""


@dataclass(frozen=True)
class Reach:
    """What a chain of subspaces reaches.

    rank: dimension of the last of them; index: how many steps it took to get there (0 if the first is empty);
    failing: the eigenvalues of A on what is left out, where the test of Popov, Belevitch and Hautus fails.
    """

    rank: int
    index: int
    failing: tuple[complex, ...]

    @property
    def full(self) -> bool:
        return not self.failing

    @property
    def stable_rest(self) -> bool:
        """Whether everything left out decays: detectable, or stabilisable."""
        return all(abs(value) < 1.0 - MARGINAL for value in self.failing)


def observability(A: Floats, C: Floats) -> Reach:
    """Observability of (A, C), A (n, n), C (p, n); ``index`` is I0 of P Definition 4 where ``full``.

    The subspaces span{C', A'C', …} are held as orthonormal bases; ranks are by SVD with ``TOLERANCE``.
    Raises ValueError if the shapes do not fit.
    """
    n = A.shape[0]
    if A.shape != (n, n) or C.ndim != 2 or C.shape[1] != n:
        raise ValueError(f"got A {A.shape} and C {C.shape}; allowed: (n, n) and (p, n)")
    step = _scaled(A).T
    basis = new = _span(_scaled(C).T)
    index = int(basis.shape[1] > 0)
    while 0 < basis.shape[1] < n:
        image = step @ new
        new = _span(image - basis @ (basis.T @ image))
        if new.shape[1] == 0:
            break
        basis, index = _span(np.hstack([basis, new])), index + 1
    rest = np.linalg.svd(basis, full_matrices=True)[0][:, basis.shape[1] :] if basis.size else np.eye(n)
    failing = tuple(complex(value) for value in np.linalg.eigvals(rest.T @ A @ rest)) if rest.shape[1] else ()
    return Reach(basis.shape[1], index, failing)


def controllability(A: Floats, Q: Floats) -> Reach:
    """Controllability of (A, sqrt(Q)), A (n, n), Q (n, n) symmetric and positive semi-definite.

    By duality that of observability. Raises ValueError if the shapes do not fit.
    """
    return observability(A.T, covariance_root(Q).T)


def covariance_root(Q: Floats) -> Floats:
    """The symmetric S with S S = Q, (n, n); eigenvalues that are rounding, or negative, count as zero."""
    values, vectors = np.linalg.eigh((Q + Q.T) / 2.0)
    kept = np.where(values > len(values) * _ROUNDING * max(float(values[-1]), 0.0), values, 0.0)
    root: Floats = (vectors * np.sqrt(kept)) @ vectors.T
    return root


def unstable_eigenvalues(A: Floats) -> tuple[complex, ...]:
    """The eigenvalues of A (n, n) with modulus above 1 + ``MARGINAL``, largest first."""
    values = [complex(value) for value in np.linalg.eigvals(A)]
    return tuple(sorted((v for v in values if abs(v) > 1.0 + MARGINAL), key=abs, reverse=True))


def _scaled(matrix: Floats) -> Floats:
    largest = float(np.abs(matrix).max(initial=0.0))
    if largest == 0.0:
        return matrix
    scaled = matrix / largest  # no overflow in the norm
    result: Floats = scaled / np.linalg.norm(scaled, 2)
    return result


def _span(columns: Floats) -> Floats:
    """An orthonormal basis of what the columns span, (n, rank)."""
    left, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    basis: Floats = left[:, sizes > TOLERANCE]
    return basis
