"""OE by exact enumeration: the posterior as a Gaussian mixture over control-loss histories (theory.md 3.2).

All hypotheses share the ACK covariance and its gain (F Remark 1, D Lemma 1, M Lemma 4). Every control packet whose fate
is not known doubles the number of hypotheses; an ACK, however late, halves it again. Where the losses have a hidden
state, each history carries the law of it (the forward algorithm), so that their number stays the same.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np
from annotated_types import Ge
from numpy.typing import NDArray

from testbed.errors import UsageError
from testbed.estimator.errors import ContradictoryAck, TooManyHistories
from testbed.estimator.hold import refuse_moments
from testbed.estimator.model import Ack, Estimate, Model
from testbed.estimator.posterior import Fates
from testbed.estimator.riccati import Gain, phi, predict
from testbed.estimator.state import Given, State, start_of
from testbed.numerics.lanes import (
    Cholesky,
    Component,
    Floats,
    Vector,
    add,
    constant_times,
    dot,
    mask_of,
    matrices_of,
    matrix_of,
    symmetric,
    vector_of,
)
from testbed.numerics.ragged import packed, unpacked
from testbed.scenario import Scenario

MAX_HISTORIES = 65536


@dataclass
class Group:
    """Lanes with the same undecided control packets.

    lanes (G,); undecided: packet numbers, oldest first; means: n arrays (G, H); scores (G, H): logarithms of the
    weights up to a constant a lane, the largest 0, so that no history that data may yet revive underflows;
    H = 2^undecided: the bits of a hypothesis' index are the fates of the undecided packets, the newest in the lowest
    bit; hidden (S, G, H): law of the link's hidden state at the newest packet, given the history.
    applied: q arrays (G, H), the input applied last, of an actuator that holds; else none.
    """

    lanes: NDArray[np.intp]
    undecided: tuple[int, ...]
    means: list[Floats]
    scores: Floats
    hidden: Floats
    applied: list[Floats]

    def select(self, rows: NDArray[np.bool_]) -> Group:
        means = [m[rows] for m in self.means]
        applied = [a[rows] for a in self.applied]
        return Group(self.lanes[rows], self.undecided, means, self.scores[rows], self.hidden[:, rows], applied)


class OeExact:
    """The minimum mean square error estimator, exact, while 2^(undecided packets) ≤ ``max_histories``."""

    STATE_VERSION: ClassVar[int] = 1
    takes_hold: ClassVar[bool] = True
    _name, _other = "oe-exact", "oe"

    def __init__(self, model: Model, lanes: int, max_histories: Annotated[int, Ge(1)] = MAX_HISTORIES) -> None:
        self._model, self._lanes, self._limit = model, lanes, max_histories
        self._fates = Fates(model.law)
        if model.holds:
            self._other = "gpb"  # there is no lattice
        self.counters: dict[str, int] = {}
        x_hat, P = np.tile(model.x0_mean, (lanes, 1)), np.tile(model.P0, (lanes, 1, 1))
        self.start_from(0, x_hat, P)

    def check_scenario(self, scenario: Scenario, acks: str, until: int) -> None:
        """Raises UsageError where the histories of the scenario pass the limit."""
        longest = self._limit.bit_length() - 1
        if acks == "none" and not self._model.control.never_loses and until > longest:
            raise UsageError(
                f"{self._name} enumerates 2^k histories, that is 2^{until} at its last step, and the limit is "
                f"max_histories = {self._limit}; allowed: until = {longest} or less, a larger max_histories, ACKs, "
                f"or {self._other}"
            )

    def start_from(self, step: int, x_hat: Floats, P: Floats) -> None:
        """Begin behind ``step`` with N(x_hat, P), (M, n) and (M, n, n), in each lane, knowing of no loss before."""
        refuse_moments(self._model, step)
        _, covariance = start_of(step, x_hat, P, self._lanes, self._model.n)
        law = np.repeat(self._fates.at(step), self._lanes).reshape(-1, self._lanes, 1)
        means = [x_hat[:, i : i + 1].astype(np.float64) for i in range(self._model.n)]
        held = [np.zeros((self._lanes, 1)) for _ in range(self._model.q)] if self._model.holds else []
        self._groups = [Group(np.arange(self._lanes), (), means, np.zeros((self._lanes, 1)), law, held)]
        self._p = covariance
        self._k, self._first = step, step

    def state(self) -> State:
        """k, the step of the start, P (M, n, n), and the groups: ``group.NAME`` and the shapes of each."""
        groups = [
            {
                "lanes": group.lanes,
                "undecided": np.array(group.undecided, dtype=np.int64),
                "means": np.stack(group.means),
                "scores": group.scores,
                "hidden": group.hidden,
                **({"applied": np.stack(group.applied)} if group.applied else {}),
            }
            for group in self._groups
        ]
        steps = {"k": np.array(self._k, dtype=np.int64), "first": np.array(self._first, dtype=np.int64)}
        return {**steps, "P": matrices_of(self._p, self._lanes), **packed("group.", groups)}

    def set_state(self, state: State) -> None:
        """Raises UsageError, and changes nothing, for what is not the ``state`` of such an estimator."""
        twin = copy.copy(self)
        given = Given({name: state[name] for name in ("k", "P") if name in state}, self._lanes, self._model.n)
        covariance = given.matrix("P")
        for name, array in state.items():
            if array.dtype not in (np.float64, np.int64) or not np.isfinite(array).all():
                raise UsageError(f"state: {name!r} holds what is not a finite float64 or an int64")
        try:
            twin._k, twin._p, twin._first = given.step, covariance, int(state["first"])
            twin._take(state)
            again = twin.state() if twin._consistent() else {}
        except (KeyError, ValueError, IndexError, TypeError, StopIteration) as error:
            raise UsageError(f"state: not one of {self._name!r}: {' '.join(str(error).split())}") from None
        if again.keys() != state.keys() or not all(_same(again[name], state[name]) for name in again):
            raise UsageError(f"state: not one of {self._name!r} with this model, lanes and options")
        vars(self).update(vars(twin))

    def _take(self, state: State) -> None:
        self._groups = [
            Group(
                part["lanes"],
                tuple(part["undecided"].tolist()),
                list(part["means"]),
                part["scores"],
                part["hidden"],
                list(part["applied"]) if self._model.holds else [],
            )
            for part in unpacked("group.", state)
        ]

    def _consistent(self) -> bool:
        """Whether the shapes fit one another and each lane is in one place."""
        n, states = self._model.n, self._fates.states
        channels = self._model.q if self._model.holds else 0
        for group in self._groups:
            size = len(group.lanes), 2 ** len(group.undecided)
            shapes = [*(m.shape for m in group.means), group.scores.shape, *(h.shape for h in group.hidden)]
            shapes += [a.shape for a in group.applied]
            counts = len(group.means), len(group.hidden), len(group.applied)
            if counts != (n, states, channels) or set(shapes) != {size}:
                return False
        held = sorted(int(i) for group in self._groups for i in group.lanes)
        return sorted([*held, *self._elsewhere()]) == list(range(self._lanes)) and 0 <= self._first <= self._k

    def _elsewhere(self) -> list[int]:
        """Lanes that no group holds."""
        return []

    def step(self, u: Floats, y: Floats, arrived: NDArray[Any], acks: tuple[Ack, ...] = ()) -> Estimate:
        """Raises TooManyHistories where the number of hypotheses would pass the limit."""
        mean, spread = np.empty((self._lanes, self._model.n)), np.zeros((self._lanes, self._model.n, self._model.n))
        self._advance(u, y, arrived, acks)
        self._moments(mean, spread)
        return self._estimate(mean, spread)

    def _advance(self, u: Floats, y: Floats, arrived: NDArray[Any], acks: tuple[Ack, ...]) -> None:
        model, gamma = self._model, mask_of(arrived)
        self._k += 1
        packet = self._k - 1
        sent = vector_of(u)
        push = [np.broadcast_to(b, self._lanes) for b in model.control_effect(sent)] if model.q else []
        for ack in acks:
            self._learn(ack, packet)
        held = [np.broadcast_to(v, self._lanes) for v in sent] if model.holds else []
        branches = [self._branch(group, packet, push, held, acks) for group in self._groups_by_ack(acks, packet)]
        self._groups = [group for group in branches if group is not None]
        covariance = predict(model.a, self._p, model.noise)
        gain = Gain(covariance, model.c, model.sensor_noise)
        observed = np.asarray(arrived, dtype=np.bool_)
        if observed.any():
            self._groups = [self._observe(group, gain, vector_of(y), observed) for group in self._groups]
        self._p = phi(covariance, gain, gamma)
        self._groups = _joined(self._groups)

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
            groups.append(_decide(group.select(known), ack.j, ack.nu))
        self._groups = _joined(groups)

    def _groups_by_ack(self, acks: tuple[Ack, ...], packet: int) -> list[Group]:
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

    def _branch(self, group: Group, packet: int, push: Vector, sent: Vector, acks: tuple[Ack, ...]) -> Group | None:
        """One move of the plant: each hypothesis splits in two, or none does where ν is known.

        push: B u; sent: u with an actuator that holds, else nothing.
        """
        model = self._model
        nu = self._known_nu(group, packet, acks)
        if nu is None and 2 * group.scores.shape[1] > self._limit:
            return self._overflow(group)
        moved = [np.broadcast_to(m, group.scores.shape) for m in constant_times(model.a, list(group.means))]
        shift = [b[group.lanes][:, None] for b in push] or [np.zeros((len(group.lanes), 1))] * model.n
        hidden, chances = self._split(group)
        idle = moved
        if model.holds:
            idle = add(moved, constant_times(model.b, list(group.applied)))
        fresh = [np.broadcast_to(v[group.lanes][:, None], group.scores.shape) for v in sent]
        if nu is not None:
            delivered = nu[:, None] == 1.0
            applied = [np.where(delivered, new, old) for new, old in zip(fresh, group.applied, strict=True)]
            if model.holds:
                means = add(moved, constant_times(model.b, list(applied)))
            else:
                means = [m + nu[:, None] * s for m, s in zip(moved, shift, strict=True)]
            scores = group.scores + _log(np.where(delivered, chances[1], chances[0]))
            law = np.where(delivered, hidden[1], hidden[0])
            return Group(group.lanes, group.undecided, means, _levelled(scores), law, applied)
        means = [_interleave(i, m + s) for i, m, s in zip(idle, moved, shift, strict=True)]
        applied = [_interleave(old, new) for old, new in zip(group.applied, fresh, strict=True)]
        scores = _interleave(group.scores + _log(chances[0]), group.scores + _log(chances[1]))
        law = np.stack([_interleave(a, b) for a, b in zip(*hidden, strict=True)])
        return Group(group.lanes, (*group.undecided, packet), means, scores, law, applied)

    def _overflow(self, group: Group) -> Group | None:
        """What becomes of lanes whose hypotheses would pass the limit."""
        raise TooManyHistories(
            f"{self._name} would need {2 * group.scores.shape[1]} histories at step {self._k}; the limit is "
            f"max_histories = {self._limit}: stop it earlier (until = {self._k - 1}), give it ACKs, or use "
            f"{self._other}"
        )

    def _split(self, group: Group) -> tuple[list[Floats], list[Floats]]:
        """For ν = 0 and 1: the law of the hidden state given it (S, G, H), and its probability (G, H)."""
        laws, chances = [], []
        for joint in self._fates.split(group.hidden, self._k == self._first + 1):
            chance = np.minimum(joint.sum(axis=0), 1.0)
            laws.append(joint / np.where(chance > 0.0, chance, 1.0))
            chances.append(chance)
        return laws, chances

    def _known_nu(self, group: Group, packet: int, acks: tuple[Ack, ...]) -> Floats | None:
        if self._model.control.never_loses:
            return np.ones(len(group.lanes))
        for ack in acks:
            if ack.j == packet and ack.known[group.lanes[0]]:
                return ack.nu.astype(np.float64)[group.lanes]
        return None

    def _observe(self, group: Group, gain: Gain, y: Vector, observed: NDArray[np.bool_]) -> Group:
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
        return Group(group.lanes, group.undecided, means, scores, group.hidden, group.applied)

    def _moments(self, mean: Floats, spread: Floats) -> None:
        """Mean (M, n) and covariance of the means (M, n, n) of the lanes that are enumerated."""
        for group in self._groups:
            weights = np.exp(group.scores)
            weights /= weights.sum(axis=1, keepdims=True)
            centre = [(weights * m).sum(axis=1) for m in group.means]
            away = [m - c[:, None] for m, c in zip(group.means, centre, strict=True)]
            for i in range(self._model.n):
                mean[group.lanes, i] = centre[i]
                for j in range(i, self._model.n):
                    spread[group.lanes, i, j] = (weights * away[i] * away[j]).sum(axis=1)

    def _estimate(self, mean: Floats, spread: Floats) -> Estimate:
        """spread: upper triangles of what is added to the ACK covariance."""
        between = matrix_of(spread)
        p = symmetric(self._model.n, lambda i, j: self._p[i][j] + between[i][j])
        return Estimate(vector_of(mean), p, self._lanes)


def _same(a: NDArray[Any], b: NDArray[Any]) -> bool:
    return a.dtype == b.dtype and a.shape == b.shape and bool(np.array_equal(a, b))


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


def _decide(group: Group, j: int, nu: NDArray[Any]) -> Group:
    """Keep the hypotheses in which packet j had the fate ``nu`` says."""
    position = group.undecided.index(j)
    later = 2 ** (len(group.undecided) - 1 - position)
    fate = nu.astype(np.intp)[group.lanes]

    def keep(values: Floats) -> Floats:
        lanes = values.shape[0]
        split = values.reshape(lanes, -1, 2, later)
        return np.ascontiguousarray(split[np.arange(lanes), :, fate, :].reshape(lanes, -1))

    undecided = tuple(i for i in group.undecided if i != j)
    hidden = np.stack([keep(h) for h in group.hidden])
    means, applied = [keep(m) for m in group.means], [keep(a) for a in group.applied]
    return Group(group.lanes, undecided, means, _levelled(keep(group.scores)), hidden, applied)


def _joined(groups: list[Group]) -> list[Group]:
    """Groups with the same undecided packets become one."""
    by_key: dict[tuple[int, ...], list[Group]] = {}
    for group in groups:
        by_key.setdefault(group.undecided, []).append(group)
    return [same[0] if len(same) == 1 else _concatenated(same) for same in by_key.values()]


def _concatenated(groups: list[Group]) -> Group:
    first = groups[0]
    return Group(
        np.concatenate([g.lanes for g in groups]),
        first.undecided,
        [np.concatenate([g.means[i] for g in groups]) for i in range(len(first.means))],
        np.concatenate([g.scores for g in groups]),
        np.concatenate([g.hidden for g in groups], axis=1),
        [np.concatenate([g.applied[i] for g in groups]) for i in range(len(first.applied))],
    )
