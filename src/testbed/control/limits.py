"""The limits of an actuator: what is sent is never beyond them."""

from __future__ import annotations

import numpy as np

from testbed.numerics.lanes import Component, Floats, Vector, array_of, clip, vector_of
from testbed.scenario import Following

Channels = float | tuple[float, ...]


def channels(value: Channels, q: int) -> list[float]:
    """A number for each channel."""
    return [float(v) for v in np.broadcast_to(np.asarray(value, dtype=np.float64), (q,))]


class Limits:
    """low ≤ u ≤ high in each channel."""

    def __init__(self, low: Channels | None, high: Channels | None, q: int) -> None:
        largest = float(np.finfo(np.float64).max)
        self.given = low is not None or high is not None
        self.low = channels(-largest if low is None else low, q)
        self.high = channels(largest if high is None else high, q)

    @classmethod
    def of(cls, source: Following, q: int) -> Limits:
        """Those of an input."""
        return cls(source.low, source.high, q)

    def clipped(self, u: Vector) -> Vector:
        """u within the limits, in components."""
        if not self.given:
            return u
        out: list[Component] = [clip(v, low, high) for v, low, high in zip(u, self.low, self.high, strict=True)]
        return out

    def held(self, u: Floats) -> tuple[Floats, int]:
        """u (M, q) within the limits, and in how many lanes it was not."""
        if not self.given:
            return u, 0
        inside = array_of(self.clipped(vector_of(u)), len(u))
        return inside, int(np.count_nonzero((inside != u).any(axis=1)))
