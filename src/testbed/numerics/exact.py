"""Sums that do not depend on the order of their terms.

A mean over lanes must come out the same to the bit however the lanes are split over packets and in whatever order
these arrive. So sums are kept exactly, as integers in units of 2^-1126, and rounded once, at the end. An array is
first reduced to a few doubles with the same exact sum, by the error-free extraction of Rump, Ogita and Oishi
(Accurate floating-point summation, part I, SIAM J. Sci. Comput. 31, 2008, algorithm 3.2).
"""

from __future__ import annotations

import math

import numpy as np

from testbed.numerics.lanes import Component, Floats

_SCALE = 1126  # 1074 for the smallest subnormal, 52 to spare
_SPLITTER = 134217729.0  # 2^27 + 1 (Veltkamp)
_LARGEST = 1e150  # beyond it squares overflow
_FEW = 32  # up to here adding one by one is faster


def exact_parts(x: Floats) -> list[float]:
    """A few doubles whose exact sum is that of the finite array x of shape (M,), |x| < 1e300."""
    parts: list[float] = []
    if not len(x):
        return parts
    bits = math.ceil(math.log2(len(x) + 2))
    rest, high = x, np.empty_like(x)
    top = max(float(x.max()), -float(x.min()))
    while top != 0.0:
        sigma = math.ldexp(1.0, math.frexp(top)[1] + bits)
        np.add(rest, sigma, out=high)
        high -= sigma
        parts.append(float(high.sum()))
        rest = np.subtract(rest, high, out=None if rest is x else rest)
        top = sigma * 2.0**-53 if rest.any() else 0.0
    return parts


def square(x: Component) -> tuple[Component, Component]:
    """x² = hi + lo without error (Dekker), for 1e-146 < |x| < 1e150; elementwise."""
    head = _SPLITTER * x
    head = head - (head - x)
    tail = x - head
    hi = x * x
    lo = head * head
    lo -= hi
    head *= tail
    head *= 2.0
    lo += head
    tail *= tail
    lo += tail
    return hi, lo


def fixed(x: float) -> int:
    """A finite double as an integer multiple of 2^-1126."""
    mantissa, exponent = math.frexp(x)
    shift = exponent - 53 + _SCALE
    integer = int(mantissa * 9007199254740992.0)
    return integer << shift if shift >= 0 else integer >> -shift


class ExactMoments:
    """Count, sum and sum of squares over lanes; merging and order do not change a bit of what comes out.

    Values that are not finite, or beyond 1e150, are left out and counted in ``undefined``.
    """

    __slots__ = ("count", "total", "total_of_squares", "undefined")

    def __init__(self) -> None:
        self.count = 0
        self.undefined = 0
        self.total = 0
        self.total_of_squares = 0

    def add(self, x: Component) -> None:
        """Take in one value a lane: a ``float`` or an array of shape (M,)."""
        if isinstance(x, float):
            self._add_one(x)
        elif len(x) <= _FEW:
            for value in x.tolist():
                self._add_one(value)
        else:
            self._add_array(x)

    def _add_one(self, x: float) -> None:
        if not abs(x) < _LARGEST:
            self.undefined += 1
            return
        self.count += 1
        self.total += fixed(x)
        hi, lo = square(x)
        self.total_of_squares += fixed(hi) + fixed(lo)

    def _add_array(self, x: Floats) -> None:
        peak = float(np.abs(x).max(initial=0.0))
        if not peak < _LARGEST:
            usable = np.abs(x) < _LARGEST
            self.undefined += int(len(x) - usable.sum())
            x = x[usable]
        self.count += len(x)
        hi, lo = square(x)
        self.total += sum(map(fixed, exact_parts(x)))
        self.total_of_squares += sum(map(fixed, exact_parts(hi))) + sum(map(fixed, exact_parts(lo)))

    def merge(self, other: ExactMoments) -> None:
        self.count += other.count
        self.undefined += other.undefined
        self.total += other.total
        self.total_of_squares += other.total_of_squares

    @property
    def mean(self) -> float | None:
        """The correctly rounded mean; None without values."""
        return self.total / (self.count << _SCALE) if self.count else None

    @property
    def standard_error(self) -> float | None:
        """sqrt(sample variance / count); None for fewer than two values."""
        n = self.count
        if n < 2:
            return None
        centred = n * (self.total_of_squares << _SCALE) - self.total * self.total
        return math.sqrt(max(centred, 0) / ((n * n * (n - 1)) << (2 * _SCALE)))
