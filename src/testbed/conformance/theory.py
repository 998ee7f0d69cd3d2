"""Checks of the theory: what holds of x̂ and P for the systems of the testbed."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from testbed.conformance.cases import Case, simulated
from testbed.conformance.compare import distance, ratio, smallest_eigenvalue
from testbed.conformance.form import ROUNDING
from testbed.conformance.result import Failed
from testbed.conformance.subject import IN_TIME, Run, Subject
from testbed.estimator.bounds import Bounds
from testbed.estimator.errors import TooManyHistories
from testbed.estimator.kfio import Kfio
from testbed.estimator.model import Model
from testbed.numerics.lanes import Floats

EXACT = 1e-8
SHORTFALL = 0.05
"""Part by which a mean of P may be below the bound: covariances of samples are."""
NEES = 0.7, 1.4
LOST, LOST_BLIND = 300, 30
LOST_SHORTFALL = 0.3
"""As SHORTFALL, of two lanes."""
DELAY = 3
_LANES = 120
_T = np.array([[1.3, -0.4, 0.2], [0.5, 0.9, -0.3], [-0.2, 0.6, 1.1]])


def kfio(case: Case) -> Run:
    """The Kalman filter with every ACK, of this testbed."""
    return Subject("kfio", Kfio).run(case, IN_TIME)


def kfio_with_acks(subject: Subject) -> str:
    """with every ACK in time it is the Kalman filter with intermittent observations"""
    worst = 0.0
    for case in subject.cases:
        run, reference = subject.run(case, IN_TIME), kfio(case)
        error = distance(run.x_hat, run.P, reference.x_hat, reference.P)
        if not error <= EXACT + run.error_bound:
            raise Failed(f"differs from kfio by {error:.2g} ({case.name}); allowed: {EXACT + run.error_bound:.2g}")
        worst = max(worst, error)
    return f"differs from kfio by {worst:.2g} at most"


def coordinates(subject: Subject) -> str:
    """in the coordinates T x it gives T x_hat and T P T'"""
    worst = 0.0
    for case in subject.cases:
        T = _T[: case.model.n, : case.model.n]
        run, moved = subject.run(case), subject.run(case.moved(T))
        error = distance(moved.x_hat, moved.P, run.x_hat @ T.T, T @ run.P @ T.T)
        allowed = EXACT + 10.0 * (run.error_bound + moved.error_bound)
        if not error <= allowed:
            raise Failed(f"differs by {error:.2g} ({case.name}); allowed: {allowed:.2g}")
        worst = max(worst, error)
    return f"differs by {worst:.2g} at most"


def late_acks(subject: Subject) -> str:
    """an ACK that comes late is used, or counted"""
    delays = (*subject.delays, DELAY)
    changed, counted, sent = 0, 0, 0
    for case in subject.cases:
        estimator = subject.make(case)
        run, plain = subject.drive(case, estimator, delays), subject.run(case)
        differs = not (np.array_equal(run.x_hat, plain.x_hat) and np.array_equal(run.P, plain.P))
        late = (case.steps - DELAY) * case.lanes
        found = sum(estimator.counters.values())
        if differs and subject.delays:
            raise Failed(f"an ACK that it had in time changes its estimate when it comes again ({case.name})")
        if not differs and found < late:
            raise Failed(f"{late} late ACKs change no estimate, and counters has {found} ({case.name})")
        changed, counted, sent = changed + differs, counted + found, sent + late
    used = f"they change the estimate in {changed} of {len(subject.cases)} cases"
    return f"{sent} ACKs {DELAY} steps late: {counted} counted, {used}"


def ack_bound(subject: Subject) -> str:
    """on average P is not below the covariance with every ACK"""
    worst = np.inf
    for case in _many(subject):
        found = ratio(subject.run(case).P.mean(axis=1), _lower(case).mean(axis=1))
        if not found >= 1.0 - SHORTFALL:
            raise Failed(
                f"mean of P is {found:.3g} times the bound ({case.name}); allowed: {1.0 - SHORTFALL:g} or more"
            )
        worst = min(worst, found)
    return f"mean of P over {_LANES} lanes at least {worst:.3g} times the bound"


