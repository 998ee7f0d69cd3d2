"""Uniform directions from random words by additions and multiplications alone: the same bits compiled and not.

Of the 53 bits of a word one swaps the coordinates, one is the sign of the first, and the others are f, uniform on
[−½, ½): the angle π/2 · f lies in a quarter turn, where Taylor's series of sine and cosine have converged to rounding.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.numerics.kernels import available
from testbed.numerics.lanes import Floats

COMPILED_MIN = 1024
"""Words from which the compiled loop is taken."""

_QUARTER = math.pi / 2.0
_SINE = [(-1.0) ** i * _QUARTER ** (2 * i + 1) / math.factorial(2 * i + 1) for i in range(8)]
_COSINE = [(-1.0) ** i * _QUARTER ** (2 * i) / math.factorial(2 * i) for i in range(9)]
_S0, _S1, _S2, _S3, _S4, _S5, _S6, _S7 = _SINE
_C0, _C1, _C2, _C3, _C4, _C5, _C6, _C7, _C8 = _COSINE
_FRACTION = 2.0**-51


def place(words: NDArray[np.uint64], radius: Floats, x: Floats, y: Floats) -> None:
    """Put points at distance ``radius`` (K,) in the directions of ``words`` (K,), 53 bits each, into x and y (K,)."""
    if len(words) >= COMPILED_MIN and available():
        _compiled()(words, radius, x, y)
        return
    f = (words & np.uint64(2**51 - 1)).astype(np.float64) * _FRACTION - 0.5
    sine, cosine = _sine(f) * radius, _cosine(f) * radius
    np.negative(cosine, out=cosine, where=(words >> np.uint64(51)) & np.uint64(1) == 1)
    swapped = words >> np.uint64(52) == 1
    x[:], y[:] = np.where(swapped, sine, cosine), np.where(swapped, cosine, sine)


def _sine(f: Any) -> Any:
    """sin(π/2 f) for |f| ≤ ½."""
    z = f * f
    return f * (_S0 + z * (_S1 + z * (_S2 + z * (_S3 + z * (_S4 + z * (_S5 + z * (_S6 + z * _S7)))))))


def _cosine(f: Any) -> Any:
    """cos(π/2 f) for |f| ≤ ½."""
    z = f * f
    return _C0 + z * (_C1 + z * (_C2 + z * (_C3 + z * (_C4 + z * (_C5 + z * (_C6 + z * (_C7 + z * _C8)))))))


@lru_cache
def _compiled() -> Callable[..., None]:
    import numba

    inline = numba.njit(inline="always", error_model="numpy")
    sine_of, cosine_of = inline(_sine), inline(_cosine)

    def loop(words: Any, radius: Any, x: Any, y: Any) -> None:
        for i in range(len(words)):
            word = words[i]
            f = float(word & np.uint64(2**51 - 1)) * _FRACTION - 0.5
            sine, cosine = sine_of(f) * radius[i], cosine_of(f) * radius[i]
            cosine = -cosine if (word >> np.uint64(51)) & np.uint64(1) else cosine
            swapped = (word >> np.uint64(52)) == np.uint64(1)
            x[i], y[i] = (sine, cosine) if swapped else (cosine, sine)

    signature = numba.void(numba.uint64[::1], numba.float64[::1], numba.float64[::1], numba.float64[::1])
    found: Callable[..., None] = numba.njit(signature, error_model="numpy", nogil=True)(loop)
    return found
