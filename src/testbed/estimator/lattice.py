"""OE by re-expansion on a lattice, with a bound on its distance to the exact posterior (theory.md 3.5).

All components share one covariance Σ. When they are too many, each N(m, Σ) is replaced by Σ_g hⁿ N(g; m, sΣ)
N(·; g, (1 − s)Σ) over a lattice of spacing h in Σ-whitened coordinates, and weights that fall on the same node add up.
By Poisson's formula the new density is, at every x, the old one times a factor within 1 ± ε. Prediction and Bayes' rule
do not amplify that. What is dropped (nodes of tiny weight, the tails beyond the box) is carried along as a measure of
mass D and second moment M about x̂, each grown by the most that a likelihood can do to it.

With f the density kept and F the exact one, unnormalised, f = F (1 + δ) − d with |δ| bounded by the product of the
factors and d ≥ 0 of mass D. Hence p = (f + d) g with g between (1−ε)/((1+ε)(1+D)) and (1+ε)/((1−ε)(1+D)), from which
the bounds on x̂ and P follow. Rounding is outside the certificate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge, Gt, Le
from numpy.typing import NDArray

from testbed.errors import UsageError
from testbed.estimator.errors import ContradictoryAck, TooManyHistories
from testbed.estimator.model import Ack, Estimate, Model, newest_ack
from testbed.numerics.lanes import Floats, matrix_of, vector_of

SPLIT = 0.2
"""s: the share of the covariance that a re-expansion takes for the lattice."""
DROP = 1e-46
"""Nodes of a smaller share of the weight are dropped, and counted in D."""
NODES_MAX = 4e6
"""Nodes of the box that a re-expansion may look at."""
REACH = 15.0
"""Half-width of a kernel in its standard deviations: its tail is below 1e-49."""


@dataclass
class _Set:
    """Components with the same newest bit: means (N, n), weights (N,) not normalised."""

    means: Floats
    weights: Floats


@dataclass
class _Lane:
    """The posterior of one lane and its certificate."""

    sets: list[_Set]
    covariance: Floats
    mean: Floats
    log_low: float = 0.0
    """Σ log(1 − ε) of the re-expansions."""
    log_high: float = 0.0
    """Σ log(1 + ε)."""
    dropped: float = 0.0
    moment: float = 0.0
    """D and M, the dropped mass and its second moment about the mean, in units in which what is kept has mass 1."""


class LatticeOe:
    """The optimal estimator to a stated tolerance, for one or two states and control losses without late ACKs.

    tolerance: aim of ``error_bound``, the bound on ‖x̂ − exact‖ in units of sqrt(tr P); what was reached is in the
    estimate. components: from how many on (for each newest bit) the posterior is re-expanded.
    """

    def __init__(
        self,
        model: Model,
        lanes: int,
        tolerance: Annotated[float, Gt(0.0), Le(0.1)] = 1e-9,
        components: Annotated[int, Ge(16)] = 1024,
    ) -> None:
        """Raises UsageError for more than two states, where the lattice would be too large."""
        if model.n > 2:
            raise UsageError(f"estimator 'oe-lattice' holds for one or two states, not {model.n}; allowed: oe")
        if np.linalg.eigvalsh(model.Q)[0] <= 0.0:
            raise UsageError("estimator 'oe-lattice' needs a positive definite G Q G'; allowed: oe")
        self._model, self._lanes, self._limit = model, lanes, components
        self._epsilon = max(1e-13, tolerance / 400.0)
        self._spacing = math.pi * math.sqrt(2.0 * SPLIT * (1.0 - SPLIT) / math.log(2.2 * model.n / self._epsilon))
        self._peak = 1.0 / math.sqrt(np.linalg.det(2.0 * math.pi * model.R))
        self._split_by_bit = not (model.control.independent or model.control.never_loses)
        start = _Set(model.x0_mean[None, :].copy(), np.ones(1))
        self._posteriors = [_Lane([start], model.P0.copy(), model.x0_mean.copy()) for _ in range(lanes)]
        self._k = 0
        self.counters: dict[str, int] = {}

    def step(self, u: Floats, y: Floats, arrived: NDArray[Any], acks: tuple[Ack, ...] = ()) -> Estimate:
        """ACKs of the last packet are used; older ones are counted, their packets are no longer distinguished."""
        self._k += 1
        ack = newest_ack(acks, self._k - 1, self.counters)
        known, nu = (np.zeros(self._lanes, bool), np.zeros(self._lanes)) if ack is None else map(np.atleast_1d, ack)
        results = [
            self._lane(lane, u[i], y[i] if arrived[i] else None, int(nu[i]) if known[i] else None)
            for i, lane in enumerate(self._posteriors)
        ]
        mean, covariance, bound, bound_p = (np.array(column) for column in zip(*results, strict=True))
        return Estimate(vector_of(mean), matrix_of(covariance), self._lanes, bound, bound_p)

    def _lane(self, lane: _Lane, u: Floats, y: Floats | None, nu: int | None) -> tuple[Floats, Floats, float, float]:
        before = lane.mean
        self._predict(lane, u, nu)
        growth = 1.0
        if y is not None:
            growth = self._update(lane, y)
        total = sum(float(s.weights.sum()) for s in lane.sets)
        for s in lane.sets:
            s.weights /= total
        lane.mean, covariance = _moments(lane)
        self._carry(lane, before, u, growth / total)
        if max(len(s.weights) for s in lane.sets) > self._limit:
            self._regrid(lane)
        return lane.mean, covariance, *self._bounds(lane, float(np.trace(covariance)))

    def _predict(self, lane: _Lane, u: Floats, nu: int | None) -> None:
        model, chain = self._model, self._model.control
        push = model.B @ u if model.B is not None else np.zeros(model.n)
        if chain.never_loses:
            nu = 1
        first = self._k == 1
        branches: list[list[_Set]] = [[], []]
        for bit, s in enumerate(lane.sets):
            arrival = chain.start if first else float(chain.recovery)
            if self._split_by_bit and not first:
                arrival = 1.0 - chain.failure if bit else chain.recovery
            moved = s.means @ model.A.T
            for fate, share in ((0, 1.0 - arrival), (1, arrival)):
                if share > 0.0 and nu in (None, fate):
                    branches[fate].append(_Set(moved + fate * push, s.weights * share))
        if not any(branches):
            raise ContradictoryAck("an ACK says what the model of the control link holds to be impossible")
        lane.covariance = model.A @ lane.covariance @ model.A.T + model.Q
        if self._split_by_bit:
            lane.sets = [_joined(b) if b else _Set(np.zeros((0, model.n)), np.zeros(0)) for b in branches]
        else:
            lane.sets = [_joined([s for b in branches for s in b])]

    def _update(self, lane: _Lane, y: Floats) -> float:
        """Bayes' rule; weights are multiplied by likelihoods relative to their peak, which is returned (its bound)."""
        C, R = self._model.C, self._model.R
        innovation_covariance = C @ lane.covariance @ C.T + R
        gain = np.linalg.solve(innovation_covariance, C @ lane.covariance).T
        factor = np.linalg.cholesky(innovation_covariance)
        scores = []
        for s in lane.sets:
            innovation = y - s.means @ C.T
            half = np.linalg.solve(factor, innovation.T)
            scores.append(-0.5 * np.sum(half * half, axis=0))
            s.means = s.means + innovation @ gain.T
        top = max(float(score.max()) for score in scores if len(score))
        for s, score in zip(lane.sets, scores, strict=True):
            s.weights = s.weights * np.exp(score - top)
        complement = np.eye(self._model.n) - gain @ C
        lane.covariance = complement @ lane.covariance @ complement.T + gain @ R @ gain.T
        normaliser = math.sqrt(np.linalg.det(2.0 * math.pi * innovation_covariance))
        return self._peak * normaliser * math.exp(min(-top, 700.0))

    def _carry(self, lane: _Lane, before: Floats, u: Floats, growth: float) -> None:
        """Take the dropped measure one step on: as much as a step can make of its mass and second moment."""
        model = self._model
        push = model.B @ u if model.B is not None else np.zeros(model.n)
        moved = max(float(np.linalg.norm(model.A @ before + b * push - lane.mean)) for b in (0, 1))
        spread = math.sqrt(float(np.trace(model.Q))) + moved
        root = float(np.linalg.norm(model.A, 2)) * math.sqrt(lane.moment) + spread * math.sqrt(lane.dropped)
        lane.dropped, lane.moment = growth * lane.dropped, growth * root * root

    def _regrid(self, lane: _Lane) -> None:
        """Re-expand all components on one lattice."""
        model, h = self._model, self._spacing
        factor = np.linalg.cholesky(lane.covariance)
        reach = REACH * math.sqrt(SPLIT)
        for i, s in enumerate(lane.sets):
            if not len(s.weights):
                continue
            z = np.linalg.solve(factor, (s.means - lane.mean).T)
            sizes = [(c.max() - c.min() + 2.0 * reach) / h for c in z]
            if math.prod(sizes) > NODES_MAX:
                raise TooManyHistories(
                    f"oe-lattice would need {math.prod(sizes):.2g} nodes at step {self._k}; the limit is "
                    f"{NODES_MAX:.2g}: stop it earlier (until), or use aoe"
                )
            axes = [h * np.arange(math.floor((c.min() - reach) / h), math.ceil((c.max() + reach) / h) + 1) for c in z]
            kernels = [_kernel(axis, c, h) for axis, c in zip(axes, z, strict=True)]
            if model.n == 1:
                weights, nodes = s.weights @ kernels[0], axes[0][:, None]
            else:
                weights = ((kernels[0] * s.weights[:, None]).T @ kernels[1]).ravel()
                nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
            total = float(s.weights.sum())
            keep = weights > DROP * total
            means = nodes @ factor.T
            thin = float(np.trace((1.0 - SPLIT) * lane.covariance))
            lost = weights[~keep]
            far = np.sum(means[~keep] ** 2, axis=1) + thin
            tail = 2.0 * model.n * total * math.exp(-0.5 * REACH**2)
            widest = float(np.max(np.sum(means**2, axis=1))) + thin
            lane.dropped += float(lost.sum()) + tail
            lane.moment += float(lost @ far) + 4.0 * tail * widest
            lane.sets[i] = _Set(lane.mean + means[keep], weights[keep])
        lane.covariance = (1.0 - SPLIT) * lane.covariance
        epsilon = _poisson(model.n, h)
        lane.log_low += math.log1p(-epsilon)
        lane.log_high += math.log1p(epsilon)

    def _bounds(self, lane: _Lane, trace: float) -> tuple[float, float]:
        """Bounds of the error of x̂, in units of sqrt(tr P), and of the relative error of tr P."""
        ratio = math.exp(lane.log_high - lane.log_low)
        low, high = 1.0 / (ratio * (1.0 + lane.dropped)), ratio / (1.0 + lane.dropped)
        shift = 0.5 * (high - low) + high * math.sqrt(lane.dropped * lane.moment / trace)
        second = max(high - 1.0, 1.0 - low) + high * lane.moment / trace
        return shift, second + shift * shift


