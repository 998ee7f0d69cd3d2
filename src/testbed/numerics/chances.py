"""What happens with a chance that depends on what a lane was before: compiled over many lanes, to the same bits."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.numerics.kernels import LANES_MIN, available
from testbed.numerics.lanes import Bools

_SCALE = 2.0**-53


def happens(words: NDArray[np.uint64], before: Bools, chance_no: float, chance_yes: float) -> Bools:
    """Where the uniform number of a word (M,), 53 bits, lies below the chance that ``before`` (M,) picks."""
    if len(words) >= LANES_MIN and available():
        out = np.empty(len(words), dtype=np.bool_)
        _compiled()(words, before, chance_no, chance_yes, out)
        return out
    return np.asarray(words.astype(np.float64) * _SCALE < np.where(before, chance_yes, chance_no))


def prepare(lanes: int) -> None:
    """Compile what ``happens`` needs for so many lanes, which takes a moment."""
    if lanes >= LANES_MIN and available():
        _compiled()


@lru_cache
def _compiled() -> Callable[..., None]:
    import numba

    def loop(words: Any, before: Any, no: float, yes: float, out: Any) -> None:
        for i in range(len(words)):
            out[i] = float(words[i]) * _SCALE < (yes if before[i] else no)

    words, bits = (numba.types.Array(t, 1, "C", readonly=True) for t in (numba.uint64, numba.boolean))
    signature = numba.void(words, bits, numba.float64, numba.float64, numba.boolean[::1])
    found: Callable[..., None] = numba.njit(signature, error_model="numpy", nogil=True)(loop)
    return found