def consistency(subject: Subject) -> str:
    """the mean of (x − x_hat)' P⁻¹ (x − x_hat) is about n"""
    texts = []
    for case in _many(subject):
        run = subject.run(case)
        error = case.x - run.x_hat
        if smallest_eigenvalue(run.P) <= 0.0:
            raise Failed(f"P cannot be inverted ({case.name})")
        squares = (error * np.linalg.solve(run.P, error[..., None])[..., 0]).sum(axis=2)
        found = float(squares.mean()) / case.model.n
        if not NEES[0] <= found <= NEES[1]:
            why = "P is too small" if found > 1.0 else "P is too large"
            raise Failed(f"it is {found:.3g} n ({case.name}), {why}; allowed: {NEES[0]} … {NEES[1]} n")
        texts.append(f"{found:.3g} n ({case.name})")
    return f"{', '.join(texts)}, over {_LANES} lanes"


def long_losses(subject: Subject) -> str:
    """hundreds of lost observations: finite, P not below the covariance with every ACK, and back afterwards"""
    systems = subject.small
    worst = min(_through(subject, LOST, name, model, IN_TIME) for name, model in systems.items())
    texts = [f"{LOST} lost in a row with every ACK"]
    if not subject.delays:
        found: dict[str, float] = {}
        for name, model in systems.items():
            with suppress(TooManyHistories):
                found[name] = _through(subject, LOST_BLIND, name, model, ())
        worst = min([worst, *found.values()])
        beyond = [name for name in systems if name not in found]
        where = "" if not beyond or not found else f" ({', '.join(beyond)})"
        texts.append(f"{LOST_BLIND} with none" + (f" are more than it can enumerate{where}" if beyond else ""))
    return f"{', '.join(texts)}: P at least {worst:.3g} times the covariance with every ACK"


def _through(subject: Subject, lost: int, name: str, model: Model, delays: tuple[int, ...]) -> float:
    """The smallest ratio of P to the covariance with every ACK on the way through ``lost`` losses."""
    case = simulated(name, model, steps=lost + 6, lanes=2, seed=7, arrivals=True)
    case.arrived[3 : lost + 3] = False
    case.y[3 : lost + 3] = 0.0
    run, where = subject.run(case, delays), f"{name}, {'every ACK' if delays else 'no ACK'}"
    for k in range(case.steps):
        if not (np.isfinite(run.x_hat[k]).all() and np.isfinite(run.P[k]).all()):
            raise Failed(f"not finite after {max(0, min(k - 2, lost))} losses ({where})")
    eigenvalue = smallest_eigenvalue(run.P)
    if not eigenvalue >= -ROUNDING:
        raise Failed(f"P has the eigenvalue {eigenvalue:.2g} of its largest entry ({where})")
    during = slice(0, lost + 3)
    found = ratio(run.P[during].mean(axis=1), _lower(case)[during].mean(axis=1))
    if not found >= 1.0 - LOST_SHORTFALL:
        raise Failed(f"P falls to {found:.3g} times the covariance with every ACK ({where})")
    before, after = run.P[lost + 2].trace(axis1=1, axis2=2), run.P[-1].trace(axis1=1, axis2=2)
    if not (after < before).all():
        raise Failed(f"three observations after {lost} losses do not make P smaller ({where})")
    return found


def _many(subject: Subject) -> list[Case]:
    models = subject.small.items()
    return [simulated(name, model, steps=8, lanes=_LANES, seed=11 + model.n) for name, model in models]


def _lower(case: Case) -> Floats:
    """The covariance with every ACK, (K, M, n, n)."""
    bounds = Bounds(case.model, None, case.lanes)
    return np.array([bounds.step(arrived)[0] for arrived in case.arrived])
