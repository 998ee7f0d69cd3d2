"""What an estimator is told about plant and links, and what passes between it and its service."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from testbed.channel.law import Law, LossModel, law_of
from testbed.channel.loss import Chain
from testbed.numerics.lanes import (
    Component,
    Constant,
    Floats,
    Mask,
    Matrix,
    Vector,
    array_of,
    constant,
    constant_times,
    full_matrix,
    full_vector,
    matrices_of,
    where,
)
from testbed.scenario import OnLoss


@dataclass(frozen=True, eq=False)
class Model:
    """x⁺ = A x + ν B u + w, y = C x + v (theory.md section 1); Q with G already applied.

    on_loss "hold": x⁺ = A x + B a + w, with the applied input a_k = ν_k u_k + (1 − ν_k) a_{k−1}, a_{−1} = 0.

    A (n, n), B (n, q) or None, C (p, n), Q (n, n), R (p, p), x0_mean (n,), P0 (n, n); control: law of ν_0, ν_1, …;
    observation: law of γ_1, γ_2, …

    Before G is applied: G (n, g) and its noise's covariance W (g, g), so that Q = G W G'; None: the identity and Q.
    Model error: dA (n, n), dG (n, g), dC (p, n), one for each parameter; an empty tuple: zeros.
    """

    A: Floats
    C: Floats
    Q: Floats
    R: Floats
    x0_mean: Floats
    P0: Floats
    B: Floats | None = None
    control: LossModel = field(default_factory=Chain.lossless)
    observation: LossModel = field(default_factory=Chain.lossless)
    G: Floats | None = None
    W: Floats | None = None
    dA: tuple[Floats, ...] = ()
    dG: tuple[Floats, ...] = ()
    dC: tuple[Floats, ...] = ()
    on_loss: OnLoss = "zero"

    @cached_property
    def holds(self) -> bool:
        """Whether the plant may apply an input once more: where nothing is lost, hold is the same as zero."""
        return self.on_loss == "hold" and self.q > 0 and not self.control.never_loses

    @property
    def n(self) -> int:
        return int(self.A.shape[0])

    @property
    def p(self) -> int:
        return int(self.C.shape[0])

    @property
    def q(self) -> int:
        return 0 if self.B is None else int(self.B.shape[1])

    @cached_property
    def law(self) -> Law:
        """The hidden chain behind ν_0, ν_1, …"""
        return law_of(self.control)

    @cached_property
    def a(self) -> Constant:
        return constant(self.A)

    @cached_property
    def b(self) -> Constant:
        return tuple(() for _ in range(self.n)) if self.B is None else constant(self.B)

    @cached_property
    def c(self) -> Constant:
        return constant(self.C)

    @cached_property
    def noise(self) -> Constant:
        """Q as a constant."""
        return constant(self.Q)

    @cached_property
    def sensor_noise(self) -> Constant:
        """R as a constant."""
        return constant(self.R)

    def control_effect(self, u: Vector) -> Vector:
        """B u."""
        return constant_times(self.b, u)

    def prior(self, lanes: int) -> tuple[Vector, Matrix]:
        """x̄_0 and P_0 in every lane."""
        return full_vector(self.x0_mean, lanes), full_matrix(self.P0, lanes)


@dataclass(frozen=True)
class Ack:
    """What became known about control packet j: ν of shape (M,), where ``known`` (M,) is set."""

    j: int
    nu: NDArray[Any]
    known: NDArray[Any]


@dataclass(slots=True)
class Estimate:
    """x_hat (M, n) and P (M, n, n) at one step, from components."""

    x: Vector
    p: Matrix
    lanes: int
    error_bound: Floats | None = None
    """Where the estimator certifies it: bound on the distance of x̂ to the exact one, in units of sqrt(tr P), (M,)."""
    error_bound_P: Floats | None = None
    """Bound on the relative error of tr P, (M,)."""

    @property
    def x_hat(self) -> Floats:
        return array_of(self.x, self.lanes)

    @property
    def P(self) -> Floats:
        return matrices_of(self.p, self.lanes)


class Estimator(Protocol):
    """One step = the move from k − 1 to k, then the observation of k.

    It may also have ``check_scenario`` (see registry.check), ``begin_at`` (see registry.create), ``takes_noise`` (see
    ``seen``), ``takes_hold`` (see registry.check_actuator), ``not_claimed`` (see conformance), and what makes it a
    ``Restartable``.
    """

    counters: dict[str, int]

    def step(self, u: Floats, y: Floats, arrived: NDArray[Any], acks: tuple[Ack, ...] = ()) -> Estimate:
        """u (M, q) as sent, y (M, p) with any finite value where nothing arrived, arrived (M,).

        Raises MissingAck or TooManyHistories where the estimator's definition has no answer.
        """
        ...


@runtime_checkable
class Restartable(Protocol):
    """An estimator that hands over what it knows; ``snapshot`` makes bytes of it.

    State: arrays of float64, uint8 or int64 by name, all finite.
    """

    STATE_VERSION: int
    """Raised when the arrays change their meaning."""

    def state(self) -> dict[str, NDArray[Any]]:
        """Everything that the next step depends on, copied."""
        ...

    def set_state(self, state: dict[str, NDArray[Any]]) -> None:
        """Go on from the ``state`` of an estimator with the same model, lanes and options.

        Raises UsageError, and changes nothing, where it is not such a state.
        """
        ...

    def start_from(self, step: int, x_hat: Floats, P: Floats) -> None:
        """Go on after ``step`` steps from x_hat (M, n) and P (M, n, n) alone.

        The last ν is unknown: the control chain has the law that it has at that step if nothing is known of it.
        """
        ...


def seen(estimator: Estimator, arrived: NDArray[Any], received: NDArray[Any]) -> NDArray[Any]:
    """What an estimator is given as ``arrived``: γ, the lanes in which a packet arrived.

    One that sets ``takes_noise = True`` gets the lanes in which anything was received, be it noise alone: it knows no
    γ, and takes every y for a measurement.
    """
    return received if getattr(estimator, "takes_noise", False) else arrived


def expected_nu(model: Model, acks: tuple[Ack, ...], j: int, counters: dict[str, int]) -> Component:
    """E[ν_j] under i.i.d. control losses: the arrival rate, or ν_j itself where an ACK of it came in time."""
    ack = newest_ack(acks, j, counters)
    rate = model.control.first_arrival
    return rate if ack is None else where(ack[0], ack[1], rate)


def newest_ack(acks: tuple[Ack, ...], j: int, counters: dict[str, int]) -> tuple[Mask, Component] | None:
    """(known, ν) of control packet j if an ACK of it came; ACKs of older packets are counted as late."""
    found = None
    for ack in acks:
        if ack.j == j:
            known, nu = ack.known.astype(np.bool_), ack.nu.astype(np.float64)
            found = (bool(known[0]), float(nu[0])) if len(known) == 1 else (known, nu)
        else:
            counters["late_acks"] = counters.get("late_acks", 0) + int(np.count_nonzero(ack.known))
    return found
