"""What the scenario's loss model says a link should do, to set beside what was counted."""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass

from pydantic import TypeAdapter, ValidationError

from testbed.analysis.bursts import run_law
from testbed.channel.chains import chain_of
from testbed.channel.hidden import Hidden
from testbed.channel.law import LossModel
from testbed.orchestrator.summary import LinkFigures, Summary
from testbed.scenario import Loss, ScriptedLoss, TraceLoss


@dataclass(frozen=True)
class Expected:
    """Expectation and standard deviation of the figures of one link; None where there is none."""

    loss_rate: float | None
    loss_rate_deviation: float | None
    mean_burst: float | None
    mean_burst_deviation: float | None


_TIME = {"slot", "rate", "delay", "reorder", "duplicate", "corrupt"}
_LOSS: TypeAdapter[Loss] = TypeAdapter(Loss)


def expected_links(summary: Summary, scenario_toml: str) -> dict[str, Expected]:
    """What is expected of each link that sent a packet, whose losses are drawn by one law, and that takes no time.

    Raises:
        tomllib.TOMLDecodeError: the scenario is not TOML.
    """
    tables = tomllib.loads(scenario_toml).get("links", {})
    eventful = {name for event in summary.events for name in (event.link, *(event.links or ()))}
    expected = {}
    for name, figures in summary.links.items():
        if name in eventful or _TIME & set(tables.get(name, {})):
            continue
        try:
            loss = _LOSS.validate_python(tables.get(name, {}).get("loss", {"kind": "none"}))
        except ValidationError:
            continue
        if figures.sent and summary.lanes and not isinstance(loss, (TraceLoss, ScriptedLoss)):
            expected[name] = _expected(chain_of(loss), figures, summary.lanes)
    return expected


def _expected(losses: LossModel, figures: LinkFigures, lanes: int) -> Expected:
    """Lanes are independent; within a lane packets are correlated as the model says.

    The spread is that of the stationary law. Bursts of a chain of arrivals are geometric with parameter `recovery`;
    those that the end of the run cuts short are not allowed for.
    """
    arrival, variance = losses.share_moments(max(1, round(figures.sent / lanes)))
    return Expected(
        loss_rate=1.0 - arrival,
        loss_rate_deviation=math.sqrt(max(0.0, variance) / lanes),
        mean_burst=None if losses.never_loses else losses.mean_burst,
        mean_burst_deviation=_burst_spread(losses, figures.transitions.delivered_lost),
    )


def _burst_spread(losses: LossModel, bursts: int) -> float | None:
    """Standard deviation of the mean length of that many bursts."""
    if isinstance(losses, Hidden):
        law = run_law(losses, False)
        return math.sqrt(law.variance_of_mean / bursts) if law is not None and bursts else None
    recovery = losses.recovery
    return math.sqrt((1.0 - recovery) / bursts) / recovery if recovery and bursts else None
