"""Spread weights on a line over the integers with a Gaussian kernel: one axis of a sum over a lattice.

Compiled (numba, an extra) where that is available, else by numpy; the two agree to rounding and to the tails that lie
beyond the reach.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from testbed.numerics.kernels import available

_Floats: TypeAlias = NDArray[np.float64]
_CHUNK = 2_000_000
"""Kernel values that numpy holds at a time."""


def spread(
    values: _Floats,
    base: _Floats,
    slope: float,
    reach: _Floats,
    first: int,
    count: int,
    variance: float,
    *,
    merge: bool,
) -> _Floats:
    """out[r, a, m] = Σ_i N(first + a; base[r] + slope i, variance) values[r, i, m], a = 0 … count − 1.

    values (R, I, A), base (R,); reach (R, I): as far from its centre at least a kernel is evaluated, negative: not at
    all. merge: the sum over r too, (1, count, A).
    """
    rows, _, inner = values.shape
    out = np.zeros((1 if merge else rows, count, inner))
    spreader = _compiled() if available() else _by_numpy
    spreader(np.ascontiguousarray(values), base, slope, reach, first, variance, merge, out)
    return out


def _by_numpy(
    values: _Floats,
    base: _Floats,
    slope: float,
    reach: _Floats,
    first: int,
    variance: float,
    merge: bool,
    out: _Floats,
) -> None:
    steps, count = values.shape[1], out.shape[1]
    peak = 1.0 / math.sqrt(2.0 * math.pi * variance)
    nodes = first + np.arange(count, dtype=np.float64)
    some = max(1, _CHUNK // (steps * count))
    for start in range(0, len(base), some):
        rows = slice(start, start + some)
        centres = base[rows, None] + slope * np.arange(steps)
        away = nodes[None, :, None] - centres[:, None, :]
        kernel = np.where(reach[rows, None, :] >= 0.0, peak * np.exp(away * away * (-0.5 / variance)), 0.0)
        if merge:
            out[0] += np.swapaxes(kernel, 0, 1).reshape(count, -1) @ values[rows].reshape(-1, values.shape[2])
        else:
            out[rows] = kernel @ values[rows]


@lru_cache(maxsize=1)
def _compiled() -> Callable[..., None]:
    import numba

    cube, grid, line = numba.float64[:, :, ::1], numba.float64[:, ::1], numba.float64[::1]
    signature = numba.void(cube, line, numba.float64, grid, numba.int64, numba.float64, numba.boolean, cube)
    found: Callable[..., None] = numba.njit(signature, error_model="numpy", nogil=True, cache=True)(_loop)
    return found


def _loop(values: Any, base: Any, slope: float, reach: Any, first: int, variance: float, merge: bool, out: Any) -> None:
    rows, steps, inner = values.shape
    count = out.shape[1]
    peak = 1.0 / math.sqrt(2.0 * math.pi * variance)
    bend = math.exp(-1.0 / variance)
    kernel = np.empty(count)
    for r in range(rows):
        to = 0 if merge else r
        for i in range(steps):
            width = reach[r, i]
            if width < 0.0:
                continue
            centre = base[r] + slope * i - first
            low = max(0, math.ceil(centre - width))
            high = min(count - 1, math.floor(centre + width))
            if high < low:
                continue
            middle = min(max(math.floor(centre + 0.5), low), high)
            off = middle - centre
            top = peak * math.exp(-0.5 * off * off / variance)
            value = top
            ratio = math.exp(-(2.0 * off + 1.0) / (2.0 * variance))
            kernel[middle] = top
            for a in range(middle + 1, high + 1):
                value *= ratio
                ratio *= bend
                kernel[a] = value
            value = top
            ratio = math.exp((2.0 * off - 1.0) / (2.0 * variance))
            for a in range(middle - 1, low - 1, -1):
                value *= ratio
                ratio *= bend
                kernel[a] = value
            if inner == 1:
                weight = values[r, i, 0]
                for a in range(low, high + 1):
                    out[to, a, 0] += kernel[a] * weight
            else:
                for a in range(low, high + 1):
                    factor = kernel[a]
                    for m in range(inner):
                        out[to, a, m] += factor * values[r, i, m]
