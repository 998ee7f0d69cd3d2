"""How far the re-expanded posterior is from the exact one, a posteriori, with a bound that does not grow with time.

**What is compared.** T: the exact, positive and linear step of the unnormalised posterior. F_k: the exact one. f_k: the
one that is kept. Re-expansion r (``lattice``) multiplies by 1 + δ_r(x), |δ_r| ≤ ε_r, and leaves out d_r ≥ 0. With U
the same steps and re-expansions with nothing left out,

    F_k = c (f_k + Σ_r U_{r→k} d_r),   Π (1 + ε_r)^{-1} ≤ c(x) ≤ Π (1 − ε_r)^{-1},   f_k + Σ_{s>r} U d_s = U_{r→k} f_r.

So if every U d_r has at most ρ_r times the mass of U f_r, then D = Σ_r |U d_r|/|f_k| obeys D ≤ S (1 + D), S = Σ ρ_r.
U and T differ by factors within 1 ± ε, which are put into ρ_r with room to spare (a factor of 2).

**ρ_r.** After re-expansion r, d_r and f_r are weights on nodes ζ (whitened, from the centre c_r) of Gaussians with one
covariance P. Two that see the same losses from then on keep equal covariances, and their means differ by Ψ ζ with the
deterministic Ψ = Π (I − γ K C) A (theory.md 3.2). For a history h of the losses to come, the likelihood of node ζ is

    const_h · exp(ζ'ω_h − ½ ζ'Ωζ),   Ω = Σ X_i'X_i,   ω_h = Σ X_i' S_i^{-1/2} e_i^h,   X_i = S_i^{-1/2} C A Ψ_{i−1},

with e_i^h the innovations of node 0 under h. Let |ω_h| ≤ η for all h. Then, h by h, the weight of what was left out
is at most Σ_d w_ζ e^{ζ'ω_h}, which ``lattice`` bounds by means of η alone, and that of what was kept at least, by
Jensen's inequality, exp(−η|μ| − ½ tr ΩV), μ and V the mean and second moment of its nodes (per hidden state of the
link, which are compared each with itself). Their ratio is ρ_r. All this is known afterwards: η is computed from the
observations that came. As Ψ shrinks, Ω, ω_h and so ρ_r stop growing.

**η.** e_i^h = ē_i − C Σ_l ±½ b_{l,i}, with ē_i the innovation of node 0 with every unknown ν replaced by ½, and b_{l,i}
what is left of B u_l. So ω_h = ω̄ + Σ_l ±½ D_l with D_l = Σ X_i' S_i^{-1/2} C b_{l,i}, and η = |ω̄| + ½ Σ |D_l|. Of
inputs of long ago only a norm is kept: in that of P^{-1} a prediction shrinks a difference by
κ = (1 − λ_min(Q P̄^{-1}))^{1/2}, an update does not enlarge it, and |S^{-1/2} C b| is at most |b|. So with q the sum of
their ½ |b|, q⁺ = κ q, they add Σ ‖X_i‖ q_i. κ is that of the covariance with no re-expansion, the largest of all.

**Letting go of old re-expansions.** At a re-expansion t an older r is given up once φ = ‖G_t^{-1} Ψ_r‖ ≤ ``FADED``, G_t
the whitening of t. As P_r(t) = Σ_t + G_t Z G_t' with Z ≥ 0, what T d_r will meet is the likelihood of t smeared over
N(0, Z); its gradient adds at most φ [(1 + ‖Ω_t‖‖Z‖) η_t + ‖Ω_t‖ |m|] to η_r, |m| the largest distance of T d_r from
c_t. ρ_r is frozen with η_r + ``SLACK``, and as long as t is held, and when it is itself given up, that the addition is
below ``SLACK`` is checked; if not, the bound is infinite from then on.

**Moments.** History by history, x under U d_r is paired with x under U f_r; the means of a pair are Ψ(ζ − ζ') apart, of
at most (|ζ| + |ζ'|)/sqrt(1 − s) in the norm of P^{-1}, which never grows. So the second moment of all U d_r about x̂ is
M ≤ Σ ρ_r [2 (tr P + M) + 4 tr Pᴬ (2 n + ζ_max²)(1 + D)/(1 − s)], where the second moment of ζ is paid for by η + 1
for η, as ζ_i² ≤ e^{ζ_i} + e^{−ζ_i}. With g = c/(mean of c), p = g (f + d), the bounds on x̂ and P follow. Rounding is
outside the certificate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from testbed.estimator.lattice import BINS, SPLIT, Remainder, log_tail
from testbed.estimator.model import Model
from testbed.numerics.lanes import Floats

FADED = 1e-6
SLACK = 1e-3
HELD_MAX = 512
"""Re-expansions that are held one by one at most."""
HELD_PUSHES = 24
"""Control inputs whose effect is followed as a vector; that of older ones is bounded by its norm."""
FIRST_PEAK = (4.0, 1.0, 0.0)
PEAK_DECAY = 0.9


@dataclass(frozen=True, eq=False)
class Records:
    """The R re-expansions that are held one by one; the names are those above.

    log_mass, radius (R, BINS), mean (R, S), second (R, S, n, n), furthest (R,): of ``Remainder``. covariance,
    psi, information (R, n, n), reference, pull (R, n): P, Ψ, Ω, the mean of node 0 and the part of ω_h that all h
    share. images, effects (R, HELD_PUSHES, n): b_l and D_l of late. swing (R,): what is not in ``effects`` of the bound
    η. deviation (R,): q. faded (R, 3): the largest φ, ‖Z‖ and |m| of those that were
    given up in its favour.
    """

    log_mass: Floats
    radius: Floats
    mean: Floats
    second: Floats
    furthest: Floats
    covariance: Floats
    psi: Floats
    reference: Floats
    information: Floats
    pull: Floats
    images: Floats
    effects: Floats
    swing: Floats
    deviation: Floats
    faded: Floats

    @classmethod
    def none(cls, n: int, states: int) -> Records:
        shapes: tuple[tuple[int, ...], ...] = (
            (BINS,), (BINS,), (states,), (states, n, n), (), (n, n), (n, n), (n,), (n, n), (n,),
            (HELD_PUSHES, n), (HELD_PUSHES, n), (), (), (3,),
        )  # fmt: skip
        return cls(*(np.zeros((0, *shape)) for shape in shapes))

    @classmethod
    def first(cls, remainder: Remainder, axes: Floats, centre: Floats) -> Records:
        """One re-expansion, just made; axes (n, n): from whitened coordinates to those of x."""
        n = len(centre)
        values = (
            remainder.log_mass, remainder.radius, np.linalg.norm(remainder.mean, axis=1), remainder.second,
            np.float64(remainder.furthest), (1.0 - SPLIT) * axes @ axes.T, axes, centre, np.zeros((n, n)),
            np.zeros(n), np.zeros((HELD_PUSHES, n)), np.zeros((HELD_PUSHES, n)), np.float64(0.0),
            np.float64(0.0), np.zeros(3),
        )  # fmt: skip
        return cls(*(np.asarray(value)[None] for value in values))

    @property
    def count(self) -> int:
        return len(self.swing)

    @cached_property
    def eta(self) -> Floats:
        effects = 0.5 * np.sqrt(np.einsum("rli,rli->rl", self.effects, self.effects)).sum(axis=1)
        return np.asarray(np.linalg.norm(self.pull, axis=1) + self.swing + effects)

    @property
    def kept(self) -> Floats:
        """½ tr ΩV of each hidden state, (R, S)."""
        return np.asarray(0.5 * np.einsum("rij,rsij->rs", self.information, self.second))

    @property
    def weight(self) -> Floats:
        """2 n + ζ_max², (R,)."""
        return np.asarray(2.0 * self.psi.shape[1] + self.furthest**2)

    def chosen(self, rows: NDArray[np.bool_]) -> Records:
        return Records(*(values[rows] for values in self.arrays().values()))

    def joined(self, other: Records) -> Records:
        pairs = zip(self.arrays().values(), other.arrays().values(), strict=True)
        return Records(*(np.concatenate(pair) for pair in pairs))

    def arrays(self) -> dict[str, Floats]:
        return {entry.name: getattr(self, entry.name) for entry in fields(self)}

    @cached_property
    def log_rho(self) -> Floats:
        """Logarithms of ρ_r, with room for SLACK, for second moments and for the factor between U and T."""
        eta = self.eta + 1.0 + SLACK
        exponent = self.log_mass + eta[:, None] * self.radius
        top = exponent.max(axis=1, initial=-1e300)
        with np.errstate(over="ignore", invalid="ignore"):
            mass = top + np.log(np.exp(exponent - top[:, None]).sum(axis=1))
        room = SLACK * (1.0 + np.einsum("rsii->rs", self.second))
        below = (self.kept + eta[:, None] * self.mean + room).max(axis=1)
        log_rho = mass + log_tail(eta) + below + math.log(2.0)
        return np.where(np.isnan(log_rho), np.inf, log_rho)

    def moved(self, model: Model, packet: int, push: Floats, nu: int | None, shrink: float) -> Records:
        """The move of the plant; shrink: κ."""
        prior = model.A @ self.covariance @ model.A.T + model.Q
        images, effects, slot = self.images @ model.A.T, self.effects.copy(), packet % HELD_PUSHES
        last, done = images[:, slot], effects[:, slot]
        length = np.sqrt(np.maximum((np.linalg.solve(prior, last[..., None])[..., 0] * last).sum(axis=1), 0.0))
        swing = self.swing + 0.5 * np.sqrt((done**2).sum(axis=1))
        effects[:, slot] = 0.0
        images[:, slot] = push if nu is None else 0.0
        return replace(
            self,
            covariance=prior,
            psi=model.A @ self.psi,
            reference=self.reference @ model.A.T + (0.5 if nu is None else nu) * push,
            images=images,
            effects=effects,
            swing=swing,
            deviation=shrink * self.deviation + 0.5 * length,
        )

    def seen(self, model: Model, y: Floats) -> Records:
        """The observation y (p,)."""
        C, R, prior = model.C, model.R, self.covariance
        half = np.linalg.inv(np.linalg.cholesky(C @ prior @ C.T + R))
        sensed = half @ C
        x = sensed @ self.psi
        innovation = y - self.reference @ C.T
        white = half @ innovation[..., None]
        gain = np.swapaxes(sensed @ prior, 1, 2) @ half
        complement = np.eye(model.n) - gain @ C
        turned = np.swapaxes(x, 1, 2)
        return replace(
            self,
            covariance=complement @ prior @ np.swapaxes(complement, 1, 2) + gain @ R @ np.swapaxes(gain, 1, 2),
            psi=complement @ self.psi,
            reference=self.reference + (gain @ innovation[..., None])[..., 0],
            information=self.information + turned @ x,
            pull=self.pull + (turned @ white)[..., 0],
            images=self.images @ np.swapaxes(complement, 1, 2),
            effects=self.effects + self.images @ np.swapaxes(sensed, 1, 2) @ x,
            swing=self.swing + np.sqrt((x * x).sum(axis=(1, 2))) * self.deviation,
        )


@dataclass(frozen=True, eq=False)
class Certificate:
    """Of one lane. expansions: r. log_low, log_high: Σ log(1 − ε), Σ log(1 + ε). given_up (2,): Σ ρ_r and
    Σ ρ_r (2 n + ζ_max²) of those that are no longer held. ack (n, n): Pᴬ. peak (3,): largest η, tr Ω and ½ |B u| of
    late.
    """

    records: Records
    ack: Floats
    expansions: int = 0
    log_low: float = 0.0
    log_high: float = 0.0
    given_up: Floats = field(default_factory=lambda: np.zeros(2))
    peak: Floats = field(default_factory=lambda: np.array(FIRST_PEAK))

    def moved(self, model: Model, packet: int, push: Floats, nu: int | None) -> Certificate:
        ack = model.A @ self.ack @ model.A.T + model.Q
        try:
            half = np.linalg.inv(np.linalg.cholesky(ack))
            least = float(np.linalg.eigvalsh(half @ model.Q @ half.T)[0])
            records = self.records.moved(model, packet, push, nu, math.sqrt(1.0 - max(least, 0.0)))
            length = 0.5 * float(np.linalg.norm(half @ push)) if nu is None else 0.0
            return replace(self, ack=ack, records=records, peak=np.maximum(self.peak, [0.0, 0.0, length]))
        except np.linalg.LinAlgError:  # a singular prediction covariance: no norm to measure in
            given_up = np.full(2, np.inf) if self.records.count else self.given_up
            return replace(self, ack=ack, given_up=given_up, records=Records.none(model.n, self.records.mean.shape[1]))

    def seen(self, model: Model, y: Floats) -> Certificate:
        gain = np.linalg.solve(model.C @ self.ack @ model.C.T + model.R, model.C @ self.ack).T
        complement = np.eye(model.n) - gain @ model.C
        ack = complement @ self.ack @ complement.T + gain @ model.R @ gain.T
        if not self.records.count:
            return replace(self, ack=ack)
        records = self.records.seen(model, y)
        newest = np.array([records.eta.max(), float(np.einsum("rii->r", records.information).max()), 0.0])
        return replace(self, ack=ack, records=records, peak=np.maximum(self.peak, newest))

    def expanded(self, remainder: Remainder, axes: Floats, centre: Floats, epsilon: float) -> Certificate:
        """After a re-expansion of that ε, whose left-out nodes are given up or held."""
        new, old = Records.first(remainder, axes, centre), self.records
        given_up, kept = self.given_up, old
        if old.count:
            inverse = np.linalg.inv(axes)
            phi = np.linalg.norm(inverse @ old.psi, axis=(1, 2))
            inner = inverse @ old.covariance @ inverse.T
            z = np.linalg.norm(inner - (1.0 - SPLIT) * np.eye(len(axes)), axis=(1, 2))
            m = np.linalg.norm((old.reference - centre) @ inverse.T, axis=1) + phi * old.furthest
            m = m + np.sqrt(np.linalg.norm(inner, axis=(1, 2))) * old.deviation
            m = m + 0.5 * np.sqrt(((old.images @ inverse.T) ** 2).sum(axis=2)).sum(axis=1)
            gone = phi <= FADED
            if np.count_nonzero(~gone) >= HELD_MAX:
                return replace(self, given_up=np.full(2, np.inf), records=new)
            if gone.any():
                rho = _exp(old.log_rho[gone])
                given_up = given_up + np.array([rho.sum(), (rho * old.weight[gone]).sum()])
                new = replace(new, faded=np.array([[phi[gone].max(), z[gone].max(), m[gone].max()]]))
                if not _slight(old.chosen(gone)):
                    given_up = np.full(2, np.inf)
                kept = old.chosen(~gone)
        low = math.log1p(-epsilon) if epsilon < 1.0 else -math.inf
        return replace(
            self,
            records=kept.joined(new),
            expansions=self.expansions + 1,
            log_low=self.log_low + low,
            log_high=self.log_high + math.log1p(epsilon),
            given_up=given_up,
            peak=PEAK_DECAY * self.peak,
        )

    def expected(self) -> tuple[float, float]:
        """What η and tr Ω of the next re-expansion may come to, judged by those before; no bound hangs on it."""
        eta, information, push = (float(v) for v in self.peak)
        return 1.5 * max(eta, push) + 2.0, 1.5 * information

    @property
    def left_out(self) -> float:
        """S."""
        return float(_exp(self.records.log_rho).sum()) + float(self.given_up[0])

    def bounds(self, trace: float) -> tuple[float, float]:
        """Bounds of the error of x̂, in units of sqrt(tr P), and of the relative error of tr P = trace."""
        if not self.expansions:
            return 0.0, 0.0
        log_ratio = self.log_high - self.log_low
        rho = _exp(self.records.log_rho)
        total = float(rho.sum()) + float(self.given_up[0])
        weighted = float((rho * self.records.weight).sum()) + float(self.given_up[1])
        if not (2.0 * total < 0.5 and log_ratio < math.log(2.0) and _slight(self.records)):
            return math.inf, math.inf
        ratio, dropped = math.exp(log_ratio), total / (1.0 - total)
        scale = float(np.trace(self.ack)) / trace
        moment = (2.0 * total + 4.0 * weighted * scale * (1.0 + dropped) / (1.0 - SPLIT)) / (1.0 - 2.0 * total)
        low, high = 1.0 / (ratio * (1.0 + dropped)), ratio / (1.0 + dropped)
        shift = 0.5 * (high - low) + high * math.sqrt(dropped * moment)
        second = max(high - 1.0, 1.0 - low) + high * moment
        return shift, second + shift * shift


def _slight(records: Records) -> bool:
    """Whether what the future adds to those that were given up is below SLACK, for all of these."""
    phi, z, m = records.faded.T
    information = np.linalg.norm(records.information, axis=(1, 2)) + SLACK
    added = phi * ((1.0 + information * z) * (records.eta + SLACK) + information * m)
    return bool((np.maximum(added, phi * phi * information) <= SLACK).all())


def _exp(logs: Floats) -> Floats:
    return np.asarray(np.exp(np.minimum(logs, 700.0)))
