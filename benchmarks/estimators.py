"""Estimators in one process: KFIO beside other libraries, AOE and GPB beside numpy, OE and its growth, losses."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks import filters, mixtures, optimal
from benchmarks.figures import Figures, Median, Target, alternate, ratios
from testbed.channel.loss import Chain, LossProcess
from testbed.estimator.model import Model
from testbed.estimator.registry import create
from testbed.numerics.kernels import available
from testbed.numerics.streams import Stream

STEPS = 100
AGREEMENT = {"kfio": 1e-10, "aoe": 1e-9, "gpb": 1e-9}
"""Largest difference allowed, relative to the largest entry; beyond it a comparison of times means nothing."""
CHAINS = {"Bernoulli": Chain.bernoulli(0.8), "Markov": Chain.markov(0.5, 0.2)}
MARKOV = CHAINS["Markov"]
TWO, TWO_COPIES = "testbed, block, two threads", "copy, two threads"


def run(*, quick: bool) -> Figures:
    figures = Figures("estimators")
    repetitions = 3 if quick else 7
    _kfio(figures, repetitions, budget_s=0.2 if quick else 1.0)
    _mixtures(figures, repetitions, lanes=2048 if quick else 4096, steps=10 if quick else 25)
    _optimal(figures, repetitions, quick=quick)
    _growth(figures, limit_s=3.0 if quick else 15.0)
    _losses(figures, repetitions, packets=100 if quick else 500)
    compiled = "compiled with numba" if available() else "without numba"
    figures.notes.append(
        f"one thread unless it says two, {len(os.sched_getaffinity(0))} CPUs, {compiled}, after a run that compiles; "
        "median (lowest … highest); ratios are between neighbours in time; other libraries compared on 32 lanes, "
        "timed on the number of lanes that suits them best"
    )
    return figures


def _kfio(figures: Figures, repetitions: int, budget_s: float) -> None:
    """ns a lane-step; each alternative on the number of lanes that suits it best, after its results were compared."""
    given = filters.problem(STEPS, 20_000)
    few = given.first(32)
    reference = filters.ours_step_by_step(few)()
    whole = filters.ours_step_by_step(given)()
    block, fresh = filters.OursBlock(given), filters.OursBlock(given, fresh=True)
    both = filters.OursBlock(given, threads=2)
    agreed = {"testbed, block": _distance(block.result(), whole), TWO: _distance(both.result(), whole)}
    del whole
    size = given.steps * given.lanes
    stepwise = "testbed, step by step"
    cases: dict[str, Callable[[], float]] = {
        stepwise: lambda: _ns(filters.timed_step_by_step(given), size),
        "testbed, block": lambda: _ns(block.run, size),
        "copy of those bytes": lambda: _ns(block.copy, size),
        TWO: lambda: _ns(both.run, size),
        TWO_COPIES: lambda: _ns(both.copy, size),
        "testbed, block, fresh memory": lambda: _ns(fresh.run, size),
        "copy, fresh memory": lambda: _ns(fresh.copy, size),
    }
    lanes = dict.fromkeys(cases, given.lanes)
    others = {"numpy, batched matmul": filters.numpy_batched}
    for name, call in filters.installed():
        if call is None:
            figures.notes.append(f"{name} is not installed and left out (the extra bench brings it)")
        else:
            others[f"{name} {version(name)}"] = call
    for name, call in others.items():
        agreed[name] = _distance(call(few), reference)
        lanes[name] = _best_lanes(call, given, budget_s)
        cases[name] = _timed(call, given.first(lanes[name]))
    times = alternate(repetitions, cases)
    for name, values in times.items():
        row: dict[str, Any] = {"KFIO, n = p = 2, Markov losses": name, "lanes × steps": f"{lanes[name]} × {STEPS}"}
        row |= {"ns/lane-step": Median.of(values), "× block": ratios(values, times["testbed, block"])}
        figures.rows.append({**row, "differs by": f"{agreed[name]:.1e}" if name in agreed else ""})
    _agree(figures, "kfio", max(agreed.values()))
    fastest = min(others, key=lambda name: Median.of(times[name]).value)
    ours = times["testbed, block"]
    for mine in (stepwise, "testbed, block"):
        ratio = ratios(times[fastest], times[mine]).value
        figures.targets.append(Target(f"KFIO: {fastest} (the fastest other) / {mine}", ratio, 10.0))
    for name in (name for name in others if name.startswith("filterpy")):
        figures.targets.append(Target(f"KFIO: {name} / testbed, block", ratios(times[name], ours).value, 1000.0))
    for mine, copy in (("testbed, block", "copy of those bytes"), (TWO, TWO_COPIES)):
        floor = ratios(times[mine], times[copy]).value
        figures.targets.append(Target(f"KFIO: {mine} / {copy}", floor, 2.0, at_least=False))


def _mixtures(figures: Figures, repetitions: int, lanes: int, steps: int) -> None:
    given = filters.problem(steps, lanes)
    model = replace(given.model, B=np.array([[-1.0], [1.0]]), control=MARKOV)
    u = 2.0 + np.sin(np.arange(steps))[:, None]
    figures.tables["AOE and GPB"] = []
    for kind, options, baseline in (
        ("aoe", {}, lambda: mixtures.aoe(model, u, given.y, given.arrived)),
        ("gpb", {"order": 2}, lambda: mixtures.gpb(model, 2, u, given.y, given.arrived)),
    ):
        ours = _estimator(kind, options, model, u, given)
        distance = _distance(baseline(), ours(keep=True))
        times = _side_by_side(repetitions, lanes * steps, ours, baseline)
        figures.tables["AOE and GPB"].append(
            {
                "Markov losses on both links": kind + "".join(f", {name} {value}" for name, value in options.items()),
                "lanes × steps": f"{lanes} × {steps}",
                "testbed ns/lane-step": Median.of(times["testbed"]),
                "numpy ns/lane-step": Median.of(times["numpy"]),
                "numpy / testbed": ratios(times["numpy"], times["testbed"]),
                "differs by": f"{distance:.1e}",
            }
        )
        _agree(figures, kind, distance)


def _estimator(
    kind: str, options: dict[str, Any], model: Model, u: NDArray[np.float64], given: filters.Problem
) -> Callable[..., filters.Result]:
    controls = [np.tile(row, (given.lanes, 1)) for row in u]

    def call(keep: bool = False) -> filters.Result:
        estimator = create(kind, model, lanes=given.lanes, options=options)
        kept = []
        for k in range(given.steps):
            estimate = estimator.step(controls[k], given.y[k], given.arrived[k])
            arrays = estimate.x_hat, estimate.P
            if keep or k == given.steps - 1:
                kept.append(arrays)
        return np.array([x for x, _ in kept]), np.array([P for _, P in kept])

    return call


def _optimal(figures: Figures, repetitions: int, *, quick: bool) -> None:
    """The two targets on system F, and the exact posterior of a few steps to check against."""
    model, small = optimal.system(), 16 if quick else 20
    given = optimal.trial(model, small)
    exact = optimal.breadth_first(model, given)
    visit = optimal.depth_first(model, given)
    if visit is None:
        figures.notes.append("depth-first reference left out: numba is not installed")
    references: dict[str, Callable[[], filters.Result]] = {
        f"all histories breadth-first, {small} steps": lambda: optimal.breadth_first(model, given)
    }
    if visit is not None:
        references[f"all histories depth-first, {small} steps"] = visit
    kind, rows = optimal.KIND, []
    runs = {(small, 1e-9): repetitions, (40, 1e-9): repetitions, (1000, 1e-6): 1 if quick else 3}
    for (steps, tolerance), times in runs.items():
        trial = given if steps == small else optimal.trial(model, steps)
        outcomes = [optimal.run(model, trial, tolerance, limit_s=60.0) for _ in range(times)]
        row = {"system F": f"{kind}, {steps} steps to {tolerance:g}", "s": Median.of([o.seconds for o in outcomes])}
        row |= {"certified x̂": f"{outcomes[0].bound:.1e}", "P": f"{outcomes[0].bound_P:.1e}"}
        if steps == small:
            row |= {"differs from exact by": f"{_distance((outcomes[0].x_hat, outcomes[0].P), exact):.1e}"}
        rows.append({**row, "ended": outcomes[0].stopped})
        if steps != small:
            text = f"OE, {steps} steps to {tolerance:g}"
            done = math.inf if outcomes[0].stopped else Median.of([o.seconds for o in outcomes]).value
            figures.targets.append(Target(f"{text}: s", done, {40: 0.05, 1000: 5.0}[steps], at_least=False))
            figures.targets.append(Target(f"{text}: certified", outcomes[0].bound, tolerance, at_least=False))
    for name, call in references.items():
        distance = _distance(call(), exact)
        seconds = [_ns(call, 1) * 1e-9 for _ in range(repetitions)]
        rows.append({"system F": name, "s": Median.of(seconds), "differs from exact by": f"{distance:.1e}"})
    figures.tables["OE"] = rows


def _growth(figures: Figures, limit_s: float) -> None:
    """Time against steps, states and tolerance, one of them at a time."""
    rows = []
    cases = [(2, k, 1e-6) for k in (20, 40, 100, 200, 1000)]
    cases += [(n, 40, 1e-6) for n in (1, 3)]
    cases += [(2, 40, tolerance) for tolerance in (1e-3, 1e-9, 1e-12)]
    for n, steps, tolerance in cases:
        model = optimal.system(n)
        outcome = optimal.run(model, optimal.trial(model, steps), tolerance, limit_s)
        row: dict[str, Any] = {"states": n, "steps": steps, "tolerance": f"{tolerance:g}"}
        if outcome.steps:
            row |= {"s": outcome.seconds, "ms/step": 1e3 * outcome.seconds / outcome.steps}
            row |= {"certified x̂": f"{outcome.bound:.1e}"}
        if outcome.stopped:
            row["ended"] = f"after {outcome.steps} steps: {outcome.stopped}" if outcome.steps else outcome.stopped
        rows.append(row)
    figures.tables["OE: how it grows"] = rows


def _losses(figures: Figures, repetitions: int, packets: int) -> None:
    lanes = 4096
    figures.tables["losses of packets"] = []
    for name, chain in CHAINS.items():
        given = chain, lanes, packets
        times = _side_by_side(repetitions, lanes * packets, partial(_fates, *given), partial(_numpy_fates, *given))
        rates = {case: [1e3 / ns for ns in values] for case, values in times.items()}
        figures.tables["losses of packets"].append(
            {
                "losses": name,
                "lanes × packets": f"{lanes} × {packets}",
                "testbed, million packets/s": Median.of(rates["testbed"]),
                "numpy, million packets/s": Median.of(rates["numpy"]),
                "testbed / numpy": ratios(rates["testbed"], rates["numpy"]),
                "share that arrived": f"{_fates(*given):.4f}, {_numpy_fates(*given):.4f}",
                "law": f"{chain.arrival:.4f}",
            }
        )


def _fates(chain: Chain, lanes: int, packets: int) -> float:
    process = LossProcess(chain, Stream(1, "benchmark", "loss", width=1, lane=0, lanes=lanes), lanes)
    return sum(int(np.count_nonzero(process.next(k))) for k in range(packets)) / (lanes * packets)


def _numpy_fates(chain: Chain, lanes: int, packets: int) -> float:
    """With numpy's own generator: fast, but a draw depends on all draws before it, in every lane."""
    rng, total = np.random.default_rng(1), 0
    arrived = rng.random(lanes) < chain.start
    for k in range(packets):
        if k:
            arrived = rng.random(lanes) < np.where(arrived, 1.0 - chain.failure, chain.recovery)
        total += int(np.count_nonzero(arrived))
    return total / (lanes * packets)


