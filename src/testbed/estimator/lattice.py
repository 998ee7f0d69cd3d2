"""Re-expansion of a Gaussian mixture on a lattice (theory.md 3.5), and what it leaves out.

All components share one covariance Σ. Each N(m, Σ) is replaced by Σ_g hⁿ N(g; m, sΣ) N(·; g, (1 − s)Σ) over a lattice
of spacing h in Σ-whitened coordinates, and weights that fall on the same node add up. As a function of g the summand
is N(x; m, Σ) times a Gaussian of covariance s(1 − s)Σ, so by Poisson's summation formula the new density is, at every
x, the old one times a factor within 1 ± ε, ε = ``poisson(n, h)``.

The old components are images of a lattice too, at centre + offset_h + basis z. The new lattice is turned so that in
its coordinates ``basis`` is upper triangular (a QR decomposition). Then the last coordinate of a component depends on
its last index alone, and so on, and the sum over components becomes one sum along each axis in turn.

What is left out, a measure d ≥ 0 on nodes: components and nodes of less than ``cut`` of the weight of their hidden
state, and the kernels beyond their reach. For every vector ω with |ω| ≤ η, the sum over d of e^{g'ω}, g from the
centre and whitened, is at most V(η) Σ_b m_b e^{η r_b} with the masses m_b and radii r_b of ``Remainder`` and
V(η) = (1 + ε) e^{sη²/2}, which is what the whole kernel of a component at 0 gives. A kernel at m of weight w that is
cut off, in each axis, at a distance of x√s + h or more, with w e^{−x²/2} = cut: what is beyond, times e^{(g − m)'ω}, is
at most n w e^{sη²/2} e^{−(x − η√s)²/2} = n cut e^{ηx√s} if x ≥ η√s, and less than the whole kernel,
w e^{sη²/2} = cut e^{x²/2} e^{sη²/2} ≤ cut e^{ηx√s} V(η), if not. Hence a mass of n cut at radius |m| + x√s.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from testbed.estimator.posterior import Posterior
from testbed.numerics.lanes import Floats
from testbed.numerics.spreading import spread

SPLIT = 0.2
"""s: the share of the covariance that a re-expansion takes for the lattice."""
NODES_MAX = 2_000_000
"""Nodes of the box of a re-expansion."""
BINS = 64
"""Radii at which the mass of what is left out is kept."""
_CELLS = 4_000_000
"""Entries of an array between two axes."""
LOWEST = -650.0
_SMALLEST = -680.0
"""Logarithms of the smallest cut and of the smallest weight that is formed."""


@dataclass(frozen=True, eq=False)
class Remainder:
    """What a re-expansion left out, relative to what it kept, in coordinates whitened by the covariance before it.

    log_mass (BINS,), radius (BINS,): see above, summed over hidden states, each relative to what is kept of it.
    mean (S, n), second (S, n, n) of the nodes kept, zero for hidden states that are impossible. furthest: the largest
    |g| kept.
    """

    log_mass: Floats
    radius: Floats
    mean: Floats
    second: Floats
    furthest: float


def spacing(n: int, epsilon: float) -> float:
    """h for which ``poisson`` is about ε."""
    return math.pi * math.sqrt(2.0 * SPLIT * (1.0 - SPLIT) / math.log(2.2 * n / epsilon))


def poisson(n: int, h: float) -> float:
    """ε = Σ over ξ ≠ 0 in Zⁿ of exp(−2π² s (1 − s) |ξ|²/h²) = (1 + 2 Σ_{j ≥ 1} q^{j²})ⁿ − 1."""
    q = math.exp(-2.0 * math.pi**2 * SPLIT * (1.0 - SPLIT) / (h * h))
    if q > 0.9:
        return math.inf
    return math.expm1(n * math.log1p(2.0 * sum(q ** (j * j) for j in range(1, 30))))


def log_tail(eta: Any) -> Any:
    """log V(η) with room for ε ≤ 1."""
    return math.log(2.0) + 0.5 * SPLIT * eta * eta


class Cloud:
    """A posterior's components as a re-expansion sees them."""

    def __init__(self, posterior: Posterior) -> None:
        factor = np.linalg.cholesky(posterior.covariance)
        extent = np.ptp(posterior.nodes, axis=0) * np.linalg.norm(np.linalg.solve(factor, posterior.basis), axis=0)
        order = np.argsort(-extent, kind="stable")  # the first axis of the new lattice goes along the longest
        posterior = replace(posterior, nodes=posterior.nodes[:, order], basis=posterior.basis[:, order])
        self.posterior = posterior
        deviation = posterior.moments()[0] - posterior.centre
        away = np.linalg.solve(factor, (posterior.offsets - deviation).T)
        if extent.any():
            turn, self.triangle = np.linalg.qr(np.linalg.solve(factor, posterior.basis))
        else:
            turn, self.triangle = np.linalg.eigh(away @ away.T)[1][:, ::-1], np.zeros_like(factor)
        self.axes = factor @ turn
        self.shift = away.T @ turn
        self.centre = posterior.centre + deviation
        self.places = posterior.nodes @ self.triangle.T + self.shift[:, None, :]
        """Whitened coordinates of the components, (H, N, n)."""
        shares = posterior.shares()
        top = shares.max(axis=(1, 2))
        self.states = np.flatnonzero(np.isfinite(top))
        sums = top[self.states] + np.log(np.exp(shares[self.states] - top[self.states, None, None]).sum(axis=(1, 2)))
        self.log_state = sums - sums.max()
        """Logarithm of the weight of each hidden state that is possible, the largest 0."""
        self.logs = shares[self.states] - sums[:, None, None]
        """Logarithms of the components' shares of their hidden state's weight, (S', H, N)."""
        squares = np.einsum("hni,hni->hn", self.places, self.places)
        self.radii = np.sqrt(squares)
        self.spread = float((np.exp(self.logs) * squares).sum(axis=(1, 2)).max())
        """Largest second moment of the components of a hidden state."""

    def log_cut(self, eta: float, target: float) -> float:
        """A cut for which what is left out comes to about ``target``, a logarithm, for an exponent η."""
        n = self.places.shape[2]
        some = self.logs > LOWEST
        logs, radii = self.logs[some], np.broadcast_to(self.radii, some.shape)[some]
        fixed = math.log(2.0 * n * len(logs)) + float(log_tail(eta)) - target
        cut = -fixed
        while cut > LOWEST:
            furthest = float(
                (radii + np.sqrt(2.0 * SPLIT * np.maximum(logs - cut, 0.0))).max(where=logs > cut, initial=0.0)
            )
            excess = cut + fixed + eta * furthest
            if excess <= 0.0:
                return cut
            cut -= 1.2 * excess + 1.0
        return LOWEST


