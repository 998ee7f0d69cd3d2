"""The conductor alone, with roles that the test plays: when it starts, what it grants, when it fails and stops."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from orchestrator.runs import scenario
from testbed.orchestrator.conductor import Conductor
from testbed.orchestrator.roles import RoleSpec
from testbed.wire.codec import PacketEncoder, encode
from testbed.wire.keys import Keys
from testbed.wire.memory_bus import MemoryBus, MemoryNetwork
from testbed.wire.messages import BoundsMessage, ClockMessage, Command, EstimateMessage, Status, Truth
from testbed.wire.node import ORCHESTRATOR, Node
from testbed.wire.setup import Setup

RUN = "run0testrun1"
KEYS = Keys(RUN)
ROLES = ["plant", "bounds", "estimator.aoe", "estimator.kfio"]


def _never(node: Node, setup: Setup) -> Any:
    raise AssertionError


class Bench:
    """A conductor, and everybody else."""

    def __init__(self, policies: dict[str, Any] | None = None, **changes: Any) -> None:
        own = {"steps": 6, "lanes": 2, "estimators": [{"name": "aoe"}, {"name": "kfio", "acks": "perfect", "until": 4}]}
        self.setup = Setup(RUN, scenario(**{**own, "clock": {"window": 2}, **changes}))
        self.network = MemoryNetwork()
        roles = [RoleSpec(role, _never, "none") for role in ROLES]
        policies = {f"estimator.{name}": policy for name, policy in (policies or {}).items()}
        self.conductor = Conductor(self.network.bus(), self.setup, roles, None, policies)
        self.started: list[int] = []
        self.conductor.on_started = lambda: self.started.append(1)
        self.grants: list[int] = []
        self.orders: list[str] = []
        listener = Node(self.network.bus(), RUN, "listener", self.setup.sizes)
        listener.on(KEYS.clock, ClockMessage, ORCHESTRATOR, lambda clock, _: self.grants.append(clock.step))
        listener.on(KEYS.command, Command, ORCHESTRATOR, lambda command, _: self.orders.append(command.action))
        self.buses: dict[str, MemoryBus] = {}
        self.numbers: dict[str, int] = {}

    def settle(self) -> None:
        self.network.run(lambda: False)

    def join(self, *roles: str) -> None:
        for role in roles:
            self.buses[role] = self.network.bus()
            self.buses[role].announce(KEYS.presence(role))
        self.settle()

    def packet(self, role: str, step: int) -> None:
        """What a role publishes for the collector."""
        ones = np.ones((2, 2))
        model, key, arrays = {
            "plant": (Truth, KEYS.truth, {"x": ones, "nu": np.ones(2, dtype=np.uint8)}),
            "bounds": (BoundsMessage, KEYS.bounds, {"trace_lower": np.ones(2), "trace_upper": np.ones(2)}),
        }.get(
            role,
            (EstimateMessage, KEYS.estimate(role.split(".")[-1]), {"x_hat": ones, "P": np.tile(np.eye(2), (2, 1, 1))}),
        )
        number = self.numbers.get(role, 0)
        self.numbers[role] = number + 1
        self.network.bus().publisher(key)(PacketEncoder(model, RUN, role).encode(number, step, 0, 2, arrays))
        self.settle()

    def step(self, k: int) -> None:
        for role in ROLES:
            if not (role == "estimator.kfio" and k > 4):
                self.packet(role, k)

    def say(self, role: str, state: Any, detail: str = "", seq: int = 0) -> None:
        status = Status(run=RUN, source=role, seq=seq, state=state, detail=detail, counters={"late_acks": 3})
        self.network.bus().publisher(KEYS.status(role))(encode(status))
        self.settle()


def test_it_starts_when_all_roles_are_there_and_not_before() -> None:
    bench = Bench()
    assert bench.conductor.awaiting() == f"roles to join: {', '.join(ROLES)}"
    bench.join("plant", "estimator.kfio", "somebody-else")
    assert bench.conductor.missing == ["bounds", "estimator.aoe"]
    assert bench.conductor.awaiting() == "roles to join: bounds, estimator.aoe"
    bench.join("bounds")
    assert (bench.started, bench.grants, bench.conductor.started) == ([], [], False)
    bench.join("estimator.aoe")
    assert (bench.started, bench.grants, bench.conductor.started) == ([1], [2], True)
    assert bench.conductor.awaiting() == "step 1: bounds, estimate of aoe, estimate of kfio, truth"


def test_steps_are_granted_as_estimates_come() -> None:
    bench = Bench()
    bench.join(*ROLES)
    for role in ("plant", "bounds", "estimator.aoe"):
        bench.packet(role, 1)
    assert bench.grants == [2]
    bench.packet("estimator.kfio", 1)
    assert bench.grants == [2, 3]
    bench.packet("estimator.kfio", 2)
    bench.packet("estimator.aoe", 2)
    assert bench.grants == [2, 3, 4]  # truth and bounds may follow
    assert bench.conductor.collector.completed == 1


def test_the_whole_run_is_granted_and_collected() -> None:
    bench = Bench()
    bench.join(*ROLES)
    for k in range(1, 7):
        assert not bench.conductor.over
        bench.step(k)
        assert bench.conductor.collector.completed == k
    assert bench.conductor.over
    assert bench.conductor.failure is None
    assert bench.grants == [2, 3, 4, 5, 6]


def test_steps_without_estimates_are_granted_when_complete() -> None:
    bench = Bench(estimators=[{"name": "aoe", "until": 2}, {"name": "kfio", "acks": "perfect", "until": 1}])
    bench.join(*ROLES)
    bench.packet("estimator.aoe", 1)
    bench.packet("estimator.kfio", 1)
    bench.packet("estimator.aoe", 2)
    assert bench.grants == [2, 3, 4]
    for k in range(1, 4):
        bench.packet("plant", k)
        assert bench.grants == [2, 3, 4] if k < 3 else [2, 3, 4, 5]
        bench.packet("bounds", k)
    assert bench.grants[-1] == 5
    for k in range(4, 7):
        bench.packet("bounds", k)
        bench.packet("plant", k)
    assert bench.conductor.over
    assert bench.grants[-1] == 6


@pytest.mark.parametrize(("window", "expected"), [(1, [1, 2, 3, 4, 5, 6]), (4, [4, 5, 6]), (6, [6]), (100, [6])])
def test_the_window_is_that_of_the_scenario(window: int, expected: list[int]) -> None:
    bench = Bench(clock={"window": window})
    bench.join(*ROLES)
    for k in range(1, 7):
        bench.step(k)
    assert bench.grants == expected


def test_a_large_window_is_granted_in_quarters() -> None:
    bench = Bench(clock={"window": 8}, steps=30)
    bench.join(*ROLES)
    for k in range(1, 31):
        bench.step(k)
    assert bench.grants == [8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30]


def test_a_role_that_goes_fails_the_run() -> None:
    for running in (False, True):
        bench = Bench()
        bench.join(*(ROLES if running else ROLES[:2]))
        bench.buses["bounds"].close()
        bench.settle()
        assert bench.conductor.failure == "bounds is gone"
        assert bench.conductor.over


def test_a_role_that_goes_after_the_order_to_stop_is_no_failure() -> None:
    bench = Bench()
    bench.join(*ROLES)
    bench.conductor.stop()
    bench.conductor.stop()
    bench.buses["bounds"].close()
    bench.settle()
    assert bench.conductor.failure is None
    assert bench.orders == ["stop"]


def test_somebody_else_who_goes_is_no_failure() -> None:
    bench = Bench()
    bench.join("somebody-else", *ROLES)
    bench.buses["somebody-else"].close()
    bench.settle()
    assert bench.conductor.failure is None


def test_a_role_that_fails_fails_the_run_and_the_first_reason_stays() -> None:
    bench = Bench()
    bench.join(*ROLES)
    bench.say("estimator.aoe", "failed", "no luck")
    bench.say("plant", "failed", "later")
    assert bench.conductor.failure == "estimator.aoe: no luck"


def test_nothing_fails_after_the_last_step() -> None:
    bench = Bench()
    bench.join(*ROLES)
    for k in range(1, 7):
        bench.step(k)
    bench.buses["plant"].close()
    bench.settle()
    assert bench.conductor.failure is None


def test_it_waits_for_the_last_words_of_those_who_are_there() -> None:
    bench = Bench()
    bench.join(*ROLES)
    assert not bench.conductor.all_reported
    for role in ROLES[:-1]:
        bench.say(role, "stopped")
    assert not bench.conductor.all_reported
    bench.conductor.stop()
    bench.buses[ROLES[-1]].close()
    bench.settle()
    assert bench.conductor.all_reported
    assert bench.conductor.reports["plant"].counters == {"late_acks": 3}


def test_anybody_may_ask_for_the_scenario() -> None:
    bench = Bench()
    setup = Setup.from_json(bench.network.bus().ask(KEYS.scenario))
    assert setup == bench.setup
    assert setup.sizes == bench.setup.sizes


def test_only_what_is_of_use_counts_as_activity() -> None:
    bench = Bench()
    bench.join(*ROLES)
    before = bench.conductor.activity
    bench.network.bus().publisher(KEYS.truth)(b"rubbish")
    bench.packet("estimator.kfio", 3)
    assert bench.conductor.activity == before
    assert bench.conductor.node.rejected == {"format": 1, "order": 1}
    bench.packet("plant", 1)
    assert bench.conductor.activity == before + 1


def test_estimates_after_the_end_of_an_estimator_are_refused() -> None:
    bench = Bench()
    bench.join(*ROLES)
    for k in range(1, 5):
        bench.step(k)
    bench.packet("estimator.kfio", 5)
    assert bench.conductor.node.rejected == {"range": 1}
    for k in (5, 6):
        bench.step(k)
    assert bench.conductor.collector.estimators["kfio"].mean["trace_P"][4:] == [None, None]


@pytest.mark.parametrize("policy", ["continue", "restart", "fail"])
def test_an_estimator_that_fails_by_itself_is_missed_or_ends_the_run(policy: str) -> None:
    """Begun anew it would fail again."""
    bench = Bench({"aoe": policy})
    bench.join(*ROLES)
    bench.step(1)
    bench.say("estimator.aoe", "failed", "ZeroDivisionError: no luck")
    bench.conductor.ended("estimator.aoe", "exit code 1")
    if policy != "continue":
        assert bench.conductor.failure == "estimator.aoe: ZeroDivisionError: no luck"
        return
    assert bench.conductor.failure is None
    (entry,) = bench.conductor.recovery.happened
    assert entry.text == ("estimator.aoe failed: ZeroDivisionError: no luck: the run went on without it from step 2 on")
    for k in range(2, 7):
        for role in ("plant", "bounds", *(["estimator.kfio"] if k <= 4 else [])):
            bench.packet(role, k)
    assert bench.conductor.collector.finished
