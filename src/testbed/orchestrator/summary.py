"""The contract of `summary.json`: the figures of one run.

A figure that does not exist is null: a standard error with one lane, an estimator's steps after its `until`, a value
that is not finite. Not a number and infinity become null when a model is built: what is written reads back as equal.
Every list along k has one entry for each completed step, k = 1 first.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    FiniteFloat,
    NonNegativeInt,
    ValidationError,
    model_validator,
)

from testbed.errors import UsageError
from testbed.orchestrator.realtime_figures import RealTime

Z_95 = 1.96
"""Half-width of a 95 % interval in standard errors, wherever a figure shows one."""


def _finite(value: object) -> object:
    return None if isinstance(value, float | np.floating) and not math.isfinite(value) else value


def _finite_series(values: object) -> object:
    if isinstance(values, np.ndarray):
        values = values.tolist()
    return [_finite(value) for value in values] if isinstance(values, list | tuple) else values


Number = Annotated[float | None, BeforeValidator(_finite)]
Series = Annotated[tuple[float | None, ...], BeforeValidator(_finite_series)]
"""One entry a completed step; NumPy vectors are taken too."""


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class EstimatorFigures(_Model):
    """Figures of one estimator; means and standard errors are over lanes."""

    kind: str = Field(description="which estimator it is, at first")
    acks: Literal["none", "perfect", "link"]
    since: NonNegativeInt = Field(default=1, description="first step at which it runs")
    until: NonNegativeInt | None = Field(
        default=None, description="last step at which it runs; null: the last of the run"
    )
    trace_P_mean: Series = Field(description="tr P_k")
    trace_P_stderr: Series
    squared_error_mean: Series = Field(description="‖x_k − x̂_k‖²")
    squared_error_stderr: Series
    nees_mean: Series = Field(description="(x − x̂)' P⁻¹ (x − x̂)")
    nees_stderr: Series
    excess_mean: Series = Field(
        description="‖x − x̂‖² − tr P, paired by lane: zero in expectation for an exact estimator"
    )
    excess_stderr: Series
    nees_band_95: tuple[FiniteFloat, FiniteFloat] = Field(
        description="of nees_mean, from chi-square with n·lanes degrees"
    )
    undefined: NonNegativeInt = Field(default=0, description="lane-steps whose NEES is not defined")
    counters: dict[str, NonNegativeInt] = Field(default_factory=dict)


class BoundFigures(_Model):
    """Bounds of tr E[P_k]: below by the ACK covariance, above by S (theory, sections 2 and 3.6)."""

    lower_mean: Series
    lower_stderr: Series
    upper_mean: Series | None = None
    upper_stderr: Series | None = None
    upper_correlated_mean: Series | None = Field(
        default=None, description="S with more of U, which holds for correlated control losses"
    )
    upper_correlated_stderr: Series | None = None
    upper_reason: str | None = Field(default=None, description="why there is no valid upper bound")

    @property
    def valid_upper_mean(self) -> Series | None:
        """The upper bound that holds for the control losses of the run, if there is one."""
        if self.upper_correlated_mean is not None:
            return self.upper_correlated_mean
        return self.upper_mean if self.upper_reason is None else None


class CostFigures(_Model):
    """The quadratic cost J = Σ_{k=1}^{steps} c_k, c_k = (x_k − r)'Qx(x_k − r) + a_{k−1}'Ru a_{k−1}, over lanes.

    a is the input that the plant applied, not the one that was sent.
    """

    step_mean: Series = Field(description="c_k")
    step_stderr: Series
    state_mean: Series = Field(description="(x_k − r)'Qx(x_k − r)")
    state_stderr: Series
    input_mean: Series = Field(description="a_{k−1}'Ru a_{k−1}")
    input_stderr: Series
    total: Number = Field(default=None, description="mean over lanes of J, over the completed steps")
    total_stderr: Number = Field(default=None, description="its standard error: the steps of a lane are summed first")
    total_interval_95: tuple[Number, Number] | None = Field(default=None, description="total ± 1.96 standard errors")
    a_step: Number = Field(default=None, description="total / completed steps")
    a_step_stderr: Number = Field(default=None, description="total_stderr / completed steps")


class ControllerFigures(_Model):
    """The controller of a closed loop."""

    kind: str = Field(description="kind of the input")
    estimator: str = Field(description="whose estimate it follows")
    gain: tuple[tuple[float, ...], ...] | None = Field(
        default=None, description="L of u_k = −L x̂_k, with a finite horizon that of k = 0; null: it has no such gain"
    )
    statement: str | None = Field(default=None, description="of an LQG controller: whether it is optimal, or why not")
    counters: dict[str, NonNegativeInt] = Field(
        default_factory=dict, description="saturated: lane-steps at which the input was cut to its limits"
    )


class Transitions(_Model):
    """Pairs of neighbouring packets of one lane: 0 lost, 1 delivered. In JSON the keys are 00, 01, 10, 11."""

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)

    lost_lost: NonNegativeInt = Field(default=0, alias="00")
    lost_delivered: NonNegativeInt = Field(default=0, alias="01")
    delivered_lost: NonNegativeInt = Field(default=0, alias="10")
    delivered_delivered: NonNegativeInt = Field(default=0, alias="11")


class LinkFigures(_Model):
    """What one link did, counted over lane-packets."""

    sent: NonNegativeInt
    delivered: NonNegativeInt
    dropped: NonNegativeInt
    duplicated: NonNegativeInt = 0
    late: NonNegativeInt = 0
    in_flight: NonNegativeInt = 0
    corrupted: NonNegativeInt = Field(default=0, description="copies that arrived with a bit flipped")
    causes: dict[str, NonNegativeInt] = Field(default_factory=dict, description="those dropped, by cause")
    transport: dict[str, NonNegativeInt] = Field(
        default_factory=dict, description="what connections did: retransmissions, recoveries, timeouts, probes, …"
    )
    real: dict[str, NonNegativeInt] = Field(
        default_factory=dict,
        description="of a link through real sockets: packets that left more than a period late (behind), and the books "
        "of its packets, forward and backward",
    )
    transitions: Transitions = Transitions()
    loss_rate: Number = None
    mean_burst: Number = Field(default=None, description="mean number of packets lost in a row")


class Check(_Model):
    """One statement about the run that was checked."""

    name: str
    ok: bool
    text: str


class Transient(_Model):
    """The error of an estimator after a swap, less that of a twin: of the new kind all along, and never swapped."""

    twin: str = Field(description="name of the twin")
    last: NonNegativeInt = Field(description="last step that was compared: the last before the next change, or of all")
    mean: Number = Field(description="mean over these steps of the difference of ‖x − x̂‖²")
    largest: Number = Field(description="the largest difference of ‖x − x̂‖², without its sign")
    settled: NonNegativeInt | None = Field(
        description="first step from which on it stays below 1 % of the twin's ‖x − x̂‖²; null: it does not"
    )


Action = Literal[
    "set",
    "swap",
    "add",
    "shadow",
    "remove",
    "acks",
    "partition",
    "heal",
    "input",
    "plant",
    "mark",
    "snapshot",
    "kill",
    "pause",
    "restart",
]


class Happened(_Model):
    """An event, and the step at which it took effect."""

    step: NonNegativeInt
    by: Literal["timeline", "command", "condition"] = Field(
        description="what brought it: a step or time in the scenario, somebody outside, or a condition that held"
    )
    action: Action = Field(default="set", description="what happened")
    number: NonNegativeInt | None = Field(
        default=None, description="number among the events, from 0: those of the scenario as written, then commands"
    )
    when: str | None = Field(default=None, description="the condition for which it waited")
    true_at: NonNegativeInt | None = Field(default=None, description="step at which the condition began to hold")
    due: NonNegativeInt | None = Field(
        default=None, description="step at which it was to take effect, where it was put off: in real time only"
    )
    link: str | None = Field(default=None, description="which link")
    set: dict[str, Any] | None = Field(default=None, description="keys of the link that changed")
    links: tuple[str, ...] | None = Field(default=None, description="which links were cut or healed")
    estimator: str | None = Field(default=None, description="which estimator")
    name: str | None = Field(default=None, description="name of the shadow, or what the mark says")
    to: dict[str, Any] | str | None = Field(
        default=None, description="the new service: its table, or the name under which it ran"
    )
    handover: Literal["cold", "moments", "full"] | None = Field(default=None, description="what it started from")
    acks: str | None = Field(default=None, description="what it is told of the control packets from then on")
    input: dict[str, Any] | None = Field(default=None, description="the new input")
    plant: dict[str, Any] | None = Field(default=None, description="the new parameters, and over how many steps")
    role: str | None = Field(default=None, description="which process")
    lasts: str | None = Field(default=None, description="for how long it stood still")
    file: str | None = Field(default=None, description="where the snapshot is, in the folder of the run")
    ok: bool = Field(default=True, description="whether it was done; if not, all stayed as it was")
    reason: str | None = Field(default=None, description="why it was not done")
    bytes: NonNegativeInt | None = Field(default=None, description="size of the snapshots that were handed over")
    transient: Transient | None = Field(default=None, description="what the swap cost, where the run has a twin")

    @property
    def text(self) -> str:
        """In words."""
        text = self._what() + ("" if self.due is None else f", put off from step {self.due}")
        return text if self.ok else f"{text}: not done: {self.reason}"

    @property
    def label(self) -> str:
        """In few words, for a figure."""
        if self.action == "mark":
            return self.name or ""
        return f"{self.action} {self.link or self.estimator or self.role or ''}".strip()

    @property
    def origin(self) -> str:
        """Who asked for it, in words."""
        if self.when is None:
            return self.by
        since = "" if self.true_at is None else f", true at step {self.true_at}"
        return f"{self.when}{since}"

    def _what(self) -> str:
        match self.action:
            case "set":
                return f"link {self.link} changed"
            case "partition" | "heal":
                return f"{self.action} of {', '.join(self.links) if self.links else 'all links'}"
            case "mark":
                return f"mark: {self.name}"
            case "input":
                return f"input: {(self.input or {}).get('kind')}"
            case "plant":
                plant = dict(self.plant or {})
                over = plant.pop("over", 1)
                return f"plant: {', '.join(plant)} changed" + (f" over {over} steps" if over > 1 else "")
            case "snapshot":
                return f"snapshot of {self.estimator}"
            case "acks":
                return f"ACKs of {self.estimator or 'all'}: {self.acks}"
            case "kill" | "restart":
                return f"{self.action} {self.role}"
            case "pause":
                return f"pause {self.role} for {self.lasts}"
        what = f"{self.action} {self.estimator}"
        if isinstance(self.to, str):
            return f"{what} to {self.to}"
        if self.to is not None:
            what += f" to {self.to['kind']}" + (f", {self.handover}" if self.handover is not None else "")
        return what


class Downtime(_Model):
    """What a change of estimators cost in time; no step was left out."""

    step: NonNegativeInt
    estimator: str
    steps: NonNegativeInt = Field(default=0, description="steps without an estimate of it")
    ms: Number = Field(description="how long the clock stood still, on the wall clock; never in real time")
    late_ms: Number = Field(
        default=None,
        description="in real time: the largest time from t_k to publication of the first ten estimates from there on",
    )
    missed: NonNegativeInt | None = Field(
        default=None, description="in real time: how many of those ten missed their deadline"
    )


class Recovered(_Model):
    """A role that was lost, and what was done."""

    role: str
    how: str = Field(description="how it was lost")
    step: NonNegativeInt = Field(description="the last step that was complete when that was noticed")
    policy: Literal["restart", "continue"]
    begin: NonNegativeInt = Field(
        description="restart: the step of the snapshot from which it went on; continue: its last step"
    )
    down_ms: Number = Field(default=None, description="on the wall clock, until it was there again")

    @property
    def text(self) -> str:
        """In words."""
        if self.policy == "continue":
            return f"{self.role} {self.how}: the run went on without it from step {self.begin + 1} on"
        took = "" if self.down_ms is None else f" within {self.down_ms:.0f} ms"
        return f"{self.role} {self.how}: started anew from step {self.begin}{took}"


class Timing(_Model):
    """How long the run took; seconds on the wall clock."""

    wall_s: Number = None
    startup_s: Number = None
    steps_per_s: Number = None
    lane_steps_per_s: Number = None
    window: NonNegativeInt | None = None
    swaps: tuple[Downtime, ...] = Field(default=(), description="how long changes of estimators held up the run")


class Summary(_Model):
    """`summary.json`."""

    version: Literal[1] = 1
    name: str
    seed: NonNegativeInt
    steps: NonNegativeInt
    lanes: NonNegativeInt
    completed_steps: NonNegativeInt
    status: Literal["complete", "failed", "interrupted"]
    reason: str | None = None
    estimators: dict[str, EstimatorFigures]
    bounds: BoundFigures | None = None
    controller: ControllerFigures | None = Field(default=None, description="of a closed loop; null: it is open")
    cost: CostFigures | None = Field(default=None, description="the quadratic cost; null: the scenario has no weights")
    links: dict[str, LinkFigures]
    events: tuple[Happened, ...] = Field(default=(), description="what changed while the run went, in order of time")
    recovered: tuple[Recovered, ...] = Field(default=(), description="roles that were lost, in order of time")
    checks: tuple[Check, ...] = ()
    rejected: dict[str, dict[str, NonNegativeInt]] = Field(
        default_factory=dict, description="messages refused, by role and reason"
    )
    repeated: dict[str, NonNegativeInt] = Field(
        default_factory=dict,
        description="messages that had come before and were passed over, by role: a role that is started anew sends "
        "again what it had sent since its snapshot",
    )
    timing: Timing = Timing()
    realtime: RealTime | None = Field(
        default=None, description="how the run kept to the wall clock; null in virtual time"
    )
    versions: dict[str, str] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _lengths(self) -> Summary:
        for where, series in self._series():
            if len(series) != self.completed_steps:
                raise ValueError(f"{where} has {len(series)} entries for {self.completed_steps} completed steps")
        return self

    def _series(self) -> Iterator[tuple[str, tuple[float | None, ...]]]:
        parts: dict[str, BaseModel] = {f"estimators.{name}": figures for name, figures in self.estimators.items()}
        if self.bounds is not None:
            parts["bounds"] = self.bounds
        if self.cost is not None:
            parts["cost"] = self.cost
        for where, part in parts.items():
            for field, value in part:
                if field.endswith(("_mean", "_stderr")) and isinstance(value, tuple):
                    yield f"{where}.{field}", value


def write_summary(path: Path, summary: Summary) -> None:
    """Write `summary` as JSON; floats keep all their digits. The file appears whole or not at all.

    Raises:
        OSError: the file cannot be written.
    """
    text = _pretty(summary.model_dump(mode="json", by_alias=True)) + "\n"
    partial = path.with_name(path.name + ".partial")
    partial.write_text(text, encoding="utf-8")
    os.replace(partial, path)


def read_summary(path: Path) -> Summary:
    """Read what `write_summary` wrote.

    Raises:
        OSError: the file cannot be read.
        UsageError: it is not a summary.
    """
    try:
        return Summary.model_validate_json(path.read_bytes())
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(map(str, first["loc"]))
        raise UsageError(f"{path}: not a summary: {place + ': ' if place else ''}{first['msg']}") from None


def summary_json_schema() -> dict[str, Any]:
    """JSON Schema of `summary.json`."""
    return Summary.model_json_schema(mode="serialization", by_alias=True)


def _pretty(value: object, indent: str = "") -> str:
    """JSON with one line for each key; a list of numbers is one line."""
    inner = indent + "  "
    if isinstance(value, dict) and value:
        lines = [f"{inner}{json.dumps(key, ensure_ascii=False)}: {_pretty(item, inner)}" for key, item in value.items()]
        return "{\n" + ",\n".join(lines) + f"\n{indent}}}"
    if isinstance(value, list) and any(isinstance(item, dict) for item in value):
        return "[\n" + ",\n".join(inner + _pretty(item, inner) for item in value) + f"\n{indent}]"
    return json.dumps(value, allow_nan=False, ensure_ascii=False)