def _kernel(axis: Floats, centres: Floats, h: float) -> Floats:
    """h N(g; c, s) for nodes g and centres c: (components, nodes)."""
    away = axis[None, :] - centres[:, None]
    return np.asarray(h / math.sqrt(2.0 * math.pi * SPLIT) * np.exp(away * away * (-0.5 / SPLIT)))


def _poisson(n: int, h: float) -> float:
    """ε = Σ over ξ ≠ 0 of exp(−2π² s (1 − s) |ξ|²/h²): (1 + 2 Σ_{j≥1} q^{j²})ⁿ − 1."""
    q = math.exp(-2.0 * math.pi**2 * SPLIT * (1.0 - SPLIT) / (h * h))
    one = 2.0 * sum(q ** (j * j) for j in range(1, 6))
    return math.expm1(n * math.log1p(one))


def _joined(sets: list[_Set]) -> _Set:
    return _Set(np.concatenate([s.means for s in sets]), np.concatenate([s.weights for s in sets]))


def _moments(lane: _Lane) -> tuple[Floats, Floats]:
    whole = _joined(lane.sets)
    centre = whole.weights @ whole.means
    away = whole.means - centre
    correction = whole.weights @ away
    away = away - correction
    return centre + correction, lane.covariance + (away * whole.weights[:, None]).T @ away
