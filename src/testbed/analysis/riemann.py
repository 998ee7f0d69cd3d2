"""The distance of covariances in which the robust recursion contracts (R)."""

from __future__ import annotations

import numpy as np
from scipy.linalg import eigh

from testbed.numerics.lanes import Floats


def riemannian_distance(P: Floats, Q: Floats) -> float:
    """δ(P, Q) = sqrt(Σ log² λ_i(P Q^{-1})), P and Q (n, n) symmetric positive definite (R).

    Raises numpy.linalg.LinAlgError if Q is not positive definite, ValueError if P is not.
    """
    values = np.asarray(eigh(P, Q, eigvals_only=True), dtype=np.float64)
    if values[0] <= 0.0:
        raise ValueError("P is not positive definite")
    return float(np.sqrt(np.sum(np.log(values) ** 2)))
