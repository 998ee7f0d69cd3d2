"""OE, the optimal estimator: exact while its histories are few, then on a lattice, with a bound on its error.

Enumeration is ``oe_exact``; re-expansion on a lattice is ``lattice``; the proof of the bound is in ``certificate``.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from annotated_types import Ge, Gt, Le
from numpy.typing import NDArray

from testbed.estimator.model import Ack, Estimate, Model
from testbed.estimator.oe_exact import MAX_HISTORIES, Group, OeExact
from testbed.estimator.posterior import Posterior
from testbed.estimator.refiltering import Lane, Settings
from testbed.estimator.state import State
from testbed.numerics.lanes import Floats, matrices_of, matrix_of, vector_of
from testbed.numerics.ragged import packed, unpacked
from testbed.scenario import Scenario

ENUMERATED = {1: 4096, 2: 4096, 3: 512}
"""Histories from which a lane goes to the lattice, for one, two and three states; above, there is none.

Nor with an actuator that holds: the components then differ in the input applied last too, of which there are as many
values as steps, and the certificate is for one lattice a hidden state of the losses.
"""


class Oe(OeExact):
    """The minimum mean square error estimator, with a bound on its distance to the exact one in every estimate.

    tolerance: aim of ``error_bound``, the bound on ‖x̂ − exact‖ in units of sqrt(tr P), for a run of any length; 0 in
    the estimates that are exact. max_histories: histories that are enumerated before the posterior goes to a lattice,
    by default 4096, or 512 for three states; above three, and with an actuator that holds, there is no lattice, and it
    is the limit, by default 65536.
    max_lag: how many steps late an ACK may be and still be used once its packet's fates are merged.
    """

    _name, _other = "oe", "aoe"

    def __init__(
        self,
        model: Model,
        lanes: int,
        tolerance: Annotated[float, Gt(0.0), Le(0.1)] = 1e-9,
        max_histories: Annotated[int, Ge(1)] | None = None,
        max_lag: Annotated[int, Ge(0)] = 64,
    ) -> None:
        self._lattice = model.n in ENUMERATED and not model.holds
        limit = max_histories or (ENUMERATED[model.n] if self._lattice else MAX_HISTORIES)
        self._beyond: dict[int, Lane] = {}
        super().__init__(model, lanes, limit)
        self._settings = Settings(model, self._fates, tolerance, limit, max_lag)

    def check_scenario(self, scenario: Scenario, acks: str, until: int) -> None:
        """Raises UsageError where there are too many states for a lattice and too many histories."""
        if not self._lattice:
            super().check_scenario(scenario, acks, until)

    def start_from(self, step: int, x_hat: Floats, P: Floats) -> None:
        super().start_from(step, x_hat, P)
        self._beyond = {}

    def step(self, u: Floats, y: Floats, arrived: NDArray[Any], acks: tuple[Ack, ...] = ()) -> Estimate:
        """Raises TooManyHistories only where the posterior cannot be re-expanded."""
        model = self._model
        self._learn_late(acks)
        self._advance(u, y, arrived, acks)
        mean, spread = np.empty((self._lanes, model.n)), np.zeros((self._lanes, model.n, model.n))
        self._moments(mean, spread)
        bounds = np.zeros((2, self._lanes))
        if not self._beyond:
            exact = self._estimate(mean, spread)
            return Estimate(exact.x, exact.p, self._lanes, bounds[0], bounds[1])
        P = self._estimate(mean, spread).P
        newest = [ack for ack in acks if ack.j == self._k - 1]
        for i, lane in self._beyond.items():
            push = model.B @ u[i] if model.B is not None else np.zeros(model.n)
            nu = next((int(ack.nu[i]) for ack in newest if ack.known[i]), None)
            lane.advance(push, y[i].astype(np.float64) if arrived[i] else None, nu)
            mean[i], P[i] = lane.now.posterior.moments()
            bounds[:, i] = lane.now.certificate.bounds(float(np.trace(P[i])))
        return Estimate(vector_of(mean), matrix_of(P), self._lanes, bounds[0], bounds[1])

    def _learn_late(self, acks: tuple[Ack, ...]) -> None:
        late = [ack for ack in acks if ack.j < self._k]
        for i, lane in self._beyond.items():
            fates = {ack.j: int(ack.nu[i]) for ack in late if ack.known[i]}
            missed = lane.learn(fates) if fates else 0
            if missed:
                self.counters["late_acks"] = self.counters.get("late_acks", 0) + missed

    def _overflow(self, group: Group) -> Group | None:
        if not self._lattice:
            return super()._overflow(group)
        P = matrices_of(self._p, self._lanes)
        for row, i in enumerate(group.lanes):
            means = np.stack([m[row] for m in group.means], axis=1)
            posterior = Posterior(
                step=self._k - 1,
                centre=means[0],
                basis=np.zeros((self._model.n, self._model.n)),
                nodes=np.zeros((1, self._model.n)),
                offsets=means - means[0],
                undecided=group.undecided,
                weights=group.hidden[:, row, :, None],
                scores=group.scores[row][:, None],
                covariance=P[i],
                fresh=self._k - 1 == self._first,
            )
            self._beyond[int(i)] = Lane(self._settings, posterior, P[i])
        return None

    def state(self) -> State:
        lanes, moments = [], []
        for i, lane in self._beyond.items():
            inputs, of_lane = lane.arrays()
            lanes.append({**inputs, "lane": np.array([i, len(of_lane)])})
            moments += of_lane
        return {**super().state(), **packed("lane.", lanes), **packed("moment.", moments)}

    def _take(self, state: State) -> None:
        super()._take(state)
        moments = iter(unpacked("moment.", state))
        self._beyond = {}
        for inputs in unpacked("lane.", state):
            i, count = (int(v) for v in inputs["lane"])
            self._beyond[i] = Lane.of(self._settings, inputs, [next(moments) for _ in range(count)])

    def _consistent(self) -> bool:
        return super()._consistent() and all(lane.consistent for lane in self._beyond.values())

    def _elsewhere(self) -> list[int]:
        return list(self._beyond)
