"""The estimator under examination: made and driven as the testbed makes and drives it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from testbed.channel.loss import Chain
from testbed.conformance.cases import BERNOULLI, HIDDEN, MARKOV, Case, holding, one, simulated, three, two
from testbed.conformance.result import Failed, Skipped
from testbed.errors import UsageError
from testbed.estimator.errors import MissingAck
from testbed.estimator.model import Estimator, Model
from testbed.estimator.registry import check_actuator
from testbed.numerics.lanes import Floats

STEPS = 9
GILBERT_ELLIOTT = "n = 2, Gilbert–Elliott"
HOLD = "n = 2, hold"
IN_TIME = (0,)
"""Delays of ACKs: each comes with the step in which its packet counts."""


@dataclass(frozen=True)
class Run:
    """What came out of each step, unchecked."""

    case: Case
    outputs: list[Any]

    @cached_property
    def x_hat(self) -> Floats:
        """(K, M, n). Raises Failed where an output has another shape."""
        return self._stacked("x_hat", (self.case.lanes, self.case.model.n))

    @cached_property
    def P(self) -> Floats:
        """(K, M, n, n)."""
        return self._stacked("P", (self.case.lanes, self.case.model.n, self.case.model.n))

    @property
    def error_bound(self) -> float:
        """The largest error that the estimator itself certifies, 0 where it certifies none."""
        bounds = [getattr(out, name, None) for out in self.outputs for name in ("error_bound", "error_bound_P")]
        return max((float(np.max(bound)) for bound in bounds if bound is not None), default=0.0)

    def _stacked(self, name: str, shape: tuple[int, ...]) -> Floats:
        for k, out in enumerate(self.outputs, 1):
            found = np.shape(getattr(out, name))
            if found != shape:
                raise Failed(f"{name} has shape {found} at step {k} ({self.case.name}); expected {shape}")
        return np.array([getattr(out, name) for out in self.outputs], dtype=np.float64)


@dataclass
class Subject:
    """An estimator as the kit knows it: called with (model, lanes, **options)."""

    name: str
    factory: Callable[..., Any]
    options: Mapping[str, Any] = field(default_factory=dict)

    def make(self, case: Case, lane: int = 0) -> Estimator:
        made: Estimator = self.factory(case.model, case.lanes, **self.options)
        check_actuator(made, case.model)
        begin_at = getattr(made, "begin_at", None)
        if begin_at is not None:
            begin_at(lane)
        return made

    @cached_property
    def not_claimed(self) -> dict[str, str]:
        """What the estimator says that it does not do, with its reasons."""
        return dict(getattr(self.make(self._probe(self.control)), "not_claimed", {}))

    @cached_property
    def control(self) -> Chain:
        """Markov losses of the control, or i.i.d. ones where the estimator refuses those."""
        try:
            self.make(self._probe(MARKOV))
        except UsageError:
            return BERNOULLI
        return MARKOV

    @cached_property
    def delays(self) -> tuple[int, ...]:
        """How ACKs come where a check says nothing of them: not at all, or in time where it cannot do without."""
        case = self._probe(self.control)
        try:
            self.drive(case, self.make(case), ())
        except MissingAck:
            return IN_TIME
        return ()

    @cached_property
    def cases(self) -> list[Case]:
        """Those that the estimator takes; the first has one lane."""
        return [case for case in self._all_cases if case.name not in self.refused]

    @cached_property
    def refused(self) -> dict[str, str]:
        """The systems that the estimator refuses, by name, with what it says. Raises UsageError where it takes none."""
        refused = {}
        for case in self._all_cases:
            try:
                self.make(case)
            except UsageError as error:
                refused[case.name] = str(error)
                if len(refused) == len(self._all_cases):
                    raise
        return refused

    @cached_property
    def small(self) -> dict[str, Model]:
        """The systems with one and two states, of those that it takes. Raises Skipped where it takes none of them."""
        models = {"n = 1": one(self.control), "n = 2": two(self.control), HOLD: holding(two(self.control))}
        taken = {name: model for name, model in models.items() if name not in self.refused}
        if not taken:
            raise Skipped("it refuses systems with one and two states")
        return taken

    @cached_property
    def _all_cases(self) -> list[Case]:
        out = [
            simulated("n = 1", one(self.control), steps=STEPS, lanes=1, seed=1),
            simulated("n = 2", two(self.control), steps=STEPS, lanes=3, seed=2),
            simulated("n = 3", three(self.control), steps=STEPS, lanes=3, seed=3),
            simulated(HOLD, holding(two(self.control)), steps=STEPS, lanes=3, seed=6),
        ]
        if self.control is MARKOV:
            out.append(simulated(GILBERT_ELLIOTT, two(HIDDEN), steps=STEPS, lanes=3, seed=4))
        return out

    @cached_property
    def runs(self) -> list[Run]:
        """Of the cases, with every ACK in time and, where it can, with none."""
        return [self.run(case, delays) for case in self.cases for delays in dict.fromkeys((self.delays, IN_TIME))]

    def run(self, case: Case, delays: tuple[int, ...] | None = None, *, lane: int = 0) -> Run:
        """A fresh estimator over a case. It gets copies, so that it can change nothing here."""
        return self.drive(case, self.make(case, lane), self.delays if delays is None else delays)

    def drive(self, case: Case, estimator: Estimator, delays: tuple[int, ...], start: int = 0) -> Run:
        """An estimator that has done ``start`` steps over the rest of a case."""
        outputs = []
        for k in range(start + 1, case.steps + 1):
            inputs = case.u[k - 1].copy(), case.y[k - 1].copy(), case.arrived[k - 1].copy()
            outputs.append(estimator.step(*inputs, case.acks(k, delays)))
        return Run(case, outputs)

    def _probe(self, control: Chain) -> Case:
        return simulated("n = 1", one(control), steps=1, lanes=1, seed=1)
