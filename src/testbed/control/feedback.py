"""State feedback: u_k = feedforward − L_k (x̂_k − reference)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from testbed.estimator.model import Model
from testbed.estimator.state import Given, State, state_of
from testbed.numerics.lanes import Constant, Floats, Vector, add_constant, array_of, constant, constant_times, vector_of


class StateFeedback:
    """u_k = −L_k x̂_k + offset with L_k = gains[steps to go − 1], or always the only one; gains (q, n), offset (q,)."""

    STATE_VERSION = 1

    def __init__(self, model: Model, lanes: int, gains: Sequence[Floats], steps: int, offset: Floats) -> None:
        """steps: of the run; what lies further back than the first of the gains has that one."""
        self._n, self._lanes, self._steps = model.n, lanes, steps
        self._gains: list[Constant] = [constant(-gain) for gain in gains]
        self._offset = [float(v) for v in offset]
        self._k = 0

    def step(self, k: int, x_hat: Floats, P: Floats) -> Floats:
        self._k = k + 1
        gain = self._gains[min(self._steps - k, len(self._gains)) - 1]
        u: Vector = [
            add_constant(v, c) for v, c in zip(constant_times(gain, vector_of(x_hat)), self._offset, strict=True)
        ]
        return array_of(u, self._lanes)

    def state(self) -> State:
        return state_of(self._k, self._lanes, {})

    def set_state(self, state: State) -> None:
        given = Given(state, self._lanes, self._n)
        given.end()
        self._k = given.step


def offset_of(gain: Floats, reference: Floats, feedforward: Floats) -> Floats:
    """feedforward + L reference, (q,)."""
    return np.asarray(feedforward + gain @ reference)
