"""Arrays of different shapes as flat ones, with what it takes to cut them apart again.

An infinite value is kept as the largest number, so that all that is packed is finite.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Arrays = dict[str, NDArray[Any]]
_LARGEST = np.finfo(np.float64).max


def packed(prefix: str, parts: Sequence[Mapping[str, NDArray[Any]]]) -> Arrays:
    """One flat array and one of shapes (parts, ndim) for each name; every part has the same names and ndims."""
    out: Arrays = {f"{prefix}count": np.array(len(parts))}
    for name in parts[0] if parts else ():
        arrays = [np.asarray(part[name]) for part in parts]
        flat = np.concatenate([array.ravel() for array in arrays])
        out[f"{prefix}{name}"] = np.clip(flat, -_LARGEST, _LARGEST) if flat.dtype == np.float64 else flat
        out[f"{prefix}{name}.shape"] = np.array([array.shape for array in arrays], dtype=np.int64).reshape(
            len(parts), -1
        )
    return out


def unpacked(prefix: str, state: Mapping[str, NDArray[Any]]) -> list[Arrays]:
    """What ``packed`` was given."""
    parts: list[Arrays] = [{} for _ in range(int(state[f"{prefix}count"]))]
    for key in state:
        name = key.removeprefix(prefix)
        if not key.startswith(prefix) or f"{key}.shape" not in state:
            continue
        shapes = [tuple(int(v) for v in row) for row in state[f"{key}.shape"]]
        ends = np.cumsum([int(np.prod(shape)) for shape in shapes])
        pieces = np.split(state[key], ends[:-1])
        for part, piece, shape in zip(parts, pieces, shapes, strict=True):
            part[name] = _with_infinities(piece.reshape(shape).copy())
    return parts


def _with_infinities(array: NDArray[Any]) -> NDArray[Any]:
    if array.dtype == np.float64:
        array[array == _LARGEST], array[array == -_LARGEST] = np.inf, -np.inf
    return array
