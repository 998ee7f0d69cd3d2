"""From one estimator to the next: the bytes that one gives, and what the other starts from.

cold: the prior of the scenario, x0_mean and P0, taken for the step that was just done. It is the start of the whole
run at a later step: what the plant has done since is not known, and P0 says nothing of it.
moments: the last estimate and its covariance. full: the state besides, the counters, and what is kept for late packets.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from testbed.errors import UsageError
from testbed.estimator.model import Estimate, Model, Restartable
from testbed.estimator.refilter import Refilter
from testbed.estimator.registry import kind_of
from testbed.estimator.snapshot import MEMORY, Form, Snapshot, restore, take
from testbed.numerics.lanes import matrix_of, vector_of


def give(refilter: Refilter, form: Form, *, step: int, estimate: Estimate) -> bytes:
    """A snapshot after ``step`` steps, the last of which gave ``estimate``.

    Raises UsageError for an estimator that has no state to give.
    """
    if form == "moments":
        x_hat, P = np.array(estimate.x_hat), np.array(estimate.P)
        lanes, n = x_hat.shape
        kind = kind_of(refilter.estimator)
        return Snapshot("moments", kind, 0, step, lanes, n, {"x_hat": x_hat, "P": P}).to_bytes()
    snapshot = take(refilter.estimator, form, step=step, estimate=estimate)
    memory = {MEMORY + name: array for name, array in refilter.memory().items()}
    return replace(snapshot, arrays={**snapshot.arrays, **memory}).to_bytes()


def start(
    refilter: Refilter, form: Literal["cold", "moments", "full"], data: bytes, *, model: Model, lanes: int, step: int
) -> Estimate:
    """Let a fresh estimator go on after ``step`` steps; ``data``: what ``give`` gave, nothing if cold.

    The estimate from which it goes on. Raises UsageError where it cannot.
    """
    estimator = refilter.estimator
    if form == "cold":
        if not isinstance(estimator, Restartable):
            raise UsageError(f"estimator {kind_of(estimator)!r} cannot start at a later step; it lacks start_from")
        x_hat, P = np.tile(model.x0_mean, (lanes, 1)), np.tile(model.P0, (lanes, 1, 1))
        estimator.start_from(step, x_hat, P)
        refilter.begin_at(step)
        return Estimate(vector_of(x_hat), matrix_of(P), lanes)
    snapshot = Snapshot.from_bytes(data)
    if snapshot.form != form:
        raise UsageError(f"snapshot: in the {snapshot.form} form; expected {form}")
    restore(snapshot, estimator, lanes=lanes, n=model.n, step=step)
    if form == "moments":
        refilter.begin_at(step)
    else:
        memory = {n.removeprefix(MEMORY): array for n, array in snapshot.arrays.items() if n.startswith(MEMORY)}
        refilter.remember(step, memory)
    return Estimate(vector_of(snapshot.arrays["x_hat"]), matrix_of(snapshot.arrays["P"]), lanes)
