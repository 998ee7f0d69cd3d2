"""What becomes of a role that is lost: it is started anew from its last state, missed, or the run fails.

Roles give their states after every so many steps. When all states of a step are there, and the figures up to it, that
is a checkpoint: a role that is started anew begins there, and nobody keeps what was sent before.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from math import inf

from testbed.errors import TestbedError, UsageError
from testbed.estimator.service import role_of
from testbed.orchestrator.collect import Collector
from testbed.orchestrator.policies import policy_of_service
from testbed.orchestrator.roles import RoleSpec
from testbed.orchestrator.services import Services
from testbed.orchestrator.summary import Recovered
from testbed.scenario import EstimatorSpec
from testbed.scenario.recovery import Policy, role_name
from testbed.wire.begin import Begin, Given
from testbed.wire.bundle import unbundle
from testbed.wire.handover import Order
from testbed.wire.setup import Setup
from testbed.wire.state import unpack


@dataclass
class Checkpoint:
    """After ``step`` steps: the states by role and first lane."""

    step: int
    states: dict[str, dict[int, bytes]] = field(default_factory=dict)


@dataclass
class _Origin:
    """Of an estimator's service that joined on the way: after which step, and what it was told for that."""

    step: int
    orders: list[tuple[Order, bytes]]


@dataclass
class _Down:
    """A role that is lost and was started anew."""

    since_s: float
    record: Recovered


