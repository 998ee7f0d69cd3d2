"""What the scenario's loss model says a link should do, to set beside what was counted."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from testbed.orchestrator.summary import LinkFigures, Summary


@dataclass(frozen=True)
class Expected:
    """Expectation and standard deviation of the figures of one link; None where there is none."""

    loss_rate: float | None
    loss_rate_deviation: float | None
    mean_burst: float | None
    mean_burst_deviation: float | None


@dataclass(frozen=True)
class _Chain:
    """Two-state chain of arrivals: recovery = P(0→1), failure = P(1→0), start = P(delivered) at the first step."""

    recovery: float
    failure: float
    start: float | None = None


def expected_links(summary: Summary, scenario_toml: str) -> dict[str, Expected]:
    """What is expected of each link whose loss model is one of none, Bernoulli and Markov and that sent a packet."""
    tables = tomllib.loads(scenario_toml).get("links", {})
    expected = {}
    for name, figures in summary.links.items():
        chain = _chain(tables.get(name, {}))
        if chain is not None and figures.sent and summary.lanes:
            expected[name] = _expected(chain, figures, summary.lanes)
    return expected


def _chain(link: Mapping[str, Any]) -> _Chain | None:
    loss = link.get("loss", {"kind": "none"})
    match loss.get("kind", "none"):
        case "none":
            return _Chain(recovery=1.0, failure=0.0)
        case "bernoulli" if "arrival" in loss:
            return _Chain(recovery=loss["arrival"], failure=1.0 - loss["arrival"])
        case "markov" if "recovery" in loss and "failure" in loss:
            return _Chain(loss["recovery"], loss["failure"], loss.get("start"))
    return None


def _expected(chain: _Chain, figures: LinkFigures, lanes: int) -> Expected:
    """Lanes are independent; within a lane neighbours have correlation ρ = 1 − recovery − failure.

    The spread is that of a stationary chain. Bursts are geometric with parameter `recovery`; those that the end of the
    run cuts short are not allowed for.
    """
    steps = max(1, round(figures.sent / lanes))
    arrival, spread = _arrivals(chain, steps)
    recovery, bursts = chain.recovery, figures.transitions.delivered_lost
    return Expected(
        loss_rate=1.0 - arrival,
        loss_rate_deviation=spread / math.sqrt(lanes),
        mean_burst=1.0 / recovery if recovery > 0 and arrival < 1 else None,
        mean_burst_deviation=math.sqrt((1.0 - recovery) / bursts) / recovery if recovery and bursts else None,
    )


def _arrivals(chain: _Chain, steps: int) -> tuple[float, float]:
    """Mean share of arrivals in one lane over `steps` steps, and its standard deviation."""
    leaving = chain.recovery + chain.failure
    if leaving == 0:
        return (0.0 if chain.start is None else chain.start), 0.0
    rho = 1.0 - leaving
    stationary = chain.recovery / leaving
    start = stationary if chain.start is None else chain.start
    geometric = (1.0 - rho**steps) / leaving  # Σ ρ^j, j = 0 … steps − 1
    correlated = rho * (steps - geometric) / leaving  # Σ (steps − j) ρ^j, j = 1 … steps − 1
    variance = stationary * (1.0 - stationary) * (steps + 2.0 * correlated) / steps**2
    return stationary + (start - stationary) * geometric / steps, math.sqrt(max(0.0, variance))
