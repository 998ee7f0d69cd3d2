"""The conditions of events that wait: told the figures of each step, in order, they say when they begin to hold."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np

from testbed.numerics.lanes import Component, Floats
from testbed.scenario.conditions import Condition, StepFigures
from testbed.scenario.conditions.figures import FIGURES


@dataclass
class _Step:
    """What has come of a step: by estimator the figures of each block of lanes, by link its packets."""

    figures: dict[str, dict[int, dict[str, Component]]] = field(default_factory=dict)
    links: dict[str, dict[int, tuple[int, int]]] = field(default_factory=dict)


class Watch:
    """Keeps the figures of the steps that are not evaluated yet, as far as a condition needs them.

    blocks: first lanes of the blocks. runs: whether a name has an estimate of a step, asked once all estimates are in.
    """

    def __init__(self, blocks: Iterable[int], runs: Callable[[str, int], bool]) -> None:
        self._blocks, self._runs = sorted(blocks), runs
        self._conditions: dict[int, tuple[Condition, int]] = {}
        self._steps: dict[int, _Step] = {}
        self.evaluated = 0
        """Steps whose figures are told, or that nobody waited for."""

    def __bool__(self) -> bool:
        return bool(self._conditions)

    def add(self, number: int, condition: Condition, after: int) -> None:
        """Let an event wait for a condition, which is told the steps after ``after``: nothing has come of them yet."""
        if not self._conditions:
            self.evaluated = max(self.evaluated, after)
        self._conditions[number] = condition, after

    def drop(self, number: int) -> None:
        """The event waits no more."""
        del self._conditions[number]
        if not self._conditions:
            self._steps.clear()

    def note(self, name: str, step: int, lane: int, figures: dict[str, Component]) -> None:
        """Take the figures of an estimator for one block of lanes."""
        if step > self.evaluated and name in self._names(step):
            self._of(step).figures.setdefault(name, {})[lane] = figures

    def count(self, link: str, step: int, lane: int, sent: int, lost: int) -> None:
        """Take the fate of one packet of a link: so many lanes, and in how many of them it was lost."""
        if step > self.evaluated and link in self._links(step):
            self._of(step).links.setdefault(link, {})[lane] = sent, lost

    def tell(self, estimated: int) -> list[tuple[int, int]]:
        """(number, step k) of the conditions that begin to hold; ``estimated``: steps whose estimates are all there.

        Stops at the first step at which one does, so that what follows from it comes first.
        """
        while self._conditions and self.evaluated < estimated and self._whole(self.evaluated + 1):
            self.evaluated += 1
            step = self._steps.pop(self.evaluated, _Step())
            told = StepFigures(
                {name: _joined(blocks) for name, blocks in step.figures.items()},
                {link: _sum(blocks) for link, blocks in step.links.items()},
            )
            rising = [
                number
                for number, (condition, after) in self._conditions.items()
                if after < self.evaluated and condition.update(self.evaluated, told)
            ]
            if rising:
                return [(number, self.evaluated) for number in rising]
        return []

    def _whole(self, step: int) -> bool:
        found = self._steps.get(step, _Step())
        names = [name for name in self._names(step) if self._runs(name, step)]
        return all(sorted(found.figures.get(name, {})) == self._blocks for name in names) and all(
            sorted(found.links.get(link, {})) == self._blocks for link in self._links(step)
        )

    def _names(self, step: int) -> set[str]:
        """The estimators whose figures of a step are needed."""
        told = [condition for condition, after in self._conditions.values() if after < step]
        return {name for condition in told for name, _ in condition.estimators}

    def _links(self, step: int) -> set[str]:
        told = [condition for condition, after in self._conditions.values() if after < step]
        return {link for condition in told for link in condition.links}

    def _of(self, step: int) -> _Step:
        return self._steps.setdefault(step, _Step())


def _joined(blocks: dict[int, dict[str, Component]]) -> dict[str, Floats]:
    parts = [figures for _, figures in sorted(blocks.items())]
    return {name: np.concatenate([np.atleast_1d(part[name]) for part in parts]) for name in FIGURES.values()}


def _sum(blocks: dict[int, tuple[int, int]]) -> tuple[int, int]:
    sent, lost = zip(*blocks.values(), strict=True)
    return sum(sent), sum(lost)
