"""Checks of the form: what comes out of a step, and what it leaves alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from testbed.conformance.cases import Case, simulated, two, without_control
from testbed.conformance.compare import asymmetry, smallest_eigenvalue
from testbed.conformance.result import Failed
from testbed.conformance.subject import Run, Subject

ROUNDING = 1e-9


def shapes(subject: Subject) -> str:
    """x_hat (M, n) and P (M, n, n) are arrays of float64; counters holds integers by name"""
    for run in subject.runs:
        _ = run.x_hat, run.P  # Failed where a shape is wrong
        for out in run.outputs:
            for name in ("x_hat", "P"):
                array = getattr(out, name)
                if not isinstance(array, np.ndarray) or array.dtype != np.float64:
                    found = array.dtype if isinstance(array, np.ndarray) else type(array).__name__
                    raise Failed(f"{name} is {found}; expected an array of float64")
    counters = subject.make(subject.cases[0]).counters
    if not isinstance(counters, dict) or not all(
        isinstance(k, str) and isinstance(v, int) for k, v in counters.items()
    ):
        raise Failed(f"counters is {counters!r}; expected whole numbers by name")
    systems = "; ".join(f"{case.name}, lanes {case.lanes}" for case in subject.cases)
    return f"{_steps(subject.runs)} steps: {systems}"


def finite(subject: Subject) -> str:
    """x_hat and P hold numbers only"""
    for run in subject.runs:
        for k in range(run.case.steps):
            if not (np.isfinite(run.x_hat[k]).all() and np.isfinite(run.P[k]).all()):
                raise Failed(f"not finite at step {k + 1} ({run.case.name})")
    return f"{_steps(subject.runs)} steps"


def symmetric(subject: Subject) -> str:
    """P is symmetric"""
    worst, name = max((asymmetry(run.P), run.case.name) for run in subject.runs)
    if not worst <= ROUNDING:
        raise Failed(f"|P − P'| is {worst:.2g} of the largest entry ({name}); allowed: {ROUNDING:g}")
    return f"|P − P'| at most {worst:.2g} of the largest entry"


def positive(subject: Subject) -> str:
    """P has no negative eigenvalue"""
    worst, name = min((smallest_eigenvalue(run.P), run.case.name) for run in subject.runs)
    if not worst >= -ROUNDING:
        raise Failed(f"smallest eigenvalue {worst:.2g} of the largest entry ({name}); allowed: {-ROUNDING:g}")
    return f"smallest eigenvalue {worst:.2g} of the largest entry"


def no_control(subject: Subject) -> str:
    """a model without B is taken, with u of shape (M, 0)"""
    case = simulated("no control", without_control(two(subject.control)), steps=4, lanes=2, seed=5)
    run = subject.run(case, ())
    if not (np.isfinite(run.x_hat).all() and np.isfinite(run.P).all()):
        raise Failed("not finite")
    return "4 steps on 2 lanes"


def inputs_kept(subject: Subject) -> str:
    """a step does not change its inputs, and takes arrays that cannot be written"""
    for case in subject.cases:
        for writeable in (True, False):
            estimator = subject.make(case)
            for k in range(1, case.steps + 1):
                acks = case.acks(k, subject.delays)
                named = {"u": case.u[k - 1].copy(), "y": case.y[k - 1].copy(), "arrived": case.arrived[k - 1].copy()}
                named |= {f"ACK {name}": getattr(ack, name) for ack in acks for name in ("nu", "known")}
                before = {name: array.copy() for name, array in named.items()}
                for array in named.values():
                    array.setflags(write=writeable)
                estimator.step(named["u"], named["y"], named["arrived"], acks)
                for name, array in named.items():
                    if not np.array_equal(array, before[name]):
                        raise Failed(f"{name} was changed at step {k} ({case.name})")
    return f"u, y, arrived and ACKs over {sum(case.steps for case in subject.cases)} steps"


def outputs_kept(subject: Subject) -> str:
    """a step does not change what earlier steps gave"""
    for case in subject.cases:
        estimator, outputs, copies = subject.make(case), [], []
        for k in range(1, case.steps + 1):
            acks = case.acks(k, subject.delays)
            out = estimator.step(case.u[k - 1].copy(), case.y[k - 1].copy(), case.arrived[k - 1].copy(), acks)
            given = out.x_hat, out.P
            outputs.append((out, *given))
            copies.append((given[0].copy(), given[1].copy()))
        for k, ((out, x_hat, P), (old_x, old_P)) in enumerate(zip(outputs, copies, strict=True), 1):
            for name, arrays, old in (("x_hat", (out.x_hat, x_hat), old_x), ("P", (out.P, P), old_P)):
                if not all(np.array_equal(array, old, equal_nan=True) for array in arrays):
                    raise Failed(f"{name} of step {k} was changed later ({case.name})")
    return f"{sum(case.steps for case in subject.cases)} steps"


def lost_y_ignored(subject: Subject) -> str:
    """y of a lane in which nothing arrived does not matter"""
    for case in subject.cases:
        noise = np.where(case.arrived[:, :, None], case.y, 1e3)
        _same_bits(subject.run(case), subject.run(replace(case, y=noise)), f"y = 1000 where lost ({case.name})")
    lost = sum(int((~case.arrived).sum()) for case in subject.cases)
    return f"{lost} lost observations, the same bits"


def deterministic(subject: Subject) -> str:
    """the same inputs give the same bits, also with another object at work beside it"""
    for case in subject.cases:
        first, second = subject.make(case), subject.make(case)
        runs: tuple[list[object], list[object]] = [], []
        for k in range(1, case.steps + 1):
            for estimator, outputs, row in ((first, runs[0], k - 1), (second, runs[1], case.steps - k)):
                acks = case.acks(k, subject.delays)
                outputs.append(estimator.step(case.u[row].copy(), case.y[row].copy(), case.arrived[row].copy(), acks))
        alone, again = subject.run(case), subject.run(case)
        _same_bits(alone, again, f"run twice ({case.name})")
        _same_bits(alone, Run(case, runs[0]), f"run beside another object ({case.name})")
    return "three runs of each case, the same bits"


def _same_bits(first: Run, second: Run, when: str) -> None:
    for name, a, b in (("x_hat", first.x_hat, second.x_hat), ("P", first.P, second.P)):
        differs = np.flatnonzero((a != b).reshape(len(a), -1).any(axis=1))
        if len(differs):
            raise Failed(f"{name} differs by {np.abs(a - b).max():.2g} from step {differs[0] + 1} on: {when}")


def _steps(runs: list[Run]) -> int:
    return sum(run.case.steps for run in runs)


def lanes(subject: Subject) -> str:
    """a lane's estimate depends neither on the lanes beside it nor on how lanes are split"""
    worst = 0.0
    for case in subject.cases:
        whole = subject.run(case)
        for cuts in _splits(case):
            for cut in cuts:
                part = subject.run(case.of_lanes(cut), lane=cut.start)
                for name in ("x_hat", "P"):
                    a, b = getattr(whole, name)[:, cut], getattr(part, name)
                    scale = max(float(np.abs(a).max()), 1.0)
                    error = float(np.nan_to_num(np.abs(a - b), nan=np.inf).max()) / scale
                    if error > ROUNDING:
                        text = f"{name} of lanes {cut.start} … {cut.stop - 1} alone differs by {error:.2g}"
                        raise Failed(f"{text} from that among {case.lanes} ({case.name})")
                    worst = max(worst, error)
    exact = "to the same bits" if worst == 0.0 else f"within {worst:.2g}: runs then depend on the split by that much"
    return f"3 lanes as 3, as 1 + 2 and one by one, {exact}"


def _splits(case: Case) -> list[list[slice]]:
    if case.lanes == 1:
        return []
    single = [slice(lane, lane + 1) for lane in range(case.lanes)]
    return [single, [slice(0, 1), slice(1, case.lanes)]]
