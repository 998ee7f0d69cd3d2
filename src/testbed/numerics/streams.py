"""Counter-based random streams: a draw depends on (seed, component, purpose, lane, step) and on nothing else.

Every purpose has a Philox key of its own. Within it, steps are taken in tiles of 16 so that one call to the generator
serves a single lane over many steps as well as thousands of lanes: the counter runs over (tile, lane, step in tile).
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.random import Philox
from numpy.typing import NDArray

from testbed.numerics.circle import place
from testbed.numerics.lanes import Floats, Vector

TILE = 16
_FEW = 64  # lanes up to which a whole tile is transformed at once
_FEWER = 4  # lanes up to which that is done for several tiles
_TILES = 8


@dataclass
class _Ahead:
    """Random words of some steps, and what a law made of them."""

    number: int
    raw: NDArray[np.uint64]
    rows: list[Vector] | None = None


class Stream:
    """Draws for the lanes lane … lane + lanes − 1, ``width`` numbers a lane and step.

    Uniform and normal draws of one stream are not independent: ask for one law.
    Steps may be asked for in any order; in order is fast.
    """

    def __init__(self, seed: int, component: str, purpose: str, *, width: int, lane: int, lanes: int) -> None:
        self._key = _key(seed, component, purpose)
        self._width, self._lane, self._lanes = width, lane, lanes
        self._tiles = _TILES if lanes <= _FEWER else 1
        self._ahead: dict[str, _Ahead] = {}
        self._firsts: list[float] = []
        self._firsts_from = 0

    def first(self, step: int) -> float:
        """What ``uniforms(step)[0]`` is for one lane, which is asked for most often."""
        offset = step - self._firsts_from
        if not 0 <= offset < len(self._firsts):
            ahead, offset = self._drawn(self._uniform.__name__, self._width, step)
            self._firsts_from = step - offset
            self._firsts = _uniform(ahead.raw[:, 0, 0]).tolist()
        return self._firsts[offset]

    def uniforms(self, step: int) -> Vector:
        """``width`` components, uniform on [0, 1)."""
        return self._row(self._uniform, self._width, step)

    def words(self, step: int) -> NDArray[np.uint64]:
        """(width, lanes): what ``uniforms`` of the step are 2^-53 of."""
        ahead, offset = self._drawn(self._uniform.__name__, self._width, step)
        row: NDArray[np.uint64] = ahead.raw[offset]
        return row

    def normals(self, step: int) -> Vector:
        """``width`` components, standard normal (Box and Muller)."""
        return self._row(self._normal, self._width + self._width % 2, step)

    def _row(self, law: Callable[[NDArray[np.uint64]], Floats], words: int, step: int) -> Vector:
        ahead, offset = self._drawn(law.__name__, words, step)
        if self._lanes > _FEW:
            return list(law(ahead.raw[offset : offset + 1])[0])
        if ahead.rows is None:
            rows = law(ahead.raw)
            ahead.rows = rows[:, :, 0].tolist() if self._lanes == 1 else list(rows)
        return list(ahead.rows[offset])

    def _drawn(self, law: str, words: int, step: int) -> tuple[_Ahead, int]:
        """The random words for a law around a step, and where its own are."""
        number, offset = divmod(step, TILE * self._tiles)
        ahead = self._ahead.get(law)
        if ahead is None or ahead.number != number:
            tiles = [self._raw_tile(number * self._tiles + i, words) for i in range(self._tiles)]
            ahead = self._ahead[law] = _Ahead(number, np.concatenate(tiles) if len(tiles) > 1 else tiles[0])
        return ahead, offset

    def _raw_tile(self, number: int, words: int) -> NDArray[np.uint64]:
        """Random words of shape (TILE, words, lanes), 53 bits each."""
        counter = np.array([self._lane * TILE * words // 4, words, number, 0], dtype=np.uint64)
        raw = Philox(key=self._key, counter=counter).random_raw(self._lanes * TILE * words)
        tile = np.empty((TILE * words, self._lanes), dtype=np.uint64)
        np.right_shift(raw.reshape(self._lanes, TILE * words).T, np.uint64(11), out=tile)
        return tile.reshape(TILE, words, self._lanes)

    def _uniform(self, raw: NDArray[np.uint64]) -> Floats:
        return _uniform(raw)

    def _normal(self, raw: NDArray[np.uint64]) -> Floats:
        return _normal(raw)[:, : self._width]


class LaneStream:
    """Many draws of one lane and step at once; nothing is kept between calls.

    As with ``Stream``, uniform and normal draws of one purpose are not independent.
    """

    def __init__(self, seed: int, component: str, purpose: str) -> None:
        self._key = _key(seed, component, purpose)

    def uniforms(self, lane: int, step: int, count: int) -> Floats:
        """(count,), uniform on [0, 1)."""
        return _uniform(self._raw(lane, step, count))

    def normals(self, lane: int, step: int, count: int) -> Floats:
        """(count,), standard normal."""
        return _normal(self._raw(lane, step, count + count % 2)[None, :, None])[0, :count, 0]

    def _raw(self, lane: int, step: int, words: int) -> NDArray[np.uint64]:
        counter = np.array([0, lane, step, 1], dtype=np.uint64)
        raw: NDArray[np.uint64] = Philox(key=self._key, counter=counter).random_raw(words)
        raw >>= np.uint64(11)
        return raw


def _key(seed: int, component: str, purpose: str) -> NDArray[np.uint64]:
    digest = hashlib.blake2b(f"{seed}|{component}|{purpose}".encode(), digest_size=16).digest()
    return np.frombuffer(digest, dtype="<u8").astype(np.uint64)


def _uniform(raw: NDArray[np.uint64]) -> Floats:
    return raw.astype(np.float64) * 2.0**-53


def _normal(raw: NDArray[np.uint64]) -> Floats:
    """Words (steps, words, lanes), an even number of them, as normals of the same shape (Box and Muller)."""
    steps, words, lanes = raw.shape
    radius = (raw[:, : words // 2] + np.uint64(1)).astype(np.float64)
    radius *= 2.0**-53
    np.log(radius, out=radius)
    radius *= -2.0
    np.sqrt(radius, out=radius)
    normals = np.empty((2, radius.size))
    place(np.ascontiguousarray(raw[:, words // 2 :]).ravel(), radius.ravel(), normals[0], normals[1])
    return normals.reshape(2, steps, words // 2, lanes).swapaxes(0, 1).reshape(steps, words, lanes)
