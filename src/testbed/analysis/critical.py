"""The critical arrival rate: below it, independent losses of observations make the expected covariance diverge."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import schur

from testbed.analysis.moments import spectral_radius
from testbed.analysis.strong import strong_observability
from testbed.analysis.structure import MARGINAL, TOLERANCE, observability, unstable_eigenvalues
from testbed.numerics.lanes import Floats

RATE_TOLERANCE = 1e-6
"""Width of the bracket at which the bisection of the arrival rate ends."""
_ITERATIONS = 500
_REGULAR = (1e-8, 1e-5, 1e-3)
_SETTLED = 1e-11

_Complex = NDArray[np.complex128]


@dataclass(frozen=True)
class CriticalArrival:
    """λ_c lies in lower … upper (upper None: no arrival rate suffices, or none was found); ``exact`` if known.

    ``reason`` says why the exact value, or the upper bound, is what it is.
    """

    lower: float
    upper: float | None
    exact: float | None
    reason: str


def recovery_threshold(A: Floats) -> float:
    """max(0, 1 − ρ(A)^{-2}), A (n, n): the least of all critical rates (M Theorem 5, P Theorem 6 condition (i))."""
    rho = spectral_radius(A)
    return 1.0 - (1.0 / rho) ** 2 if rho > 1.0 + MARGINAL else 0.0


def critical_arrival(A: Floats, C: Floats) -> CriticalArrival:
    """Bounds of the critical arrival rate of (A, C), A (n, n), C (p, n), and its value where a theorem gives it.

    Lower bound 1 − ρ^{-2} and upper bound by the modified Riccati equation: Sinopoli et al. 2004, as cited by D. The
    bounds meet where C has full column rank on the unstable subspace, so for one unstable eigenvalue and for
    invertible C. For strongly observable systems the lower bound is the exact value (M Theorem 5).
    """
    lower = recovery_threshold(A)
    if not unstable_eigenvalues(A):
        return CriticalArrival(0.0, 0.0, 0.0, "no eigenvalue outside the unit circle")
    if not observability(A, C).stable_rest:
        return CriticalArrival(
            lower, None, None, "an eigenvalue that does not decay is not observed: no arrival rate suffices"
        )
    upper = riccati_bound(A, C)
    if observed_at_once(A, C):
        return CriticalArrival(lower, lower, lower, "C has full column rank on the unstable subspace")
    if upper is not None and upper <= lower + _SETTLED:
        return CriticalArrival(lower, lower, lower, "one unstable eigenvalue: the bounds meet")
    if strong_observability(A, C).holds:
        return CriticalArrival(lower, upper, lower, "strongly observable (M Theorem 5)")
    return CriticalArrival(lower, upper, None, "between 1 − ρ^{-2} and the bound of the modified Riccati equation")


def unstable_part(A: Floats, C: Floats) -> tuple[_Complex, _Complex]:
    """(A_u, C_u), shapes (m, m) and (p, m): A and C on the invariant subspace of the m eigenvalues with modulus
    1 or more, to ``MARGINAL``."""
    sorted_schur: Any = schur  # its stubs give the sort two arguments; here it gets one, complex
    triangle, basis, m = sorted_schur(A.astype(np.complex128), output="complex", sort=_lasting)
    return triangle[:m, :m], C @ basis[:, :m]


def _lasting(value: complex) -> bool:
    return abs(value) >= 1.0 - MARGINAL


def observed_at_once(A: Floats, C: Floats) -> bool:
    """Whether one observation determines the unstable part: C has full column rank on the unstable subspace."""
    Au, Cu = unstable_part(A, C)
    return bool(_rank(Cu) == Au.shape[0])


def riccati_bound(A: Floats, C: Floats) -> float | None:
    """The least arrival rate at which the modified algebraic Riccati equation of (A, C) has a solution.

    1 − Π|λ_u|^{-2} where C has rank one on the unstable subspace; else by bisection to
    ``RATE_TOLERANCE`` over `riccati_feasible`, from above. None if no rate up to 1 is feasible.
    """
    Au, Cu = unstable_part(A, C)
    m = Au.shape[0]
    if m == 0:
        return 0.0
    if not observability(A, C).stable_rest:
        return None
    rank = _rank(Cu)
    moduli = np.abs(np.diag(Au))
    if rank == m:
        return float(1.0 - moduli.max() ** -2.0)
    if rank == 1:
        return float(-np.expm1(-2.0 * np.log(moduli).sum()))
    low, high = float(1.0 - moduli.max() ** -2.0), 1.0
    while high - low > RATE_TOLERANCE:
        middle = (low + high) / 2.0
        if riccati_feasible(Au, Cu, middle):
            high = middle
        else:
            low = middle
    return high


def riccati_feasible(A: NDArray[Any], C: NDArray[Any], arrival: float) -> bool:
    """Whether some X > 0 with h(X) < X was found, A (n, n), C (p, n), real or complex.

    h(X) = A X A* − λ A X C*(C X C*)^{-1} C X A* = min_K [(1−λ) A X A* + λ (A+KC) X (A+KC)*], λ the arrival rate.
    Such an X proves that X = h(X) + Q with noise has a solution for every Q and R (Sinopoli et al. 2004, Theorem 5).
    X is sought by the power iteration of h, which is monotone, concave and homogeneous: X ← h(X) / tr h(X) + ε I, for
    several ε: a mode that hardly grows needs a large one. It ends with True at such an X; with False at an X where
    h(X) ≥ X, when X has settled, or after 500 steps. So True is proved, to rounding, and False is on the safe side for
    an upper bound.
    """
    return any(_found(A, C, arrival, regular) for regular in _REGULAR)


def _found(A: NDArray[Any], C: NDArray[Any], arrival: float, regular: float) -> bool:
    n = A.shape[0]
    _, sizes, right = np.linalg.svd(C, full_matrices=False)
    rows = right[sizes > TOLERANCE * sizes[0]]
    X: NDArray[Any] = np.eye(n, dtype=np.complex128) / n
    try:
        for _ in range(_ITERATIONS):
            XC = X @ rows.conj().T
            reduced = X - arrival * XC @ np.linalg.solve(rows @ XC, XC.conj().T)
            H = A @ reduced @ A.conj().T
            H = (H + H.conj().T) / 2.0
            half = np.linalg.solve(np.linalg.cholesky(X), H)
            ratios = np.linalg.eigvalsh(np.linalg.solve(np.linalg.cholesky(X), half.conj().T))
            if ratios[-1] < 1.0 - _SETTLED:
                return True
            if ratios[0] >= 1.0:
                return False
            following = H / np.trace(H).real + regular * np.eye(n)
            if np.abs(following - X).max() < _SETTLED:
                return False
            X = following
    except np.linalg.LinAlgError:
        return False
    return False


def _rank(matrix: _Complex) -> int:
    sizes = np.linalg.svd(matrix, compute_uv=False)
    return int((sizes > TOLERANCE * sizes.max(initial=0.0)).sum()) if sizes.size else 0