def _side_by_side(
    repetitions: int, size: int, ours: Callable[[], Any], theirs: Callable[[], Any]
) -> dict[str, list[float]]:
    return alternate(repetitions, {"testbed": lambda: _ns(ours, size), "numpy": lambda: _ns(theirs, size)})


def _best_lanes(call: Callable[[filters.Problem], Any], given: filters.Problem, budget_s: float) -> int:
    """Of 8, 32, 128, … lanes that ``call`` does within the budget, those at which it is fastest for each of them."""
    found: dict[int, float] = {}
    lanes = 8
    while True:
        found[lanes] = _timed(call, given.first(lanes))()
        if lanes == given.lanes or 4 * found[lanes] * lanes * given.steps * 1e-9 > budget_s:
            return min(found, key=lambda size: found[size])
        lanes = min(4 * lanes, given.lanes)


def _timed(call: Callable[[filters.Problem], Any], given: filters.Problem) -> Callable[[], float]:
    return lambda: _ns(lambda: call(given), given.steps * given.lanes)


def _ns(call: Callable[[], Any], size: int) -> float:
    begun = time.perf_counter()
    call()
    return (time.perf_counter() - begun) * 1e9 / size


def _distance(a: filters.Result, b: filters.Result) -> float:
    """Largest difference of x̂ and of P, each relative to its largest entry."""
    return max(float(np.abs(x - y).max() / np.abs(y).max()) for x, y in zip(a, b, strict=True))


def _agree(figures: Figures, kind: str, distance: float) -> None:
    text = f"{kind}: largest relative difference from the alternatives"
    figures.targets.append(Target(text, distance, AGREEMENT[kind], at_least=False))
