"""One lane beyond enumeration: its posterior, the certificate of it, and what it takes to go back in time.

An ACK of a packet whose fates a re-expansion has merged sends the lane back to the last checkpoint that still tells
them apart, and forward again with what is known now.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from testbed.estimator.certificate import Certificate, Records
from testbed.estimator.errors import TooManyHistories
from testbed.estimator.lattice import LOWEST, Cloud, expanded, poisson, spacing
from testbed.estimator.model import Model
from testbed.estimator.posterior import Fates, Posterior, decided, predicted, updated
from testbed.numerics.lanes import Floats
from testbed.numerics.ragged import Arrays

BRANCHES = 8
"""Histories since the last re-expansion at which the next one is due."""
LEFT_OUT_MAX = 1e-3
"""Share of the tolerance from which what was left out is too much."""
COMPONENTS_MAX = 4_000_000
"""Components that a lane may reach where it cannot be re-expanded."""
WAITING_MAX = 65536
"""Components up to which a re-expansion is put off that would leave out too much."""
_EARLY = 50.0
"""Re-expansion r gets a share of the tolerance in proportion to (r + _EARLY)^{−3/2}: the sum of all is finite."""


@dataclass(frozen=True)
class Settings:
    """tolerance: aim of the bound; histories: from how many on a posterior off the lattice is re-expanded."""

    model: Model
    fates: Fates
    tolerance: float
    histories: int
    max_lag: int


@dataclass(frozen=True, eq=False)
class Moment:
    """Posterior and certificate after a step."""

    posterior: Posterior
    certificate: Certificate

    @property
    def step(self) -> int:
        return self.posterior.step

    def distinguishes(self, packet: int) -> bool:
        return packet >= self.step or packet in self.posterior.undecided

    def decided(self, fates: Mapping[int, int]) -> Moment:
        return replace(self, posterior=decided(self.posterior, fates))

    def warned(self, peak: Floats) -> Moment:
        """The same with what later steps have shown to be in store."""
        return replace(self, certificate=replace(self.certificate, peak=np.maximum(self.certificate.peak, peak)))

    def arrays(self) -> Arrays:
        post, cert = self.posterior, self.certificate
        return {
            **{name: value for name, value in vars(post).items() if isinstance(value, np.ndarray)},
            "undecided": np.array(post.undecided, dtype=np.int64),
            "step": np.array([post.step, int(post.fresh)]),
            **{f"records.{name}": value for name, value in cert.records.arrays().items()},
            "ack": cert.ack,
            "expansions": np.array([cert.expansions]),
            "factors": np.array([cert.log_low, cert.log_high]),
            "given_up": cert.given_up,
            "peak": cert.peak,
        }

    @classmethod
    def of(cls, arrays: Arrays) -> Moment:
        plain = {
            name: arrays[name] for name in ("centre", "basis", "nodes", "offsets", "weights", "scores", "covariance")
        }
        step, fresh = (int(v) for v in arrays["step"])
        posterior = Posterior(step=step, fresh=bool(fresh), undecided=tuple(arrays["undecided"].tolist()), **plain)
        start = "records."
        records = Records(**{k.removeprefix(start): v for k, v in arrays.items() if k.startswith(start)})
        low, high = (float(v) for v in arrays["factors"])
        return cls(
            posterior,
            Certificate(
                records, arrays["ack"], int(arrays["expansions"][0]), low, high, arrays["given_up"], arrays["peak"]
            ),
        )


@dataclass(frozen=True, eq=False)
class Inputs:
    """Of the step that begins at packet ``step``: B u, y or None, ν or None."""

    step: int
    push: Floats
    y: Floats | None
    nu: int | None


class Lane:
    """Goes on from a posterior that enumerates its histories."""

    def __init__(self, settings: Settings, start: Posterior, ack: Floats) -> None:
        self._settings = settings
        self.now = Moment(start, Certificate(Records.none(settings.model.n, settings.fates.states), ack))
        self._checkpoints = [self.now] if settings.max_lag else []
        self._inputs: list[Inputs] = []
        self._known: set[int] = set()
        self._retried = -settings.max_lag

    def learn(self, fates: Mapping[int, int]) -> int:
        """Take in late ACKs, {packet: ν}; how many came too late to be used."""
        news = {j: nu for j, nu in fates.items() if j not in self._known}
        oldest = [self.now, *self._checkpoints[:1]]
        usable = {j: nu for j, nu in news.items() if any(moment.distinguishes(j) for moment in oldest)}
        if not usable:
            return len(news)
        self._known.update(usable)
        self._inputs = [replace(i, nu=usable[i.step]) if i.step in usable else i for i in self._inputs]
        self._checkpoints = [
            moment.decided(usable) for moment in self._checkpoints if all(map(moment.distinguishes, usable))
        ]
        if all(map(self.now.distinguishes, usable)):
            self.now = self.now.decided(usable)
        else:
            self._again()
        return len(news) - len(usable)

    def advance(self, push: Floats, y: Floats | None, nu: int | None) -> None:
        """One step. Raises TooManyHistories where a singular covariance keeps it from a lattice."""
        inputs = Inputs(self.now.step, push, y, nu)
        if nu is not None:
            self._known.add(inputs.step)
        if self._settings.max_lag:
            self._inputs.append(inputs)
        self._take(inputs)
        if self._surprised():
            self._checkpoints = [moment.warned(self.now.certificate.peak) for moment in self._checkpoints[:1]]
            self._retried = self.now.step
            self._again()

    def _surprised(self) -> bool:
        """Whether observations have made what was left out matter, and leaving out less may still be tried."""
        if not self._checkpoints or self.now.step < self._retried + self._settings.max_lag // 4:
            return False
        return self.now.certificate.left_out > LEFT_OUT_MAX * self._settings.tolerance

    def _again(self) -> None:
        """From the last checkpoint to now."""
        self.now = self._checkpoints[-1]
        for inputs in self._inputs:
            if inputs.step >= self.now.step:
                self._take(inputs)

    def _take(self, inputs: Inputs) -> None:
        self.now = stepped(self._settings, self.now, inputs)
        lag = self._settings.max_lag
        if not lag:
            return
        period, since = max(1, lag // 8), self.now.step - self._checkpoints[-1].step
        if since >= 2 * period or (since >= period and len(self.now.posterior.offsets) == 1):
            self._checkpoints.append(self.now)
        while len(self._checkpoints) > 1 and self._checkpoints[1].step <= self.now.step - lag:
            del self._checkpoints[0]
        first = self._checkpoints[0]
        self._inputs = [i for i in self._inputs if i.step >= first.step]
        self._known = {j for j in self._known if j >= first.step}

    def arrays(self) -> tuple[Arrays, list[Arrays]]:
        """All that the next step depends on: of the lane, and of its moments, the present one first."""
        model = self._settings.model
        inputs = {
            "steps": np.array([i.step for i in self._inputs], dtype=np.int64),
            "pushes": np.array([i.push for i in self._inputs]).reshape(-1, model.n),
            "seen": np.array([i.y is not None for i in self._inputs], dtype=np.int64),
            "y": np.array([np.zeros(model.p) if i.y is None else i.y for i in self._inputs]).reshape(-1, model.p),
            "nu": np.array([-1 if i.nu is None else i.nu for i in self._inputs], dtype=np.int64),
            "retried": np.array([self._retried]),
            "known": np.array(sorted(self._known), dtype=np.int64),
        }
        return inputs, [moment.arrays() for moment in (self.now, *self._checkpoints)]

    @property
    def consistent(self) -> bool:
        """Whether the shapes of its moments fit the model and one another."""
        n, states = self._settings.model.n, self._settings.fates.states
        none = Records.none(n, states).arrays()
        for moment in (self.now, *self._checkpoints):
            post, size = moment.posterior, (2 ** len(moment.posterior.undecided), len(moment.posterior.nodes))
            found = post.centre.shape, post.basis.shape, post.covariance.shape, post.nodes.shape[1:], post.offsets.shape
            if found != ((n,), (n, n), (n, n), (n,), (size[0], n)):
                return False
            if post.weights.shape != (states, *size) or post.scores.shape != size:
                return False
            records = moment.certificate.records.arrays()
            count = {len(array) for array in records.values()}
            if len(count) != 1 or any(records[name].shape[1:] != none[name].shape[1:] for name in none):
                return False
        return True

    @classmethod
    def of(cls, settings: Settings, inputs: Arrays, moments: list[Arrays]) -> Lane:
        lane = object.__new__(cls)
        lane._settings = settings
        lane.now, *lane._checkpoints = (Moment.of(arrays) for arrays in moments)
        rows = zip(*(inputs[name] for name in ("steps", "pushes", "seen", "y", "nu")), strict=True)
        lane._inputs = [
            Inputs(int(k), p, y if seen else None, None if nu < 0 else int(nu)) for k, p, seen, y, nu in rows
        ]
        lane._known = set(inputs["known"].tolist())
        lane._retried = int(inputs["retried"][0])
        return lane


def stepped(settings: Settings, moment: Moment, inputs: Inputs) -> Moment:
    """One step of posterior and certificate, with a re-expansion where that is due."""
    model = settings.model
    posterior = predicted(moment.posterior, model, settings.fates, inputs.push, inputs.nu)
    certificate = moment.certificate.moved(model, inputs.step, inputs.push, inputs.nu)
    if inputs.y is not None:
        posterior, certificate = updated(posterior, model, inputs.y), certificate.seen(model, inputs.y)
    off = len(posterior.nodes) == 1
    if posterior.components > settings.histories if off else len(posterior.offsets) >= BRANCHES:
        posterior, certificate = _reexpanded(settings, posterior, certificate)
    return Moment(posterior, certificate)


def _reexpanded(settings: Settings, posterior: Posterior, certificate: Certificate) -> tuple[Posterior, Certificate]:
    n = settings.model.n
    if not regular(posterior.covariance):
        if posterior.components > COMPONENTS_MAX:
            raise TooManyHistories(
                f"oe has {posterior.components} components at step {posterior.step} and their covariance is singular, "
                f"so that no lattice can hold them: stop it earlier (until = {posterior.step - 1}), give it ACKs, or "
                "use aoe"
            )
        return posterior, certificate
    share = settings.tolerance * 0.5 * math.sqrt(_EARLY) * (certificate.expansions + _EARLY) ** -1.5
    cloud = Cloud(posterior)
    eta, information = certificate.expected()
    log_cut = cloud.log_cut(eta, math.log(1e-4 * share) - 0.5 * information * cloud.spread)
    if log_cut <= LOWEST and posterior.components <= WAITING_MAX:
        return posterior, certificate  # too wide now; an observation will draw it together
    posterior, remainder, h = expanded(cloud, spacing(n, share / 2.2), log_cut)
    return posterior, certificate.expanded(remainder, cloud.axes, cloud.centre, poisson(n, h))


def regular(covariance: Floats) -> bool:
    """Whether a covariance is positive definite beyond rounding."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    return bool(np.linalg.eigvalsh(covariance / np.outer(scale, scale))[0] > 1e-10)
