"""Drive the estimators under test through a trial."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from estimator.reference.cases import Floats, FourStates, System, Trial
from testbed.channel.four_state import four_state
from testbed.channel.gilbert_elliott import GilbertElliott
from testbed.channel.law import LossModel
from testbed.channel.loss import Chain
from testbed.estimator.bounds import Bounds
from testbed.estimator.model import Ack, Model
from testbed.estimator.registry import create


def losses_of(system: System) -> LossModel:
    c = system.channel
    if c is None:
        return Chain(system.recovery, system.failure, system.start)
    if isinstance(c, FourStates):
        return four_state(c.p13, c.p31, c.p32, c.p23, c.p14, c.first)
    return GilbertElliott.of(c.to_bad, c.to_good, c.loss_good, c.loss_bad, c.start_good)


def model_of(system: System) -> Model:
    return Model(
        A=system.A,
        B=system.B,
        C=system.C,
        Q=system.Q,
        R=system.R,
        x0_mean=system.x0_mean,
        P0=system.P0,
        control=losses_of(system),
        on_loss="hold" if system.hold else "zero",
    )


def acks_at(trial: Trial, k: int, *, again: bool = False, garbage: bool = False) -> tuple[Ack, ...]:
    """What becomes known at step k, the newest packet first.

    again: with a second copy of everything that was known before. garbage: wrong values where known is False.
    """
    acks = []
    for j in reversed(range(k)):
        known = trial.ack_step[j] == k
        if again:
            known = (trial.ack_step[j] > 0) & (trial.ack_step[j] <= k)
        if known.any():
            nu = np.where(known, trial.nu[j], 1 - trial.nu[j] if garbage else 0)
            acks.append(Ack(j, nu, known))
    return tuple(acks)


def run(
    kind: str,
    trial: Trial,
    options: Mapping[str, Any] | None = None,
    *,
    again: bool = False,
    garbage: bool = False,
) -> tuple[Floats, Floats]:
    """x̂ (K, M, n) and P (K, M, n, n) of all steps; `garbage` also fills y where nothing arrived."""
    y = np.where(trial.arrived[:, :, None], trial.y, 1e6) if garbage else trial.y
    est = create(kind, model_of(trial.system), lanes=trial.lanes, options=dict(options or {}))
    outs = [
        est.step(trial.u[k - 1], y[k - 1], trial.arrived[k - 1], acks_at(trial, k, again=again, garbage=garbage))
        for k in range(1, trial.steps + 1)
    ]
    return np.array([out.x_hat for out in outs]), np.array([out.P for out in outs])


def run_bounds(trial: Trial, U: Floats) -> tuple[Floats, Floats]:
    """Lower and upper bounds (K, M, n, n) of all steps."""
    bounds = Bounds(model_of(trial.system), U, lanes=trial.lanes)
    lowers, uppers = [], []
    for k in range(trial.steps):
        lower, upper = bounds.step(trial.arrived[k])
        assert upper is not None
        lowers.append(lower)
        uppers.append(upper)
    return np.array(lowers), np.array(uppers)
