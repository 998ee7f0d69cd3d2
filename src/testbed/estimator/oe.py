"""OE by exact enumeration: the posterior as a Gaussian mixture over control-loss histories (theory.md 3.2).

All hypotheses share the ACK covariance and its gain (F Remark 1, D Lemma 1, M Lemma 4). Every control packet whose fate
is not known doubles the number of hypotheses; an ACK, however late, halves it again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge
from numpy.typing import NDArray

from testbed.errors import UsageError
from testbed.estimator.errors import ContradictoryAck, TooManyHistories
from testbed.estimator.model import Ack, Estimate, Model
from testbed.estimator.riccati import Gain, phi, predict
from testbed.numerics.lanes import (
    Cholesky,
    Component,
    Floats,
    Vector,
    constant_times,
    dot,
    mask_of,
    matrix_of,
    symmetric,
    vector_of,
)
from testbed.scenario import Scenario

MAX_HISTORIES = 65536


@dataclass
class _Group:
    """Lanes with the same undecided control packets.

    lanes (G,); undecided: packet numbers, oldest first; means: n arrays (G, H); scores (G, H): logarithms of the
    weights up to a constant a lane, the largest 0, so that no history that data may yet revive underflows;
    H = 2^undecided: the bits of a hypothesis' index are the fates of the undecided packets, the newest in the lowest
    bit; last (G,): ν of the newest packet where that is decided, else None.
    """

    lanes: NDArray[np.intp]
    undecided: tuple[int, ...]
    means: list[Floats]
    scores: Floats
    last: Floats | None

    def select(self, rows: NDArray[np.bool_]) -> _Group:
        last = None if self.last is None else self.last[rows]
        return _Group(self.lanes[rows], self.undecided, [m[rows] for m in self.means], self.scores[rows], last)


class Oe:
    """The minimum mean square error estimator, exact, while 2^(undecided packets) ≤ ``max_histories``."""

    def __init__(self, model: Model, lanes: int, max_histories: Annotated[int, Ge(1)] = MAX_HISTORIES) -> None:
        self._model, self._lanes, self._limit = model, lanes, max_histories
        _, self._p = model.prior(lanes)
        start = _Group(
            np.arange(lanes), (), [np.full((lanes, 1), float(v)) for v in model.x0_mean], np.zeros((lanes, 1)), None
        )
        self._groups = [start]
        self._k = 0
        self.counters: dict[str, int] = {}

    def check_scenario(self, scenario: Scenario, acks: str, until: int) -> None:
        """Raises UsageError where the histories of the scenario pass the limit."""
        longest = self._limit.bit_length() - 1
        if acks == "none" and not self._model.control.never_loses and until > longest:
            raise UsageError(
                f"oe enumerates 2^k histories, that is 2^{until} at its last step, and the limit is max_histories = "
                f"{self._limit}; allowed: until = {longest} or less, a larger max_histories, ACKs, or aoe"
            )

    def step(self, u: Floats, y: Floats, arrived: NDArray[Any], acks: tuple[Ack, ...] = ()) -> Estimate:
        """Raises TooManyHistories where the number of hypotheses would pass the limit."""
        model, gamma = self._model, mask_of(arrived)
        self._k += 1
        packet = self._k - 1
        push = [np.broadcast_to(b, self._lanes) for b in model.control_effect(vector_of(u))] if model.q else []
        for ack in acks:
            self._learn(ack, packet)
        self._groups = [self._branch(group, packet, push, acks) for group in self._groups_by_ack(acks, packet)]
        covariance = predict(model.a, self._p, model.noise)
        gain = Gain(covariance, model.c, model.sensor_noise)
        observed = np.asarray(arrived, dtype=np.bool_)
        if observed.any():
            self._groups = [self._observe(group, gain, vector_of(y), observed) for group in self._groups]
        self._p = phi(covariance, gain, gamma)
        self._groups = _joined(self._groups)
        return self._moments()

    def _learn(self, ack: Ack, packet: int) -> None:
        """Drop the hypotheses that an ACK of an older packet contradicts."""
        if ack.j == packet:
            return
        groups = []
        for group in self._groups:
            known = ack.known.astype(np.bool_)[group.lanes]
            if ack.j not in group.undecided or not known.any():
                groups.append(group)
                continue
            if not known.all():
                groups.append(group.select(~known))
            groups.append(_decide(group.select(known), ack.j, ack.nu, self._k - 2))
        self._groups = _joined(groups)

    def _groups_by_ack(self, acks: tuple[Ack, ...], packet: int) -> list[_Group]:
        """Groups in each of which ν of the newest packet is known in every lane or in none."""
        known = np.zeros(self._lanes, dtype=np.bool_)
        for ack in acks:
            if ack.j == packet:
                known |= ack.known.astype(np.bool_)
        if self._model.control.never_loses:
            known[:] = True
        groups = []
        for group in self._groups:
            here = known[group.lanes]
            groups += [group.select(rows) for rows in (here, ~here) if rows.any()]
        return groups

    def _branch(self, group: _Group, packet: int, push: Vector, acks: tuple[Ack, ...]) -> _Group:
        """One move of the plant: each hypothesis splits in two, or none does where ν is known."""
        model = self._model
        moved = [np.broadcast_to(m, group.scores.shape) for m in constant_times(model.a, list(group.means))]
        shift = [b[group.lanes][:, None] for b in push] or [np.zeros((len(group.lanes), 1))] * model.n
        nu = self._known_nu(group, packet, acks)
        if nu is not None:
            means = [m + nu[:, None] * s for m, s in zip(moved, shift, strict=True)]
            arrival = self._arrival(group)
            scores = group.scores + _log(np.where(nu[:, None] == 1.0, arrival, 1.0 - arrival))
            return _Group(group.lanes, group.undecided, means, _levelled(scores), nu)
        if 2 * group.scores.shape[1] > self._limit:
            raise TooManyHistories(
                f"oe would need {2 * group.scores.shape[1]} histories at step {self._k}; the limit is "
                f"max_histories = {self._limit}: stop it earlier (until = {self._k - 1}), give it ACKs, or use aoe"
            )
        arrival = self._arrival(group)
        means = [_interleave(m, m + s) for m, s in zip(moved, shift, strict=True)]
        scores = _interleave(group.scores + _log(1.0 - arrival), group.scores + _log(arrival))
        return _Group(group.lanes, (*group.undecided, packet), means, scores, None)

    def _known_nu(self, group: _Group, packet: int, acks: tuple[Ack, ...]) -> Floats | None:
        if self._model.control.never_loses:
            return np.ones(len(group.lanes))
        for ack in acks:
            if ack.j == packet and ack.known[group.lanes[0]]:
                return ack.nu.astype(np.float64)[group.lanes]
        return None

    def _arrival(self, group: _Group) -> Floats:
        """P(ν_{k−1} = 1 | history) of each hypothesis, broadcastable to (G, H)."""
        chain = self._model.control
        if self._k == 1:
            return np.full((1, 1), chain.start)
        if group.last is not None:
            return np.where(group.last == 1.0, 1.0 - chain.failure, chain.recovery)[:, None]
        newest = np.arange(group.scores.shape[1]) % 2 == 1
        return np.where(newest, 1.0 - chain.failure, chain.recovery)[None, :]

    def _observe(self, group: _Group, gain: Gain, y: Vector, observed: NDArray[np.bool_]) -> _Group:
        here = observed[group.lanes]
        if not here.any():
            return group

        def of_group(component: Component) -> Component:
            return np.broadcast_to(component, self._lanes)[group.lanes][:, None]

        k = [[of_group(entry) for entry in row] for row in gain.K]
        predicted = constant_times(gain.C, list(group.means))
        innovation = [of_group(a) - b for a, b in zip(y, predicted, strict=True)]
        factor: Cholesky = gain.innovation.mapped(of_group)
        log_likelihood = -0.5 * np.broadcast_to(factor.quadratic(innovation), group.scores.shape)
        updated = _levelled(group.scores + log_likelihood)
        means = [np.where(here[:, None], m + dot(row, innovation), m) for m, row in zip(group.means, k, strict=True)]
        scores = np.where(here[:, None], updated, group.scores)
        return _Group(group.lanes, group.undecided, means, scores, group.last)

    def _moments(self) -> Estimate:
        n = self._model.n
        mean = np.empty((self._lanes, n))
        spread = np.empty((self._lanes, n, n))
        for group in self._groups:
            weights = np.exp(group.scores)
            weights /= weights.sum(axis=1, keepdims=True)
            centre = [(weights * m).sum(axis=1) for m in group.means]
            away = [m - c[:, None] for m, c in zip(group.means, centre, strict=True)]
            for i in range(n):
                mean[group.lanes, i] = centre[i]
                for j in range(i, n):
                    spread[group.lanes, i, j] = (weights * away[i] * away[j]).sum(axis=1)
        between = matrix_of(spread)
        p = symmetric(n, lambda i, j: self._p[i][j] + between[i][j])
        return Estimate(vector_of(mean), p, self._lanes)


def _interleave(a: Floats, b: Floats) -> Floats:
    """Columns a0 b0 a1 b1 …: the newest bit is the lowest."""
    out = np.empty((a.shape[0], 2 * a.shape[1]))
    out[:, 0::2], out[:, 1::2] = a, b
    return out


def _levelled(scores: Floats) -> Floats:
    """The same weights with the largest score of each lane at 0. Raises ContradictoryAck if all are impossible."""
    top = scores.max(axis=1, keepdims=True)
    if not np.isfinite(top).all():
        raise ContradictoryAck("an ACK says what the model of the control link holds to be impossible")
    return np.asarray(scores - top)


def _log(probability: Floats) -> Floats:
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(probability))


def _decide(group: _Group, j: int, nu: NDArray[Any], newest: int) -> _Group:
    """Keep the hypotheses in which packet j had the fate ``nu`` says."""
    position = group.undecided.index(j)
    later = 2 ** (len(group.undecided) - 1 - position)
    fate = nu.astype(np.intp)[group.lanes]

    def keep(values: Floats) -> Floats:
        lanes = values.shape[0]
        split = values.reshape(lanes, -1, 2, later)
        return np.ascontiguousarray(split[np.arange(lanes), :, fate, :].reshape(lanes, -1))

    undecided = tuple(i for i in group.undecided if i != j)
    last = fate.astype(np.float64) if j == newest else group.last
    return _Group(group.lanes, undecided, [keep(m) for m in group.means], _levelled(keep(group.scores)), last)


def _joined(groups: list[_Group]) -> list[_Group]:
    """Groups with the same undecided packets become one."""
    by_key: dict[tuple[tuple[int, ...], bool], list[_Group]] = {}
    for group in groups:
        by_key.setdefault((group.undecided, group.last is None), []).append(group)
    return [same[0] if len(same) == 1 else _concatenated(same) for same in by_key.values()]


def _concatenated(groups: list[_Group]) -> _Group:
    first = groups[0]
    last = None if first.last is None else np.concatenate([g.last for g in groups if g.last is not None])
    return _Group(
        np.concatenate([g.lanes for g in groups]),
        first.undecided,
        [np.concatenate([g.means[i] for g in groups]) for i in range(len(first.means))],
        np.concatenate([g.scores for g in groups]),
        last,
    )
