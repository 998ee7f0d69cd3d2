"""Summaries that look like those of runs, made without any part of the testbed but the contract itself."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import stats

from testbed.orchestrator.summary import (
    BoundFigures,
    Check,
    EstimatorFigures,
    LinkFigures,
    Summary,
    Timing,
    Transitions,
)

SCENARIO_TOML = """\
name = "markov-1.2910"
steps = 100
lanes = 256
seed = 1

[system]
A = [[1.291, 0.0], [0.0, 1.005]]
B = [[-1.0], [1.0]]
C = [[1.0, -1.0], [0.0, 1.0]]

[links.control]
loss = { kind = "bernoulli", arrival = 0.8 }

[links.observation]
loss = { kind = "markov", recovery = 0.5, failure = 0.3 }

[links.ack]
mode = "none"
"""


def estimator(
    rng: np.random.Generator,
    trace: np.ndarray,
    lanes: int = 256,
    kind: str = "oe",
    honesty: float = 1.0,
    until: int | None = None,
    states: int = 2,
    **overrides: Any,
) -> EstimatorFigures:
    """An estimator whose mean tr P is `trace` and whose squared error is `honesty` times what it claims."""
    steps = len(trace)
    nees = honesty * rng.chisquare(states * lanes, steps) / lanes
    noise = rng.normal(size=(2, steps)) / np.sqrt(lanes)
    mean = trace * (1 + 0.15 * noise[0])
    excess = trace * ((honesty - 1) + noise[1])
    series = {
        "trace_P_mean": mean,
        "trace_P_stderr": 0.15 * trace / np.sqrt(lanes),
        "squared_error_mean": mean + excess,
        "squared_error_stderr": honesty * trace / np.sqrt(lanes),
        "nees_mean": nees,
        "nees_stderr": honesty * np.sqrt(2 * states / lanes) * np.ones(steps),
        "excess_mean": excess,
        "excess_stderr": honesty * trace / np.sqrt(lanes),
    }
    for name, values in series.items():
        if until is not None:
            values[until:] = np.nan
        if lanes == 1 and name.endswith("_stderr"):
            values[:] = np.nan
    band = tuple(stats.chi2.ppf([0.025, 0.975], states * lanes) / lanes)
    return EstimatorFigures(
        **{"kind": kind, "acks": "none", "until": until, "nees_band_95": band, **series, **overrides}
    )


def link(rng: np.random.Generator, recovery: float, failure: float, steps: int, lanes: int) -> LinkFigures:
    """A two-state chain, drawn and counted here."""
    arrived = np.empty((steps, lanes), dtype=bool)
    arrived[0] = rng.random(lanes) < recovery / (recovery + failure)
    for k in range(1, steps):
        arrived[k] = rng.random(lanes) < np.where(arrived[k - 1], 1 - failure, recovery)
    pairs = 2 * arrived[:-1].astype(int) + arrived[1:]
    lost_lost, lost_delivered, delivered_lost, delivered_delivered = (int(np.sum(pairs == code)) for code in range(4))
    bursts = delivered_lost + int(np.sum(~arrived[0]))
    dropped = int(np.sum(~arrived))
    return LinkFigures(
        sent=arrived.size,
        delivered=arrived.size - dropped,
        dropped=dropped,
        transitions=Transitions(
            lost_lost=lost_lost,
            lost_delivered=lost_delivered,
            delivered_lost=delivered_lost,
            delivered_delivered=delivered_delivered,
        ),
        loss_rate=dropped / arrived.size,
        mean_burst=dropped / bursts if bursts else None,
    )


def fabricate(steps: int = 100, lanes: int = 256, scale: float = 1.0, seed: int = 1, **overrides: Any) -> Summary:
    """A run like the Markov example: exact, approximate and overconfident estimators; bounds; two links."""
    rng = np.random.default_rng(seed)
    k = np.arange(1, steps + 1)
    lower = scale * (62 - 60 * np.exp(-k / 6.0))
    stderr = 0.15 * lower / np.sqrt(lanes) if lanes > 1 else np.full(steps, np.nan)
    parts: dict[str, Any] = {
        "name": "markov-1.2910",
        "seed": seed,
        "steps": steps,
        "lanes": lanes,
        "completed_steps": steps,
        "status": "complete",
        "estimators": {
            "oe": estimator(rng, 1.03 * lower, lanes, until=min(20, steps), counters={"late_acks": 0}),
            "aoe": estimator(rng, 1.04 * lower, lanes, kind="aoe", counters={"late_acks": 3}),
            "ff": estimator(rng, 1.12 * lower, lanes, kind="ff"),
            "kfio": estimator(rng, lower, lanes, kind="kfio", acks="perfect"),
            "lmmse-naive": estimator(rng, 0.98 * lower, lanes, kind="lmmse", honesty=1.35),
        },
        "bounds": BoundFigures(
            lower_mean=lower, lower_stderr=stderr, upper_mean=1.25 * lower, upper_stderr=1.25 * stderr
        ),
        "links": {"control": link(rng, 0.8, 0.2, steps, lanes), "observation": link(rng, 0.5, 0.3, steps, lanes)},
        "checks": (
            Check(
                name="finite variance",
                ok=False,
                text="ρ(A)⁴·(1 − recovery) = 1.39 ≥ 1: the sample mean of the covariance has no finite variance, "
                "so its standard errors and intervals are too narrow.",
            ),
            Check(name="finite mean", ok=True, text="ρ(A)²·(1 − recovery) = 0.83 < 1: E[P] stays bounded."),
            Check(name="books balance", ok=True, text="Every link: sent = delivered + dropped + in flight."),
        ),
        "timing": Timing(wall_s=2.31, startup_s=1.12, steps_per_s=84.1, lane_steps_per_s=21530.2, window=4),
        "versions": {"testbed": "0.1.0", "python": "3.11.9", "numpy": "2.4.6", "zenoh": "1.10.0"},
    }
    return Summary(**{**parts, **overrides})
