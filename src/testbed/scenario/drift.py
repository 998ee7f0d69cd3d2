"""The plant as its parameters drift: a pure function of the step."""

from __future__ import annotations

from collections.abc import Sequence

from pydantic import ValidationError

from testbed.errors import UsageError
from testbed.scenario.base import Matrix, size
from testbed.scenario.plant_events import PARAMETERS, PlantEvent
from testbed.scenario.system import System

Drift = Sequence[tuple[int, PlantEvent]]
"""Changes with their first step, in the order of time."""


def drifted(system: System, drift: Drift, k: int) -> System:
    """The parameters of step k. One that an event does not name goes on as it was, also in the middle of a change."""
    update = {}
    for name in PARAMETERS:
        changes = [(step, event.values[name], event.over) for step, event in drift if name in event.values]
        if any(step <= k for step, _, _ in changes):
            update[name] = _value(_given(system, name), changes, k)
    return system.model_copy(update=update) if update else system


def moving(system: System, drift: Drift, k: int) -> System:
    """What moves x_k to x_{k+1} and shows y_{k+1}: A, B, G and Q of step k, C and R of step k + 1."""
    here, after = drifted(system, drift, k), drifted(system, drift, k + 1)
    return here.model_copy(update={"C": after.C, "R": after.R})


def settles(drift: Drift) -> int:
    """The first step from which on nothing changes any more; 0 where nothing does."""
    return max((step + event.over - 1 for step, event in drift), default=0)


def check_plant(system: System, event: PlantEvent) -> None:
    """Raises UsageError where the new values do not fit the system."""
    from testbed.scenario.explain import explain

    if event.B is not None and system.B is None:
        raise UsageError("B: got a matrix, but system.B is not given; allowed: only with system.B")
    for name, value in event.values.items():
        before = _given(system, name)
        if size(value) != size(before):
            (rows, columns), (n, m) = size(value), size(before)
            raise UsageError(f"{name}: got {rows} × {columns}; allowed: {n} × {m}, as in [system]")
    try:
        System.model_validate({**system.model_dump(exclude_none=True), **event.values})
    except ValidationError as error:
        raise UsageError(explain(error, System)) from None


def _given(system: System, name: str) -> Matrix:
    value: Matrix | None = getattr(system, name)
    if value is None:  # G, the identity
        return tuple(tuple(float(i == j) for j in range(system.n)) for i in range(system.n))
    return value


def _value(first: Matrix, changes: Sequence[tuple[int, Matrix, int]], k: int) -> Matrix:
    """At step k: the last change that has begun, from where the one before it stood then."""
    begun = [i for i, (step, _, _) in enumerate(changes) if step <= k]
    if not begun:
        return first
    step, to, over = changes[begun[-1]]
    share = (k - step + 1) / over
    if share >= 1.0:
        return to
    base = _value(first, changes[: begun[-1]], step - 1)
    return tuple(
        tuple(a + share * (b - a) for a, b in zip(row, new, strict=True)) for row, new in zip(base, to, strict=True)
    )
