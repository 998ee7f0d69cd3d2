"""The peak covariance: the prediction covariance at the end of a burst of losses (P)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from testbed.analysis.moments import spectral_radius
from testbed.numerics.lanes import Floats

SERIES_TOLERANCE = 1e-12
"""The series ends when the bound of its tail is below this part of its sum."""
_TERMS_MAX = 200_000


@dataclass(frozen=True)
class Series:
    """The sum, and a bound of what was left out."""

    value: float
    tail: float


def _squared_norm(matrix: Floats) -> float:
    """‖·‖² of a matrix (n, n); infinite where it overflows."""
    if not np.isfinite(matrix).all():
        return math.inf
    size = float(np.linalg.norm(matrix, 2))
    return size * size


def growth_factors(A: Floats, index: int) -> tuple[float, ...]:
    """d_1 … d_{max(I0−1, 1)} of P (16), A (n, n), I0 = ``index``: ‖F^i(P)‖ ≤ d_i ‖P‖ + const.

    F^i(P) ≤ A^i P A'^i + const gives d_i = ‖A^i‖². For I0 = 1 F is bounded (P Lemma 5), so d_1 = 0.
    """
    if index == 1:
        return (0.0,)
    out, power = [], A
    for _ in range(index - 1):
        out.append(_squared_norm(power))
        power = power @ A
    return tuple(out)


def burst_series(A: Floats, recovery: float) -> Series | None:
    """Σ_{j≥1} ‖A^j‖² (1−recovery)^{j−1} of P Theorem 6 (ii), A (n, n); None if it diverges or converges too slowly.

    With s = 1 − recovery and an m such that θ = ‖A^m‖² s^m < 1, term j+m is at most θ times term j. So what follows
    term N is at most (terms N+1 … N+m) / (1−θ). At most 200000 terms are summed.
    """
    s = 1.0 - recovery
    rho = spectral_radius(A)
    if s > 0.0 and rho * rho * s >= 1.0:
        return None
    power, total, terms = A, 0.0, 0
    block, theta = _first_contraction(A, s)
    if block is None:
        return None
    while terms < _TERMS_MAX:
        part = 0.0
        for _ in range(block):
            part += _squared_norm(power)
            power = np.sqrt(s) * (A @ power)
        if not math.isfinite(part):
            return None
        tail = part * theta / (1.0 - theta)
        total, terms = total + part, terms + block
        if tail <= SERIES_TOLERANCE * total:
            return Series(total, tail)
    return None


def _first_contraction(A: Floats, s: float) -> tuple[int | None, float]:
    """The first m of 1, 2, 4, … with θ = ‖A^m‖² s^m ≤ ½, and θ; (None, 1) if there is none up to 2^15."""
    power, m = np.sqrt(s) * A, 1
    while m <= 2**15:
        theta = _squared_norm(power)
        if theta <= 0.5:
            return m, theta
        if not np.isfinite(theta):
            break
        power, m = power @ power, 2 * m
    return None, 1.0


def condition_two(d: tuple[float, ...], index: int, series: float, recovery: float, failure: float) -> float:
    """Left side of P Theorem 6 (ii): p q d_1 [1 + Σ_{i=1}^{I0−1} d_i (1−p)^i] Σ_j ‖A^j‖² (1−q)^{j−1}; < 1 is wanted."""
    inner = 1.0 + sum(d[i - 1] * (1.0 - failure) ** i for i in range(1, index))
    return failure * recovery * d[0] * inner * series


def failure_limit(d: tuple[float, ...], index: int, series: float, recovery: float) -> float:
    """The p up to which P Theorem 6 (ii) holds for every failure rate below; 1 if it holds for all.

    The first root in 0 … 1 of a polynomial of degree I0, from all its roots. Where they overflow, the smaller
    1 / (q d_1 [1 + Σ d_i] Σ_j …), below which the condition holds too.
    """
    factor = recovery * d[0] * series
    if factor == 0.0:
        return 1.0
    inner = np.polynomial.Polynomial([1.0])
    for i in range(1, index):
        inner = inner + d[i - 1] * np.polynomial.Polynomial([1.0, -1.0]) ** i
    left = np.polynomial.Polynomial([0.0, factor]) * inner
    try:
        roots = [complex(root) for root in (left - 1.0).roots()]
    except np.linalg.LinAlgError:
        return min(1.0, 1.0 / (factor * (1.0 + sum(d[: index - 1]))))
    inside = [root.real for root in roots if abs(root.imag) < 1e-9 and 0.0 < root.real <= 1.0]
    return min(inside, default=1.0)


def scalar_peak_is_stable(a: float, recovery: float, order: float = 1.0) -> bool:
    """P Theorem 8 (order 1) and Corollary 9: |a|^{2r} (1−q) < 1, necessary and sufficient for c ≠ 0, Q > 0."""
    if a == 0.0 or recovery >= 1.0:
        return True
    return 2.0 * order * math.log(abs(a)) + math.log1p(-recovery) < 0.0
