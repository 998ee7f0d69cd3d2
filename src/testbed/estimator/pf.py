"""PF: a bootstrap particle filter, to check the others on small systems (theory.md 3.8)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np
from annotated_types import Ge, Le
from numpy.typing import NDArray

from testbed.channel.law import Law
from testbed.errors import UsageError
from testbed.estimator.hold import refuse_moments
from testbed.estimator.mixtures import IMPOSSIBLE
from testbed.estimator.model import Ack, Estimate, Model
from testbed.estimator.state import Given, State, last_law, start_of
from testbed.numerics.lanes import (
    Cholesky,
    Constant,
    Floats,
    Vector,
    add,
    constant,
    constant_times,
    matrix_of,
    subtract,
    vector_of,
)
from testbed.numerics.streams import LaneStream


@dataclass
class _Cloud:
    """Particles of one lane: x, n arrays (N,); states (N,), the last of the losses; scores (N,), logs of weights.

    applied: q arrays (N,), the input applied last, of an actuator that holds; else none.
    """

    x: Vector
    states: NDArray[np.intp] | None
    scores: Floats
    applied: Vector


class Pf:
    """``particles`` samples of x and of the last state of the control losses in each lane.

    They are drawn from the model and weighed by the likelihood; systematic resampling once the effective number of
    particles is below half of them. What is drawn depends on ``seed``, the number of the lane and the step alone.
    """

    STATE_VERSION: ClassVar[int] = 1
    takes_hold: ClassVar[bool] = True
    not_claimed: ClassVar[dict[str, str]] = {
        "coordinates": "its draws depend on the coordinates",
        "kfio_with_acks": "its mean and covariance are those of a sample",
    }

    def __init__(
        self,
        model: Model,
        lanes: int,
        particles: Annotated[int, Ge(2), Le(1_000_000)] = 1000,
        seed: Annotated[int, Ge(0)] = 0,
    ) -> None:
        self._model, self._lanes, self._particles = model, lanes, particles
        self._normals = LaneStream(seed, "estimator.pf", "noise")
        self._uniforms = LaneStream(seed, "estimator.pf", "control")
        self._seed = seed
        self._root = _root(model.Q)
        self._factor = Cholesky([list(row) for row in model.sensor_noise])
        self._first = 0
        self._clouds: list[_Cloud] | None = None
        self._k = 0
        self.counters: dict[str, int] = {}

    def begin_at(self, lane: int) -> None:
        """``lane``: the number that the first lane has in the run."""
        self._first = lane

    def step(self, u: Floats, y: Floats, arrived: NDArray[Any], acks: tuple[Ack, ...] = ()) -> Estimate:
        """An ACK of ν_{k−1} is used; older ones come too late and are counted."""
        clouds = self._begun()
        self._k += 1
        fates = self._fates(acks)
        n = self._model.n
        x_hat, P = np.empty((self._lanes, n)), np.empty((self._lanes, n, n))
        for lane, cloud in enumerate(clouds):
            normals, uniforms = self._draws(self._first + lane)
            self._move(cloud, u[lane], fates[lane], normals, uniforms)
            if arrived[lane]:
                self._weigh(cloud, y[lane])
            weights = np.exp(cloud.scores - cloud.scores.max())
            weights /= weights.sum()
            x_hat[lane], P[lane] = _moments(cloud.x, weights)
            if self._particles * (weights * weights).sum() > 2.0:
                _resample(cloud, weights, float(uniforms[-1]))
        return Estimate(vector_of(x_hat), matrix_of(P), self._lanes)

    def state(self) -> State:
        """x (M, n, N), scores (M, N), from the first step on states (M, N); ``lane``, the number of the first lane.

        applied (M, q, N) with an actuator that holds.
        """
        clouds = self._begun()
        out: State = {
            "k": np.array(self._k, dtype=np.int64),
            "lane": np.array(self._first, dtype=np.int64),
            "x": np.array([cloud.x for cloud in clouds]),
            "scores": np.array([cloud.scores for cloud in clouds]),
        }
        if self._model.holds:
            out["applied"] = np.array([cloud.applied for cloud in clouds])
        if self._k:
            out["states"] = np.array([cloud.states for cloud in clouds], dtype=np.int64)
        return out

    def set_state(self, state: State) -> None:
        lanes, n, particles = self._lanes, self._model.n, self._particles
        given = Given(state, lanes, n)
        first = given.integer("lane", 2**31)
        x = given.array("x", np.float64, lanes, n, particles)
        scores = given.array("scores", np.float64, lanes, particles)
        states: list[NDArray[np.intp] | None] = [None] * lanes
        if given.step:
            known, largest = given.array("states", np.int64, lanes, particles), len(self._model.law.arrived) - 1
            if not ((known >= 0) & (known <= largest)).all():
                raise UsageError(f"state: 'states' holds what is not one; allowed: 0 … {largest}")
            states = list(known)
        held = given.array("applied", np.float64, lanes, self._model.q, particles) if self._model.holds else None
        given.end()
        self._k, self._first = given.step, first
        self._clouds = [
            _Cloud(list(x[lane]), states[lane], scores[lane], [] if held is None else list(held[lane]))
            for lane in range(lanes)
        ]

    def start_from(self, step: int, x_hat: Floats, P: Floats) -> None:
        """Draws the particles from N(x̂, P), with streams of their own."""
        refuse_moments(self._model, step)
        start_of(step, x_hat, P, self._lanes, self._model.n)
        streams = [LaneStream(self._seed, "estimator.pf", f"start.{part}") for part in ("noise", "control")]
        self._k, self._clouds = step, []
        for lane in range(self._lanes):
            cloud = self._cloud(x_hat[lane], P[lane], streams[0], self._first + lane)
            if step:
                moves = np.tile(last_law(self._model.law, step), (self._particles, 1))
                points = streams[1].uniforms(self._first + lane, step, self._particles)
                cloud.states = _drawn(self._model.law, moves, points)
            self._clouds.append(cloud)

    def _begun(self) -> list[_Cloud]:
        if self._clouds is None:
            model, lanes = self._model, range(self._first, self._first + self._lanes)
            self._clouds = [self._cloud(model.x0_mean, model.P0, self._normals, lane) for lane in lanes]
        return self._clouds

    def _cloud(self, mean: Floats, covariance: Floats, stream: LaneStream, lane: int) -> _Cloud:
        """Drawn from N(mean, covariance), with the draws of step k."""
        n, particles = self._model.n, self._particles
        normals = stream.normals(lane, self._k, n * particles).reshape(n, particles)
        spread = constant_times(_root(covariance), list(normals))
        x = [np.full(particles, m) + s for m, s in zip(mean, spread, strict=True)]
        held = [np.zeros(particles) for _ in range(self._model.q)] if self._model.holds else []
        return _Cloud(x, None, np.zeros(particles), held)

    def _draws(self, lane: int) -> tuple[Vector, Floats]:
        n, particles = self._model.n, self._particles
        normals = self._normals.normals(lane, self._k, n * particles).reshape(n, particles)
        return list(normals), self._uniforms.uniforms(lane, self._k, particles + 1)

    def _fates(self, acks: tuple[Ack, ...]) -> list[bool | None]:
        """ν_{k−1} of each lane, None where it is not known."""
        fates: list[bool | None] = [None] * self._lanes
        for ack in acks:
            if ack.j == self._k - 1:
                for lane in np.flatnonzero(ack.known):
                    fates[lane] = bool(ack.nu[lane])
            else:
                self.counters["late_acks"] = self.counters.get("late_acks", 0) + int(np.count_nonzero(ack.known))
        return fates

    def _move(self, cloud: _Cloud, u: Floats, fate: bool | None, normals: Vector, uniforms: Floats) -> None:
        """Draw ν_{k−1} and x_k from the model; where ν is known, take it and weigh by its probability."""
        model = self._model
        law, points = model.law, uniforms[:-1]
        rows = law.initial if cloud.states is None else law.transition[cloud.states]
        moves = np.broadcast_to(rows, (self._particles, len(law.arrived)))
        arrival = moves[:, law.arrived].sum(axis=1)
        if fate is None:
            cloud.states = _drawn(law, moves, points)
            nu = law.arrived[cloud.states]
        else:
            chance = arrival if fate else 1.0 - arrival
            with np.errstate(divide="ignore"):
                cloud.scores = cloud.scores + np.maximum(np.log(chance), IMPOSSIBLE)
            nu = np.full(self._particles, fate)
            cloud.states = _among(law, moves, nu, points * chance)
        x = add(constant_times(model.a, cloud.x), constant_times(self._root, normals))
        if model.holds:
            cloud.applied = [np.where(nu, float(new), old) for new, old in zip(u, cloud.applied, strict=True)]
            cloud.x = add(x, model.control_effect(cloud.applied))
            return
        push = model.control_effect([float(v) for v in u]) if model.q else [0.0] * model.n
        cloud.x = [m + np.where(nu, b, 0.0) for m, b in zip(x, push, strict=True)]

    def _weigh(self, cloud: _Cloud, y: Floats) -> None:
        innovation = subtract([float(v) for v in y], constant_times(self._model.c, cloud.x))
        scores = cloud.scores - 0.5 * self._factor.quadratic(innovation)
        cloud.scores = scores - scores.max()


def _drawn(law: Law, moves: Floats, points: Floats) -> NDArray[np.intp]:
    """The state of each particle: first its fate, then the state; moves (N, H), points (N,) uniform."""
    arrival = moves[:, law.arrived].sum(axis=1)
    nu = points < arrival
    return _among(law, moves, nu, np.where(nu, points, points - arrival))


def _among(law: Law, moves: Floats, nu: NDArray[np.bool_], points: Floats) -> NDArray[np.intp]:
    """The state of each particle among those of its fate: where its point lies on their probabilities, side by side.

    moves (N, H), nu (N,), points (N,) in 0 … P(that fate).
    """
    if law.visible:
        return nu.astype(np.intp)
    chosen = np.empty(len(nu), dtype=np.intp)
    for fate in (False, True):
        among, here = np.array(law.states_of(fate)), nu == fate
        passed = points[here, None] >= np.cumsum(moves[here][:, among[:-1]], axis=1)
        chosen[here] = among[passed.sum(axis=1)]
    return chosen


def _moments(x: Vector, weights: Floats) -> tuple[Floats, Floats]:
    n = len(x)
    mean = np.array([(weights * component).sum() for component in x])
    away = [component - m for component, m in zip(x, mean, strict=True)]
    covariance = np.empty((n, n))
    for i in range(n):
        for j in range(i, n):
            covariance[i, j] = covariance[j, i] = (weights * away[i] * away[j]).sum()
    return mean, covariance


def _resample(cloud: _Cloud, weights: Floats, uniform: float) -> None:
    """Systematic: one uniform number for all, each particle kept ⌊N w⌋ or ⌈N w⌉ times."""
    count = len(weights)
    chosen = np.searchsorted(np.cumsum(weights), (uniform + np.arange(count)) / count, side="right")
    chosen = np.minimum(chosen, count - 1)
    cloud.x = [component[chosen] for component in cloud.x]
    cloud.applied = [component[chosen] for component in cloud.applied]
    cloud.states = None if cloud.states is None else cloud.states[chosen]
    cloud.scores = np.zeros(count)


def _root(matrix: Floats) -> Constant:
    """F with F F' = matrix, also where that is singular."""
    values, vectors = np.linalg.eigh(matrix)
    return constant(vectors * np.sqrt(np.maximum(values, 0.0)))