def expanded(cloud: Cloud, h: float, log_cut: float) -> tuple[Posterior, Remainder, float]:
    """The posterior on a new lattice of spacing h or, if its box would be too large, of the spacing that is returned.

    The new posterior's centre is the old one's mean.
    """
    old, n = cloud.posterior, cloud.places.shape[2]
    cuts = np.maximum(log_cut, _SMALLEST - cloud.log_state)
    room = cloud.logs - cuts[:, None, None]
    used = room > 0.0
    reach = np.sqrt(2.0 * SPLIT * np.maximum(room, 0.0))
    widest = np.where(used, reach, -np.inf).max(axis=0)
    some = np.isfinite(widest)
    places, around = cloud.places[some].T.copy(), widest[some]
    low, high = (places - around).min(axis=1), (places + around).max(axis=1)
    h = _fitting(h, high - low)
    first = np.floor(low / h).astype(np.int64) - 1
    counts = np.ceil(high / h).astype(np.int64) + 2 - first
    box = _Box(h, first, counts)
    parts = [
        _summed(cloud, box, np.where(used[i], np.exp(cloud.logs[i]), 0.0), np.where(used[i], reach[i] / h + 1.0, -1.0))
        for i in range(len(cloud.states))
    ]
    with np.errstate(divide="ignore"):
        logs = np.log(np.stack(parts))
    kept = logs > cuts[:, None]
    chosen = np.flatnonzero(kept.any(axis=0))
    nodes = box.nodes(chosen)
    left_out = [
        (np.where(used, -np.inf, cloud.logs), np.broadcast_to(cloud.radii, used.shape)),
        (np.where(used, math.log(n) + cuts[:, None, None], -np.inf), cloud.radii + reach),
        (np.where(kept, -np.inf, logs), np.broadcast_to(box.radii(), kept.shape)),
    ]
    shares = np.where(kept, np.exp(logs), 0.0)[:, chosen]
    weights = np.zeros((len(old.weights), 1, len(chosen)))
    weights[cloud.states, 0] = shares * np.exp(cloud.log_state)[:, None]
    remainder = _remainder(left_out, shares, nodes * h, cloud.states, len(old.weights))
    posterior = replace(
        old,
        centre=cloud.centre,
        basis=cloud.axes * h,
        nodes=nodes,
        offsets=np.zeros((1, n)),
        undecided=(),
        weights=weights / weights.sum(),
        scores=np.zeros((1, len(nodes))),
        covariance=(1.0 - SPLIT) * old.covariance,
    )
    return posterior, remainder, h


def _fitting(h: float, extent: Floats) -> float:
    """The smallest spacing from h on for which the box is not too large."""
    while math.prod(e / h + 4.0 for e in extent) > NODES_MAX:
        h *= 1.05
    return h


