"""The gains of LQG control over a link that loses packets and acknowledges each.

The plant applies ν_k u_k, and ν is a chain of arrivals: i of ν_{k−1} = i, P(ν_k = 1 | i) = p_i. With every ACK the
controller knows ν_{k−1}, and the cost Σ x'Wx + ν u'Uu is least with u_k = −L_k x̂_k, x̂_k = E[x_k | what is known at k]:

    L_k   = (U + B'S¹B)^{-1} B'S¹A                                                    S = S_{k+1}
    Sⁱ_k  = W + (1 − p_i) A'S⁰A + p_i (A'S¹A − A'S¹B L_k)                             S_N = the terminal weight

The gain depends on S¹ alone, so it is the same whatever ν_{k−1} was. For independent losses S⁰ = S¹, and this is the
equation of Schenato, Sinopoli, Franceschetti, Poolla and Sastry, *Foundations of control and estimation over lossy
networks*, Proc. IEEE 95 (2007), section on TCP-like protocols. For Markov losses it is the coupled Riccati equation of
jump linear systems (Costa, Fragoso and Marques 2005) with a mode that has no input.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from testbed.channel.law import LossModel
from testbed.channel.loss import Chain
from testbed.errors import UsageError
from testbed.estimator.model import Model
from testbed.numerics.lanes import Floats

_ITERATIONS = 50_000
_SETTLED = 1e-14
_LARGEST = 1e14
"""Of a stationary cost, relative to the weights: beyond it a gain has no digit that is right."""
_HUGE = 1e100


@dataclass(frozen=True, eq=False)
class Weights:
    """W (n, n) of the state, U (q, q) of the applied input, and of the last state (n, n)."""

    state: Floats
    input: Floats
    terminal: Floats


@dataclass(frozen=True, eq=False)
class _Plant:
    """A (n, n), B (n, q), U (q, q), and p_i = P(ν_k = 1 | ν_{k−1} = i)."""

    A: Floats
    B: Floats
    U: Floats
    p: tuple[float, float]

    def gain(self, S1: Floats) -> Floats:
        """L of S¹, (q, n)."""
        pushed = self.B.T @ S1
        return np.asarray(np.linalg.solve(self.U + pushed @ self.B, pushed @ self.A))

    def values(self, W: Floats, L: Floats, S: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
        """(S⁰, S¹) one step earlier, where the gain of that step is L, whichever it is."""
        closed = self.A - self.B @ L
        lost, applied = self.A.T @ S[0] @ self.A, closed.T @ S[1] @ closed + L.T @ self.U @ L
        zero, one = (W + (1.0 - p) * lost + p * applied for p in self.p)
        return _symmetric(zero), _symmetric(one)


def _symmetric(S: Floats) -> Floats:
    return np.asarray(0.5 * (S + S.T))


def chain_of(losses: LossModel) -> Chain:
    """The chain of arrivals that the gain is for: of losses with hidden states, independent ones of their rate."""
    if losses.never_loses:
        return Chain.lossless()
    chain = losses.as_chain
    return Chain.bernoulli(losses.arrival) if chain is None else chain


def _plant(model: Model, U: Floats) -> _Plant:
    assert model.B is not None
    chain = chain_of(model.control)
    return _Plant(model.A, model.B, U, (chain.recovery, 1.0 - chain.failure))


def horizon_gains(model: Model, weights: Weights, steps: int) -> list[Floats]:
    """The gains of a run of so many steps, that of the last step first; fewer where they settle.

    Raises UsageError where they cannot be computed: the cost overflows.
    """
    plant = _plant(model, weights.input)
    S = weights.terminal, weights.terminal
    gains: list[Floats] = []
    for _ in range(steps):
        gains.append(plant.gain(S[1]))
        before, S = S, plant.values(weights.state, gains[-1], S)
        if not max(np.abs(S[0]).max(), np.abs(S[1]).max()) < _HUGE * max(1.0, np.abs(weights.state).max()):
            raise UsageError(
                f"the least cost of {steps} steps is too large for a number; allowed: fewer steps, or a system that "
                "its input can stabilise over these losses"
            )
        if _moved(before, S) == 0.0:
            break
    return gains


def stationary_gain(model: Model, weights: Weights) -> Floats:
    """The gain (q, n) of an endless run, which keeps the mean square of the state bounded.

    Without losses by scipy's solver of the discrete algebraic Riccati equation, else by the recursion until it
    settles, from above. Raises UsageError where there is no such gain.
    """
    plant = _plant(model, weights.input)
    if model.control.never_loses:
        found = _without_losses(plant, weights.state)
    elif 0.0 < _least_recovery(model.A) >= plant.p[0]:
        found = None
    else:
        found = _settled(plant, weights.state)
    if found is None or not stabilises(plant, found):
        raise UsageError(_refusal(model, plant, weights.state))
    return found


def stabilises(plant: _Plant, L: Floats) -> bool:
    """Whether E‖x‖² decays under u = −L x without noise.

    The map (X⁰, X¹) → p_{i0} A'X⁰A + p_{i1} (A−BL)'X¹(A−BL) is positive: it contracts if and only if some power of it
    takes the identity below itself.
    """
    n = len(plant.A)
    zero, free = np.zeros((n, n)), _Plant(plant.A, plant.B, np.zeros_like(plant.U), plant.p)
    X = np.eye(n), np.eye(n)
    for _ in range(_ITERATIONS):
        X = free.values(zero, L, X)
        largest, smallest = max(_largest(X[0]), _largest(X[1])), min(_smallest(X[0]), _smallest(X[1]))
        if largest < 1.0:
            return True
        if smallest >= 1.0 or not largest < _HUGE:
            return False
    return False


def expected_cost(model: Model, weights: Weights, gains: Sequence[Floats], covariances: Sequence[Floats]) -> float:
    """E Σ_{k=1}^{N} x_k'Wx_k + ν_{k−1} u_{k−1}'U u_{k−1}, the last x with the terminal weight, under u_k = −L_k x̂_k.

    gains: L_0 … L_{N−1}, optimal or not. covariances: E[P_k] for k = 0 … N−1, of an estimator that knows every ν and
    gives E[x_k | …] with its covariance (they do not depend on u). With S as above, for the gains that are given,

        J = E[x_0'S_0x_0] + Σ_k tr(E[S^{ν_k}_{k+1}] Q) + P(ν_k=1) tr((A'S¹BL + L'B'S¹A − L'(U+B'S¹B)L) E[P_k])
    """
    plant, chain, steps = _plant(model, weights.input), chain_of(model.control), len(gains)
    applied = [chain.start]
    for _ in range(steps - 1):
        applied.append(applied[-1] * (1.0 - chain.failure) + (1.0 - applied[-1]) * chain.recovery)
    S, total = (weights.terminal, weights.terminal), 0.0
    for k in reversed(range(steps)):
        L, pi = gains[k], applied[k]
        pushed = plant.B.T @ S[1]
        crossed = plant.A.T @ pushed.T @ L
        doubt = crossed + crossed.T - L.T @ (plant.U + pushed @ plant.B) @ L
        total += float(np.trace(((1.0 - pi) * S[0] + pi * S[1]) @ model.Q) + pi * np.trace(doubt @ covariances[k]))
        if k:
            S = plant.values(weights.state, L, S)
    first = _Plant(plant.A, plant.B, plant.U, (chain.start, chain.start))
    (start, _) = first.values(np.zeros_like(model.A), gains[0], S)
    return total + float(model.x0_mean @ start @ model.x0_mean + np.trace(start @ model.P0))


def _without_losses(plant: _Plant, W: Floats) -> Floats | None:
    from scipy.linalg import solve_discrete_are  # slow to import, and only needed here

    try:
        return plant.gain(np.asarray(solve_discrete_are(plant.A, plant.B, W, plant.U)))
    except (np.linalg.LinAlgError, ValueError):
        return None


def _settled(plant: _Plant, W: Floats) -> Floats | None:
    """The gain at which the recursion settles; None where it grows without bound."""
    size = max(1.0, float(np.abs(W).max()), float(np.abs(plant.U).max()))
    S = (W + size * np.eye(len(W)),) * 2
    for _ in range(_ITERATIONS):
        before, S = S, plant.values(W, plant.gain(S[1]), S)
        moved = _moved(before, S)
        if not moved < np.inf or max(np.abs(S[0]).max(), np.abs(S[1]).max()) > _LARGEST * size:
            return None
        if moved <= _SETTLED:
            return plant.gain(S[1])
    return None


def _moved(before: tuple[Floats, Floats], after: tuple[Floats, Floats]) -> float:
    """The largest change, relative to the largest entry."""
    size = max(float(np.abs(S).max()) for S in after)
    return max(float(np.abs(a - b).max()) for a, b in zip(before, after, strict=True)) / max(size, 1e-300)


def _refusal(model: Model, plant: _Plant, W: Floats) -> str:
    """Why there is no stationary gain, in one line."""
    text = "no gain keeps the mean square of the state bounded"
    lossless = _Plant(plant.A, plant.B, plant.U, (1.0, 1.0))
    found = _without_losses(lossless, W)
    if model.control.never_loses or found is None or not stabilises(lossless, found):
        return f"{text}, not even without losses: (A, B) is not stabilisable, or Qx leaves out a mode that stays"
    chain, needed = chain_of(model.control), _least_recovery(model.A)
    what = "arrival" if chain.independent else "recovery"
    enough = "" if chain.recovery <= needed else ", and for this A and B that is not enough"
    return (
        f"{text}: control packets have {what} = {chain.recovery:.6g}; needed: more than "
        f"1 − ρ(A)⁻² = {needed:.6g}{enough}; allowed: fewer losses, or horizon = 'run'"
    )


def _least_recovery(A: Floats) -> float:
    """What P(ν_k = 1 | ν_{k−1} = 0) must be more than: else a burst of losses lets the mean square grow for ever."""
    radius = float(np.abs(np.linalg.eigvals(A)).max())
    return 1.0 - radius**-2.0 if radius > 1.0 else 0.0


def _largest(X: Floats) -> float:
    return float(np.linalg.eigvalsh(X)[-1])


def _smallest(X: Floats) -> float:
    return float(np.linalg.eigvalsh(X)[0])