class Recovery:
    """Policies, states and restarts.

    ``launch`` starts a role again, and ends what is left of its process; it may raise a TestbedError. ``forget`` is
    called with the step of a new checkpoint. ``keep`` is given, before, what may become one, by who writes a journal,
    and answers whether that keeps it; ``stable`` says up to which step it is done. ``missed``: called with a role that
    the run goes on without.
    """

    def __init__(
        self,
        setup: Setup,
        collector: Collector,
        services: Services,
        roles: Sequence[RoleSpec],
        policies: dict[str, Policy],
    ) -> None:
        self._setup, self._collector, self._services = setup, collector, services
        self.specs = {role.name: role for role in roles}
        self.policies = policies
        self.launch: Callable[[RoleSpec], None] = _nobody
        self.missed: Callable[[str, int], None] = lambda role, last: None
        self.forget: Callable[[int], None] = lambda step: None
        self.keep: Callable[[Checkpoint], bool] = lambda checkpoint: False
        self.stable: Callable[[], float] = lambda: inf
        self.changes: Callable[[str], list[bytes]] = lambda role: []
        """The changes that a role was told of."""
        self.silent: dict[str, str] = {}
        """Roles that give no state, and why."""
        self.all_give = False
        """Whether a checkpoint is to hold the states of all roles, and not only of those that may be started anew."""
        self.happened: list[Recovered] = []
        self.down: dict[str, _Down] = {}
        self.checkpoint = Checkpoint(0)
        self._coming: dict[int, Checkpoint] = {}
        self._origins: dict[str, _Origin] = {}
        self._served: dict[str, list[Order]] = {}
        self._restarts: Counter[str] = Counter()
        self._refusals: dict[str, str] = {}
        self.rejected: Counter[str] = Counter()
        self._blocks = [lane for lane, _ in setup.blocks]

    def policy(self, role: str) -> Policy:
        return self.policies.get(role, "fail")

    def lost(self, role: str, how: str, *, started: bool) -> bool:
        """Whether the run can go on although a role is lost; what is to be done for that is done.

        started: whether the run has begun.
        """
        if role in self.down:
            return True
        policy, allowed = self.policy(role), self._setup.scenario.recovery.restarts
        step = self._collector.completed
        if policy == "continue" and started:
            name = next(n for n, turns in self._services.turns.items() if turns[-1].role == role)
            last = self._collector.abandon(name)
            self.happened.append(Recovered(role=role, how=how, step=step, policy="continue", begin=last))
            self.missed(role, last)
            return True
        if policy == "fail" or not self._may_begin(role) or self._restarts[role] >= allowed:
            return False
        self._restarts[role] += 1
        for coming in self._coming.values():  # what the new process has not done itself must not be forgotten
            coming.states.pop(role, None)
        record = Recovered(role=role, how=how, step=step, policy="restart", begin=self.begin(role, late=True).step)
        self.happened.append(record)
        self.down[role] = _Down(time.monotonic(), record)
        try:
            self.launch(self.specs[role])
        except TestbedError as error:
            del self.down[role]
            self._refusals[role] = str(error)
            return False
        return True

    def back(self, role: str) -> None:
        """A role that was started anew is there."""
        down = self.down.pop(role, None)
        if down is not None:
            waited = 1e3 * (time.monotonic() - down.since_s)
            place = self.happened.index(down.record)
            self.happened[place] = down.record.model_copy(update={"down_ms": waited})

    def _may_begin(self, role: str) -> bool:
        """Whether it is known from where a role would begin."""
        joined = role_name(role) != role
        return not joined or role in self._origins or role in self.checkpoint.states

    def reason(self, role: str) -> str:
        """Why a role that is lost ends the run, to be said behind how it was lost; nothing where that is plain."""
        if role in self._refusals:
            return f"; it could not be started anew: {self._refusals[role]}"
        times = self._restarts[role]
        return f"; it was started anew {times} time{'s' * (times != 1)} before" if times else ""

    def begin(self, role: str, *, late: bool) -> Begin:
        """Where a role begins now."""
        states, life, changes = self.checkpoint.states.get(role), self._restarts[role], tuple(self.changes(role))
        served = tuple((order, b"") for order in self._served.get(role, ()) if order.step >= self.checkpoint.step)
        if states is not None:
            return Begin(self.checkpoint.step, late, states, served, changes, life)
        origin = self._origins.get(role)
        if origin is not None:
            return Begin(origin.step, late, orders=(*origin.orders, *served), changes=changes, life=life)
        return Begin(0, late, orders=served, changes=changes, life=life)

    def taken(self, role: RoleSpec, spec: EstimatorSpec, step: int, orders: list[tuple[Order, bytes]]) -> None:
        """An estimator's service begins after a step, as it was told."""
        self._origins[role.name] = _Origin(step, orders)
        self.joined(role, spec)

    def joined(self, role: RoleSpec, spec: EstimatorSpec) -> None:
        """An estimator's service is part of the run from now on."""
        self.specs[role.name] = role
        if self.policies:
            self.policies[role.name] = policy_of_service(self._setup.scenario, role.name, spec)

    def served(self, role: str, order: Order) -> None:
        """A service was told something on its way that it is to be told again."""
        self._served.setdefault(role, []).append(order)

    def take(self, role: str, payload: bytes) -> None:
        """States that a role has given."""
        for message in unbundle(payload):
            try:
                given, data = Given.split(message)
                unpack(data)
            except UsageError:
                self.rejected["schema"] += 1
                continue
            if given.role != role or given.lane not in self._blocks:
                self.rejected["range"] += 1
                continue
            if given.step <= self.checkpoint.step or given.life != self._restarts[role]:
                continue
            coming = self._coming.setdefault(given.step, Checkpoint(given.step))
            coming.states.setdefault(role, {})[given.lane] = data
        self.proceed()

    def proceed(self) -> None:
        """Make the newest step of which everything is there the checkpoint."""
        whole = [step for step in self._coming if self._whole(step)]
        if not whole:
            return
        newest = self._coming[max(whole)]
        stable = self.stable() if self.keep(newest) else inf
        kept = max((step for step in whole if step <= stable), default=None)
        if kept is not None:
            self.checkpoint = self._coming[kept]
            self._coming = {step: coming for step, coming in self._coming.items() if step > kept}
            self.forget(kept)

    def _whole(self, step: int) -> bool:
        states = self._coming[step].states
        return step <= self._collector.completed and all(
            len(states.get(role, ())) == len(self._blocks) for role in self._givers(step)
        )

    def serving(self, step: int) -> set[str]:
        """The roles that take part in a step."""
        estimators = {self._services.role_at(name, step) for name in self._services.turns}
        return {role for role in self.specs if not role.startswith(_ESTIMATOR) or role in estimators}

    def _givers(self, step: int) -> set[str]:
        """The roles without whose states there is no checkpoint after a step."""
        serving = self.serving(step)
        if self.all_give:
            return serving - self.silent.keys()
        return {role for role in serving if self.policies.get(role) == "restart"}


_ESTIMATOR = role_of("")


def _nobody(role: RoleSpec) -> None:
    raise UsageError(f"nobody can start {role.name} anew")
