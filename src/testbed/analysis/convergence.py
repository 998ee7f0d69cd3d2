"""Where the expected covariance of OE settles without losses of observations, and how fast (D Theorem 3)."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import solve_discrete_are

from testbed.analysis.moments import spectral_radius
from testbed.analysis.structure import Reach
from testbed.channel.law import LossModel
from testbed.numerics.lanes import Floats
from testbed.scenario import (
    ClosedLoop,
    ConstantInput,
    ExponentialInput,
    Input,
    SineInput,
    UniformInput,
)

_SOLVED = 1e-8


@dataclass(frozen=True)
class Settled:
    """P̄ (n, n), the stabilising solution of P̄ = A φ(P̄, 1) A' + Q; φ(P̄, 1); ρ(A (I − K C)) with its gain K."""

    predicted: Floats
    updated: Floats
    radius: float


@dataclass(frozen=True)
class Fading:
    """Whether u_k → 0 (None: not known), the factor by which it does so a step, and why."""

    vanishes: bool | None
    factor: float
    reason: str


def settled(A: Floats, C: Floats, Q: Floats, R: Floats) -> Settled | None:
    """The covariance of the Kalman filter in the long run; None where it is not found, or does not solve its equation.

    A (n, n), C (p, n), Q (n, n), R (p, p). Exists for (A, C) detectable, (A, sqrt Q) stabilisable.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            P = np.asarray(solve_discrete_are(A.T, C.T, Q, R), dtype=np.float64)
        gain = np.linalg.solve(C @ P @ C.T + R, C @ P).T
        updated = P - gain @ C @ P
        radius = spectral_radius(A - A @ gain @ C)
    except (np.linalg.LinAlgError, ValueError):
        return None
    size = float(np.abs(P).max())
    if not np.allclose(A @ updated @ A.T + Q, P, rtol=0.0, atol=_SOLVED * size) or not radius < 1.0:
        return None
    return Settled(P, (updated + updated.T) / 2.0, radius)


@dataclass(frozen=True)
class Knowledge:
    """The losses of observations and of controls, whether every ACK comes, and whether the actuator holds."""

    observation: LossModel
    control: LossModel
    every_ack: bool
    holds: bool = False


def convergence(
    observable: Reach, controllable: Reach, found: Settled | None, links: Knowledge, source: Input | None
) -> dict[str, Any]:
    """D Theorem 3: without losses of observations, and with u_k → 0, E[P̄_k] of OE tends to P̄ of the ARE.

    ``holds`` is None where the premises are not met or not known: the theorem gives no converse. D has i.i.d. control
    losses and no ACKs. Both can go. With the gain of Pᴬ, and the mean of ν for ν, the error is that with every ACK plus
    Σ_i 𝒜^{(i)} B (ν_i − Eν_i) u_i. The root of its variance is at most ½ Σ_i ‖𝒜^{(i)}‖ ‖B u_i‖ for any law of ν
    (Minkowski), which tends to 0 as D's M_k does. The error of OE is not larger in the mean, and ACKs make it smaller.

    With an actuator that holds, B a_i is in the place of B ν_i u_i. It arrived j or more steps ago with a probability
    that falls like θ^j, the decay of the link's bursts, so that E‖a_i‖² tends to 0 with u, and not faster than θ^i.

    rate: E[P̄_k] − P̄ goes to 0 as rate^k, up to a power of k: the larger of ρ(𝒜)², 𝒜 = A (I − K C), and of the square of
    the factor by which u fades, and of θ where inputs are held. It is a bound; the distance may fade faster.
    """
    control = links.control
    out: dict[str, Any] = dict.fromkeys(("limit", "limit_trace", "updated_trace", "rate"))
    out |= {"holds": None, "exponential": False, "theorem": "D Theorem 3"}
    if not links.observation.never_loses:
        return {**out, "reason": "observations are lost"}
    if not (observable.full and controllable.full):
        return {**out, "reason": "(A, C) is not observable, or (A, sqrt Q) not controllable"}
    if found is None:
        return {**out, "reason": "no solution of the Riccati equation was found"}
    out |= {"limit": found.predicted.tolist(), "limit_trace": float(np.trace(found.predicted))}
    out |= {"updated_trace": float(np.trace(found.updated))}
    fading = fading_of(source)
    if control.never_loses or links.every_ack:
        known = "no control is lost" if control.never_loses else "the fate of every control packet is known"
        out["theorem"], fading = "Kalman filter", Fading(True, 0.0, f"{known}: u does not matter")
    if not fading.vanishes:
        return {**out, "reason": fading.reason}
    if out["theorem"] != "Kalman filter" and not control.independent:
        out["theorem"] = "D Theorem 3, for Markov losses"
    if out["theorem"] != "Kalman filter" and links.holds and fading.factor > 0.0:
        out["theorem"] = "D Theorem 3, for held inputs"
        if control.burst_decay >= 1.0:
            return {**out, "reason": "the actuator holds, and control losses may never end"}
        fading = _held(fading, control.burst_decay)
    rate = max(found.radius, fading.factor) ** 2
    return {
        **out,
        "holds": True,
        "exponential": True,
        "rate": rate,
        "reason": f"no observation is lost and {fading.reason}",
    }


def fading_of(source: Input | None) -> Fading:
    """Whether an input tends to 0, from its kind: each kind that does so does it exponentially."""
    if source is None:
        return Fading(True, 0.0, "there is no input")
    if isinstance(source, ConstantInput):
        return _zero_or_not(_zero(source.value), "u is constant and not zero")
    if isinstance(source, ExponentialInput):
        if not _zero(source.offset):
            return Fading(False, 1.0, "u tends to an offset that is not zero")
        if _zero(source.amplitude):
            return Fading(True, 0.0, "u = 0")
        amplitudes, slowness = np.broadcast_arrays(np.asarray(source.amplitude), np.asarray(source.tau))
        factor = math.exp(-1.0 / float(slowness[amplitudes != 0.0].max()))
        return Fading(True, factor, f"u tends to 0 exponentially, by {factor:.6g} a step")
    if isinstance(source, SineInput):
        silent = _zero(source.offset) and _zero(source.amplitude)
        return _zero_or_not(silent, "u is a sine: it does not tend to 0")
    if isinstance(source, UniformInput):
        silent = _zero(source.low) and _zero(source.high)
        return _zero_or_not(silent, "u is drawn afresh at each step: it does not tend to 0")
    kind = "fed back" if isinstance(source, ClosedLoop) else "a table of finite length"
    return Fading(None, 1.0, f"u is {kind}: its limit is not known")


def _held(fading: Fading, decay: float) -> Fading:
    """Of what is applied, where an input that fades is held through bursts of losses with that decay."""
    factor = max(fading.factor, math.sqrt(decay))
    return Fading(True, factor, f"{fading.reason}, and what is held by {factor:.6g}")


def _zero_or_not(zero: bool, otherwise: str) -> Fading:
    return Fading(True, 0.0, "u = 0") if zero else Fading(False, 1.0, otherwise)


def _zero(value: float | tuple[float, ...]) -> bool:
    return not np.any(value)
