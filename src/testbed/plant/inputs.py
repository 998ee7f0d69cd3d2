"""The inputs u_k of theory.md section 1, and the bound U on what they can do that the upper bound S needs."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from testbed.numerics.lanes import Floats, array_of
from testbed.numerics.streams import Stream
from testbed.scenario import (
    ClosedLoop,
    ConstantInput,
    ExponentialInput,
    Input,
    Scenario,
    SineInput,
    TableInput,
    UniformInput,
)
from testbed.scenario.plant_events import InputEvent

InputSource = Callable[[int], Floats]
"""k → u_k of shape (lanes, q), the same for the same k; k < steps."""
_AHEAD = 256  # steps


def open_loop(scenario: Scenario, lane: int, lanes: int) -> InputInTurn:
    """The input of the lanes lane … lane + lanes − 1, with its changes; it does not depend on estimates."""
    inputs = InputInTurn(partial(_open_loop, scenario, lane=lane, lanes=lanes), scenario.input)
    for step, event in scenario.timed(InputEvent):
        inputs.change(step, event.input)
    return inputs


class InputInTurn:
    """k → u_k, of one input after the other."""

    def __init__(self, source_of: Callable[[Input | None], InputSource], first: Input | None) -> None:
        self._source_of = source_of
        self._inputs = [(0, source_of(first))]
        self._now, self._until = self._inputs[0][1], -1

    def change(self, step: int, source: Input) -> None:
        """Another input from step ``step`` on, which is still to come."""
        self._inputs = sorted([*self._inputs, (step, self._source_of(source))], key=lambda entry: entry[0])
        self._until = -1

    def __call__(self, k: int) -> Floats:
        if k > self._until:
            self._now = next(source for step, source in reversed(self._inputs) if step <= k)
            self._until = min((step - 1 for step, _ in self._inputs if step > k), default=2**31)
        return self._now(k)


def _open_loop(scenario: Scenario, source: Input | None, *, lane: int, lanes: int) -> InputSource:
    q = scenario.system.q
    if isinstance(source, ClosedLoop):
        raise TypeError("a feedback input depends on the estimate")
    if isinstance(source, UniformInput):
        stream = Stream(scenario.seed, "controller", "input", width=q, lane=lane, lanes=lanes)
        low, high = _channels(source.low, q), _channels(source.high, q)
        return lambda k: low + (high - low) * array_of(stream.uniforms(k), lanes)
    return _Ahead(deterministic(source, q), lanes, scenario.steps)


class _Ahead:
    """An input that is the same in every lane, computed many steps at a time."""

    def __init__(self, law: Callable[[NDArray[np.int64]], Floats], lanes: int, steps: int) -> None:
        self._law, self._lanes, self._steps = law, lanes, steps
        self._begin, self._rows = 0, np.zeros((0, 1, 0))

    def __call__(self, k: int) -> Floats:
        if not self._begin <= k < self._begin + len(self._rows):
            self._begin = k - k % _AHEAD
            self._rows = self._law(np.arange(self._begin, min(self._begin + _AHEAD, self._steps)))[:, None, :]
        row: Floats = self._rows[k - self._begin]
        return row if self._lanes == 1 else np.tile(row, (self._lanes, 1))


def deterministic(source: Input | None, q: int) -> Callable[[NDArray[np.int64]], Floats]:
    """An input that is the same in every lane, as a function from steps (K,) to u (K, q)."""
    if source is None:
        return lambda k: np.zeros((len(k), 0))
    if isinstance(source, ConstantInput):
        value = np.array(source.value)
        return lambda k: np.tile(value, (len(k), 1))
    if isinstance(source, ExponentialInput):
        offset, amplitude, tau = (_channels(v, q) for v in (source.offset, source.amplitude, source.tau))
        return lambda k: offset + amplitude * np.exp(-k[:, None] / tau)
    if isinstance(source, SineInput):
        offset, amplitude, phase = (_channels(v, q) for v in (source.offset, source.amplitude, source.phase))
        period = _channels(source.period, q)
        return lambda k: offset + amplitude * np.sin(2.0 * np.pi * k[:, None] / period + phase)
    if isinstance(source, TableInput):
        table = np.array(source.values)
        return lambda k: table[k]
    raise TypeError(f"input {source.kind!r} is not the same in every lane")


def control_bound(scenario: Scenario) -> Floats | None:
    """U (n, n) with U ≥ B u_k u_k' B' for the control of every step; None where no bound is known.

    For one channel it is tight; for several, u u' ≤ ‖u‖² I is used. With an actuator that holds, ¼U ≥ Var(B a) for
    every law of an a among 0, u_0, u_1, …: channel i has a range of width d_i, so that Var(a) ≤ ¼ Σ d_i² I (Popoviciu).
    Inputs that events of the scenario bring count with all their steps, whenever they come.
    """
    source, q, steps = scenario.input, scenario.system.q, scenario.steps
    if isinstance(source, ClosedLoop):
        return None
    b = np.array(scenario.system.B) if scenario.system.B is not None else np.zeros((scenario.system.n, 0))
    later = [event.input for event in scenario.events if isinstance(event, InputEvent)]
    if isinstance(source, ConstantInput) and not later:
        push = b @ np.array(source.value)
        return np.outer(push, push)
    sources: list[Input | None] = [source, *later]
    if scenario.actuator.on_loss == "hold":
        ranges = [_range(one, q, steps) for one in sources]
        lows, highs = (np.array(ends) for ends in zip(*ranges, strict=True))
        width = np.maximum(highs.max(axis=0), 0.0) - np.minimum(lows.min(axis=0), 0.0)
        return np.asarray(float(width @ width) * (b @ b.T))
    return np.asarray(max(_peak(one, q, steps) for one in sources) * (b @ b.T))


def _peak(source: Input | None, q: int, steps: int) -> float:
    """The largest ‖u_k‖² that it can have."""
    if isinstance(source, UniformInput):
        largest = np.maximum(np.abs(_channels(source.low, q)), np.abs(_channels(source.high, q)))
        return float(largest @ largest)
    u = deterministic(source, q)(np.arange(steps))
    return float(np.max(np.sum(u * u, axis=1)))


def _range(source: Input | None, q: int, steps: int) -> tuple[Floats, Floats]:
    """The least and the largest control of any step, by channel; of an input that is not fed back."""
    if isinstance(source, UniformInput):
        return _channels(source.low, q), _channels(source.high, q)
    u = deterministic(source, q)(np.arange(steps))
    return u.min(axis=0), u.max(axis=0)


def _channels(value: float | tuple[float, ...], q: int) -> Floats:
    return np.broadcast_to(np.asarray(value, dtype=np.float64), (q,))
