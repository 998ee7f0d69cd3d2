"""Checks of snapshots, for estimators that offer them."""

from __future__ import annotations

import numpy as np

from testbed.conformance.compare import distance
from testbed.conformance.result import Failed, Skipped
from testbed.conformance.subject import IN_TIME, STEPS, Subject
from testbed.conformance.theory import DELAY, EXACT, kfio
from testbed.estimator.model import Estimate, Estimator, Restartable
from testbed.estimator.snapshot import Snapshot, restore, take
from testbed.numerics.lanes import matrix_of, vector_of


def restart(subject: Subject) -> str:
    """from its own snapshot, through bytes, it goes on to the same bits"""
    _offered(subject)
    sizes = []
    for case in subject.cases:
        for delays in dict.fromkeys((subject.delays, IN_TIME, (*subject.delays, DELAY))):
            whole = subject.run(case, delays)
            for at in (0, 1, STEPS // 2):
                estimator = subject.make(case)
                outputs = subject.drive(case.first(at), estimator, delays).outputs
                latest = outputs[-1] if outputs else Estimate(*case.model.prior(case.lanes), case.lanes)
                data = take(estimator, "full", step=at, estimate=latest).to_bytes()
                fresh = subject.make(case)
                restore(Snapshot.from_bytes(data), fresh, lanes=case.lanes, n=case.model.n, step=at)
                rest = subject.drive(case, fresh, delays, start=at)
                for name in ("x_hat", "P"):
                    expected = np.array([getattr(out, name) for out in whole.outputs[at:]])
                    found = np.array([getattr(out, name) for out in rest.outputs])
                    if not np.array_equal(expected, found):
                        raise Failed(f"{name} differs by {np.abs(expected - found).max():.2g} after a restart at {at}")
                sizes.append(len(data))
    return f"{len(sizes)} restarts, {min(sizes)} … {max(sizes)} bytes, the same bits"


def hand_over(subject: Subject) -> str:
    """it starts from the x_hat and P of another kind, and with every ACK goes on as the Kalman filter does"""
    _offered(subject)
    at, worst = STEPS // 2, 0.0
    for case in subject.cases:
        if case.model.holds:  # they do not say which input is held
            continue
        reference = kfio(case)
        estimator = subject.make(case)
        moments = Estimate(vector_of(reference.x_hat[at - 1]), matrix_of(reference.P[at - 1]), case.lanes)
        taken = Snapshot("moments", "kfio", 1, at, case.lanes, case.model.n, {"x_hat": moments.x_hat, "P": moments.P})
        restore(Snapshot.from_bytes(taken.to_bytes()), estimator, lanes=case.lanes, n=case.model.n)
        run = subject.drive(case, estimator, IN_TIME, start=at)
        if not (np.isfinite(run.x_hat).all() and np.isfinite(run.P).all()):
            raise Failed(f"not finite after a start from moments ({case.name})")
        if "kfio_with_acks" in subject.not_claimed:
            continue
        error = distance(run.x_hat, run.P, reference.x_hat[at:], reference.P[at:])
        if not error <= EXACT + run.error_bound:
            raise Failed(f"differs from kfio by {error:.2g} after a start from its moments ({case.name})")
        worst = max(worst, error)
    if "kfio_with_acks" in subject.not_claimed:
        return f"goes on from the moments of step {at}"
    return f"differs from kfio by {worst:.2g} at most"


def _offered(subject: Subject) -> None:
    made: Estimator = subject.make(subject.cases[0])
    if not isinstance(made, Restartable):
        raise Skipped("it offers no snapshot: STATE_VERSION, state, set_state, start_from")
