"""Whether a condition holds, step by step, in memory that does not grow.

Truth is 1 (holds), −1 (does not) or 0 (cannot be said, since a figure has no value): Kleene's logic, in which `and` is
the least, `or` the largest, and `not` the negative. Numbers that cannot be said are not-a-number. Both are NumPy
scalars or, within `any lane` and `all lanes`, vectors of shape (lanes,).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.numerics.lanes import Floats
from testbed.scenario.conditions.figures import FIGURES, StepFigures
from testbed.scenario.conditions.syntax import (
    Arithmetic,
    Call,
    Compare,
    Figure,
    HeldSteps,
    HeldTime,
    Lanes,
    Logic,
    LossRate,
    Negative,
    Not,
    Number,
    Numeric,
    Quantity,
    Span,
    Truth,
)

Value = NDArray[Any]
Evaluator = Callable[[int, StepFigures], Value]
"""From the step and its figures to a number or a truth; may remember earlier steps."""

_NAN = np.array(np.nan)
_COMPARISONS: Mapping[str, Callable[[Value, Value], Value]] = {
    "<": np.less,
    "<=": np.less_equal,
    ">": np.greater,
    ">=": np.greater_equal,
    "==": np.equal,
    "!=": np.not_equal,
}


def _quotient(a: Value, b: Value) -> Value:
    return np.asarray(np.where(b == 0.0, np.nan, a / b))


_ARITHMETIC: Mapping[str, Callable[[Value, Value], Value]] = {
    "+": np.add,
    "-": np.subtract,
    "*": np.multiply,
    "/": _quotient,
}


def truth_of(node: Truth, period_ns: int, *, lanes: bool = False) -> Evaluator:
    """What says whether a condition holds; ``lanes``: for each lane."""
    match node:
        case Compare(operator, left, right):
            return _compare(operator, number_of(left, period_ns, lanes=lanes), number_of(right, period_ns, lanes=lanes))
        case Not(of):
            inner = truth_of(of, period_ns, lanes=lanes)
            return lambda k, figures: -inner(k, figures)
        case Logic(operator, left, right):
            one, other = truth_of(left, period_ns, lanes=lanes), truth_of(right, period_ns, lanes=lanes)
            join = np.minimum if operator == "and" else np.maximum
            return lambda k, figures: np.asarray(join(one(k, figures), other(k, figures)))
        case Lanes(which, of):
            each = truth_of(of, period_ns, lanes=True)
            over = np.max if which == "any" else np.min
            return lambda k, figures: np.asarray(over(each(k, figures)))
        case HeldSteps(of, need, among):
            inner = truth_of(of, period_ns, lanes=lanes)
            return _run(inner, need) if need == among else _some(inner, need, among)
        case HeldTime(of, ns):
            return _run(truth_of(of, period_ns, lanes=lanes), -(-ns // period_ns))


def number_of(node: Numeric, period_ns: int, *, lanes: bool) -> Evaluator:
    """What gives the value of a number; ``lanes``: of each lane."""
    match node:
        case Number(value):
            return _constant(value)
        case Span(ns):
            return _constant(ns / 1e9)
        case Quantity("step"):
            return lambda k, figures: np.array(float(k))
        case Quantity():
            return lambda k, figures: np.array(k * period_ns / 1e9)
        case Figure(name, estimator, over):
            return _figure(FIGURES[name], estimator, over or ("each" if lanes else "mean"))
        case LossRate(link, last):
            return _LossRate(link, last)
        case Negative(of):
            inner = number_of(of, period_ns, lanes=lanes)
            return lambda k, figures: np.asarray(-inner(k, figures))
        case Arithmetic(operator, left, right):
            one, other = number_of(left, period_ns, lanes=lanes), number_of(right, period_ns, lanes=lanes)
            combine = _ARITHMETIC[operator]
            return lambda k, figures: np.asarray(combine(one(k, figures), other(k, figures)))
        case Call(function, arguments):
            parts = [number_of(argument, period_ns, lanes=lanes) for argument in arguments]
            return _call(function, parts)


def _constant(value: float) -> Evaluator:
    made = np.array(value)
    return lambda k, figures: made


def _call(function: str, parts: list[Evaluator]) -> Evaluator:
    if function == "abs":
        return lambda k, figures: np.asarray(np.abs(parts[0](k, figures)))
    join = np.minimum if function == "min" else np.maximum
    return lambda k, figures: np.asarray(reduce(join, [part(k, figures) for part in parts]))


def _compare(operator: str, left: Evaluator, right: Evaluator) -> Evaluator:
    test = _COMPARISONS[operator]

    def evaluate(k: int, figures: StepFigures) -> Value:
        a, b = left(k, figures), right(k, figures)
        return np.asarray(np.where(np.isnan(a) | np.isnan(b), 0, np.where(test(a, b), 1, -1)).astype(np.int8))

    return evaluate


def _figure(figure: str, estimator: str, over: str) -> Evaluator:
    def evaluate(k: int, figures: StepFigures) -> Value:
        values = figures.estimators.get(estimator, {}).get(figure)
        return _NAN if values is None else _reduced(values, over)

    return evaluate


def _reduced(values: Floats, over: str) -> Value:
    """The mean is of the finite values, as in the summary; the extremes are of all that there are."""
    if over == "each":
        return values
    there = values[np.isfinite(values) if over == "mean" else ~np.isnan(values)]
    if not len(there):
        return _NAN
    return np.asarray(there.mean() if over == "mean" else there.max() if over == "max" else there.min())


class _LossRate:
    def __init__(self, link: str, last: int | None) -> None:
        self._link = link
        self._steps: deque[tuple[int, int]] | None = None if last is None else deque(maxlen=last)
        self._sent = self._lost = 0

    def __call__(self, k: int, figures: StepFigures) -> Value:
        now = figures.links.get(self._link, (0, 0))
        if self._steps is not None:
            if len(self._steps) == self._steps.maxlen:
                sent, lost = self._steps[0]
                self._sent, self._lost = self._sent - sent, self._lost - lost
            self._steps.append(now)
        self._sent, self._lost = self._sent + now[0], self._lost + now[1]
        return np.array(self._lost / self._sent) if self._sent else _NAN


def _run(inner: Evaluator, need: int) -> Evaluator:
    """Whether it held at the last ``need`` steps."""
    length: Value = np.array(0)

    def evaluate(k: int, figures: StepFigures) -> Value:
        nonlocal length
        length = np.asarray(np.where(inner(k, figures) == 1, length + 1, 0))
        return np.where(length >= need, 1, -1).astype(np.int8)

    return evaluate


def _some(inner: Evaluator, need: int, among: int) -> Evaluator:
    """Whether it held at ``need`` or more of the last ``among`` steps."""
    held: Value = np.zeros(among, dtype=bool)
    total: Value = np.array(0)
    place = 0

    def evaluate(k: int, figures: StepFigures) -> Value:
        nonlocal held, total, place
        now = inner(k, figures) == 1
        if now.ndim == held.ndim:  # the first step at which the lanes differ
            held = np.repeat(held[:, None], len(now), axis=1)
        total = np.asarray(total + now - held[place].astype(int))
        held[place] = now
        place = (place + 1) % among
        return np.where(total >= need, 1, -1).astype(np.int8)

    return evaluate
