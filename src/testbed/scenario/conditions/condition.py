"""A condition: parsed once, then told each step, it says when it begins to hold."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields

import numpy as np

from testbed.scenario.conditions.evaluate import truth_of
from testbed.scenario.conditions.figures import FIGURES, Names, StepFigures
from testbed.scenario.conditions.parser import parse
from testbed.scenario.conditions.syntax import Figure, LossRate, Node, Truth, text_of


class Condition:
    """One condition and its memory of the steps that it was told."""

    def __init__(self, parts: Truth, period_ns: int) -> None:
        self.parts = parts
        self._period_ns = period_ns
        self._evaluate = truth_of(parts, period_ns)
        self._last: int | None = None
        self._held = False

    @classmethod
    def parse(cls, text: str, names: Names) -> Condition:
        """The condition of a text. Raises UsageError, of one line, where it is none."""
        return cls(parse(text, names), names.period_ns)

    def __str__(self) -> str:
        """Its text in the shortest form, which parses to the same condition."""
        return text_of(self.parts)

    @property
    def estimators(self) -> frozenset[tuple[str, str]]:
        """(estimator, figure) of all that ``update`` needs; figures under their names in the results."""
        return frozenset((n.estimator, FIGURES[n.name]) for n in _all(self.parts) if isinstance(n, Figure))

    @property
    def links(self) -> frozenset[str]:
        """The links of which ``update`` needs the counts."""
        return frozenset(node.link for node in _all(self.parts) if isinstance(node, LossRate))

    def update(self, k: int, figures: StepFigures) -> bool:
        """Whether it holds at step k and did not at the step before, or at none yet. Steps are told in order.

        Raises ValueError where a step is left out or told twice.
        """
        if self._last is not None and k != self._last + 1:
            raise ValueError(f"step {k} after step {self._last}")
        with np.errstate(all="ignore"):  # what has no value is not-a-number
            holds = bool(self._evaluate(k, figures) == 1)
        rises = holds and not self._held
        self._last, self._held = k, holds
        return rises


def _all(node: Node) -> Iterator[Node]:
    """A part and all the parts in it."""
    yield node
    for field in fields(node):
        value = getattr(node, field.name)
        for part in value if isinstance(value, tuple) else (value,):
            if hasattr(part, "__dataclass_fields__"):
                yield from _all(part)
