"""Counter-based random streams: a draw depends on (seed, component, purpose, lane, step) and on nothing else.

Every purpose has a Philox key of its own. Within it, steps are taken in tiles of 16 so that one call to the generator
serves a single lane over many steps as well as thousands of lanes: the counter runs over (tile, lane, step in tile).
"""

from __future__ import annotations

import hashlib

import numpy as np
from numpy.typing import NDArray

from testbed.numerics.lanes import Floats, Vector

TILE = 16


class Stream:
    """Draws for the lanes lane … lane + lanes − 1, ``width`` numbers a lane and step.

    A block of lanes asks for its steps in order; any order gives the same numbers.
    """

    def __init__(self, seed: int, component: str, purpose: str, *, width: int, lane: int, lanes: int) -> None:
        digest = hashlib.blake2b(f"{seed}|{component}|{purpose}".encode(), digest_size=16).digest()
        self._key = np.frombuffer(digest, dtype="<u8").astype(np.uint64)
        self._width, self._lane, self._lanes = width, lane, lanes
        self._tile: dict[str, tuple[int, Floats | list[list[float]]]] = {}

    def uniforms(self, step: int) -> Vector:
        """``width`` components, uniform on [0, 1)."""
        return self._row("uniform", step)

    def normals(self, step: int) -> Vector:
        """``width`` components, standard normal (Box and Muller)."""
        return self._row("normal", step)

    def _row(self, law: str, step: int) -> Vector:
        number, offset = divmod(step, TILE)
        cached = self._tile.get(law)
        if cached is None or cached[0] != number:
            draws = self._uniform_tile(number) if law == "uniform" else self._normal_tile(number)
            cached = self._tile[law] = (number, draws[:, :, 0].tolist() if self._lanes == 1 else draws)
        return list(cached[1][offset])

    def _raw_tile(self, number: int, words: int) -> NDArray[np.uint64]:
        """Raw words of shape (TILE, words, lanes)."""
        blocks_a_lane = TILE * words // 4
        counter = np.array([self._lane * blocks_a_lane, words, number, 0], dtype=np.uint64)
        raw = np.random.Philox(key=self._key, counter=counter).random_raw(self._lanes * TILE * words)
        return np.ascontiguousarray(raw.reshape(self._lanes, TILE, words).transpose(1, 2, 0))

    def _uniform_tile(self, number: int) -> Floats:
        raw = self._raw_tile(number, self._width)
        return (raw >> np.uint64(11)).astype(np.float64) * 2.0**-53

    def _normal_tile(self, number: int) -> Floats:
        pairs = (self._width + 1) // 2
        raw = self._raw_tile(number, 2 * pairs) >> np.uint64(11)
        open_below = (raw[:, :pairs] + np.uint64(1)).astype(np.float64) * 2.0**-53
        radius = np.sqrt(-2.0 * np.log(open_below))
        angle = (2.0 * np.pi * 2.0**-53) * raw[:, pairs:].astype(np.float64)
        normals = np.concatenate([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
        return np.ascontiguousarray(normals[:, : self._width])
