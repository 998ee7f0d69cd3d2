"""What `summary.json` says of a run in real time."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, NonNegativeInt


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Quantiles(_Model):
    """Microseconds; null where there is no value."""

    p50: float | None = Field(default=None, description="median")
    p90: float | None = Field(default=None, description="90 % of the values are at most this")
    p99: float | None = Field(default=None, description="99 % of the values are at most this")
    max: float | None = Field(default=None, description="the largest")


class Stage(_Model):
    """One stage of the way that a step goes; what is said of a step holds for the last of its packets.

    t_k is when u_{k−1} was due: the start of the run and k − 1 periods.
    """

    role: str = Field(description="who publishes")
    published: Quantiles = Field(description="from t_k to the publication, µs")
    arrived: Quantiles = Field(description="from t_k to the arrival at the orchestrator, µs")
    hop: Quantiles = Field(
        description="from the publication of the stage before to that of this one, µs: on the way, waiting and at work"
    )
    missed: NonNegativeInt = Field(description="steps published after t_k + deadline_us")
    first_missed: NonNegativeInt | None = Field(default=None, description="the first of them")
    absent: NonNegativeInt = Field(
        description="steps whose deadline was over when the run ended, and that had not come by then"
    )
    published_us: tuple[float | None, ...] = Field(description="from t_k to the publication, µs, by completed step")


class RealTime(_Model):
    """How a run kept to the wall clock."""

    start_ns: NonNegativeInt = Field(description="the date at which u_0 was due, nanoseconds since 1970 (UTC)")
    period_us: float = Field(description="µs from a step to the next")
    deadline_us: float = Field(description="µs after t_k by which everything of step k is to be published")
    deadlines: Literal["soft", "strict"] = Field(description="whether a missed deadline ends the run")
    outstanding_max: NonNegativeInt = Field(description="the most steps that were due and not complete")
    outstanding_allowed: NonNegativeInt = Field(description="more than so many end the run")
    date_set_us: float = Field(description="by how much the date was set during the run, which shifts all of this")
    priority: NonNegativeInt | None = Field(default=None, description="the real-time priority that was asked for")
    priorities: dict[str, NonNegativeInt] = Field(
        default_factory=dict, description="the real-time priorities that the system granted, by role"
    )
    held_controls: NonNegativeInt = Field(
        default=0, description="closed loop: control packets sent with an estimate older than that of their step"
    )
    held_steps_max: NonNegativeInt = Field(default=0, description="closed loop: the age of the oldest such, in steps")
    stages: dict[str, Stage] = Field(description="by topic, in the order of the way")

    @property
    def missed(self) -> int:
        """Deadlines missed by any role, those included of what never came."""
        return sum(stage.missed + stage.absent for stage in self.stages.values())


def quantiles(ns: list[int]) -> Quantiles:
    """Of durations in nanoseconds: each the smallest value that so many of them do not exceed."""
    if not ns:
        return Quantiles()
    values = np.quantile(np.array(ns), [0.5, 0.9, 0.99, 1.0], method="inverted_cdf") / 1e3
    return Quantiles.model_validate(dict(zip(("p50", "p90", "p99", "max"), values.tolist(), strict=True)))