@dataclass(frozen=True, eq=False)
class _Box:
    """Nodes first_i … first_i + counts_i − 1 of axis i; flat with the first axis last in memory."""

    h: float
    first: NDArray[np.int64]
    counts: NDArray[np.int64]

    def nodes(self, chosen: NDArray[np.intp]) -> Floats:
        """Indices (N, n) of flat positions."""
        at = np.unravel_index(chosen, tuple(self.counts[::-1]))[::-1]
        return np.stack(at, axis=1).astype(np.float64) + self.first

    def radii(self) -> Floats:
        squares = np.zeros(1)
        for first, count in zip(self.first, self.counts, strict=True):
            axis = self.h * (first + np.arange(count))
            squares = (axis[:, None] ** 2 + squares).ravel()
        return np.sqrt(squares)


def _summed(cloud: Cloud, box: _Box, weights: Floats, reach: Floats) -> Floats:
    """Weights (H, N) of one hidden state spread over the box, flat; reach (H, N) in nodes, negative where unused."""
    n = cloud.places.shape[2]
    total = np.zeros(int(np.prod(box.counts)))
    histories = np.flatnonzero((reach >= 0.0).any(axis=1))
    if not len(histories):
        return total
    nodes = cloud.posterior.nodes
    used = (reach >= 0.0).any(axis=0)
    low, high = nodes[used].min(axis=0), nodes[used].max(axis=0)
    sizes = (high - low).astype(np.int64) + 1
    inside = np.flatnonzero(used)
    at = (nodes[inside] - low).astype(np.intp)
    flat = np.ravel_multi_index(tuple(at.T[::-1]), tuple(sizes[::-1]))
    triangle = cloud.triangle / box.h
    shift = cloud.shift / box.h + low @ triangle.T
    cells = max(np.prod(np.maximum(sizes[::-1], 1)[: n - p]) * np.prod(box.counts[:p]) for p in range(n))
    some = max(1, int(_CELLS // max(cells, 1)))
    for start in range(0, len(histories), some):
        rows = histories[start : start + some]
        values = np.zeros((len(rows), int(np.prod(sizes))))
        widths = np.full(values.shape, -1.0)
        values[:, flat] = weights[np.ix_(rows, inside)]
        widths[:, flat] = reach[np.ix_(rows, inside)]
        total += _along_axes(values, widths, shift[rows], triangle, sizes, box)
    return total


def _along_axes(
    values: Floats, widths: Floats, shift: Floats, triangle: Floats, sizes: NDArray[np.int64], box: _Box
) -> Floats:
    """The sum along one axis after the other; values (H, nodes of the old lattice), the first axis last."""
    n, variance = len(sizes), SPLIT / (box.h * box.h)
    histories, inner = len(values), 1
    for p in range(n):
        centres = shift[:, p]
        for axis in range(n - 1, p, -1):
            centres = centres[..., None] + triangle[p, axis] * np.arange(sizes[axis])
        steps = int(sizes[p])
        out = spread(
            values.reshape(-1, steps, inner),
            np.ascontiguousarray(centres.ravel()),
            float(triangle[p, p]),
            widths.reshape(-1, steps),
            int(box.first[p]),
            int(box.counts[p]),
            variance,
            merge=p == n - 1,
        )
        inner *= int(box.counts[p])
        values, widths = out.reshape(histories if p < n - 1 else 1, -1), widths.reshape(-1, steps).max(axis=1)
    return values.ravel()


def _remainder(
    left_out: list[tuple[Floats, Floats]], shares: Floats, places: Floats, states: NDArray[np.intp], count: int
) -> Remainder:
    """left_out: logarithms of masses (S', …) and radii; shares (S', N) and whitened places (N, n) of the kept;
    states (S',): which of the ``count`` hidden states these are.
    """
    n = places.shape[1]
    kept = shares.sum(axis=1)
    with np.errstate(divide="ignore"):
        log_kept = np.log(kept)
    masses, radii = [], []
    for logs, radius in left_out:
        relative = logs - log_kept.reshape(-1, *[1] * (logs.ndim - 1))
        some = relative > -np.inf
        masses.append(relative[some])
        radii.append(radius[some])
    mass, radius = np.concatenate(masses), np.concatenate(radii)
    edges = max(float(radius.max(initial=0.0)), 1e-300) * np.arange(1, BINS + 1) / BINS
    bins = np.clip(np.ceil(radius * (BINS / edges[-1])).astype(np.intp) - 1, 0, BINS - 1)
    top = np.full(BINS, -np.inf)
    np.maximum.at(top, bins, mass)
    level = np.where(np.isfinite(top), top, 0.0)
    with np.errstate(divide="ignore"):
        log_mass = level + np.log(np.bincount(bins, np.exp(mass - level[bins]), BINS))
    share = shares / np.maximum(kept, 1e-300)[:, None]
    mean, second = np.zeros((count, n)), np.zeros((count, n, n))
    mean[states] = share @ places
    for state, weights in zip(states, share, strict=True):
        second[state] = (places * weights[:, None]).T @ places
    furthest = math.sqrt(float(np.einsum("ni,ni->n", places, places).max()))
    return Remainder(log_mass, edges, mean, second, furthest)
