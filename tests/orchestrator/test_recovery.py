"""A role that is lost: what comes out must be what would have come out without that."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from orchestrator.runs import figures, recorded, run, scenario
from testbed.errors import UsageError
from testbed.orchestrator.collect import Collector
from testbed.orchestrator.recovery import Recovery
from testbed.orchestrator.roles import roles_of
from testbed.orchestrator.services import Services
from testbed.orchestrator.summary import Summary
from testbed.wire.begin import Given
from testbed.wire.memory_bus import MemoryNetwork
from testbed.wire.setup import Setup
from testbed.wire.state import pack

FOLLOWED = [{"name": "aoe", "acks": "none"}, {"name": "ff", "acks": "none"}]
KILLED = {"recovered", "repeated"}


def killing(*faults: tuple[int, str]) -> type[MemoryNetwork]:
    """A network on which roles are lost: (messages delivered before, role)."""

    class Killing(MemoryNetwork):
        done = 0

        def step(self) -> bool:
            for at, role in faults:
                if at == self.done:
                    for bus in [bus for bus, token in self._tokens if token.endswith(f"/presence/{role}")]:
                        bus.close()
            self.done += 1
            return super().step()

    return Killing


def without(summary: Summary) -> dict[str, Any]:
    return {key: value for key, value in figures(summary).items() if key not in KILLED}


def roles(**changes: Any) -> list[str]:
    names = [spec["name"] for spec in scenario(**changes).model_dump()["estimators"]]
    return ["controller", "plant", "link.control", "link.observation", "link.ack", "bounds"] + [
        f"estimator.{name}" for name in names
    ]


@pytest.mark.parametrize(
    "every", [pytest.param(1, marks=pytest.mark.slow), 4, pytest.param(50, marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("role", roles())
def test_a_role_that_is_lost_changes_nothing(role: str, every: int, tmp_path: Path) -> None:
    given = scenario(recovery={"every": every}, transport={"lanes_per_packet": 4}, clock={"window": 3})
    plain = run(given, tmp_path / "plain", every)
    lost = run(given, tmp_path / "lost", every, killing((400, role), (900, role)))
    assert [entry.role for entry in lost.recovered] == [role, role]
    assert lost.status == "complete"
    assert without(lost) == without(plain)
    whole, again = recorded(tmp_path / "plain", 6, 20), recorded(tmp_path / "lost", 6, 20)
    assert whole.keys() == again.keys()
    for topic, arrays in whole.items():
        for name, values in arrays.items():
            assert values.tobytes() == again[topic][name].tobytes(), (topic, name)


@pytest.mark.parametrize(
    "source",
    [
        {"kind": "feedback", "gain": [[0.6, 0.3]], "low": -2.0, "high": 2.0},
        {"kind": "lqg", "Qx": [[1.0, 0.0], [0.0, 1.0]], "Ru": [[0.5]]},
        {"kind": "pid", "kp": 0.3, "ki": 0.05, "output": [[1.0, 0.0]]},
    ],
)
@pytest.mark.parametrize("role", ["controller", "estimator.aoe", "plant", "link.control"])
def test_a_closed_loop_goes_on(source: dict[str, Any], role: str, tmp_path: Path) -> None:
    given = scenario(recovery={"every": 5}, input=source, estimators=FOLLOWED)
    plain = run(given, tmp_path / "plain")
    lost = run(given, tmp_path / "lost", 3, killing((150, role), (300, role)))
    assert len(lost.recovered) == 2
    assert without(lost) == without(plain)


def test_two_roles_at_once_and_one_that_is_just_being_started(tmp_path: Path) -> None:
    given = scenario(recovery={"every": 3})
    plain = run(given, tmp_path / "plain")
    faults = [(300, "plant"), (300, "link.observation"), (301, "estimator.ff"), (303, "plant"), (304, "link.control")]
    lost = run(given, tmp_path / "lost", 8, killing(*faults))
    assert len(lost.recovered) >= 4
    assert without(lost) == without(plain)


def test_a_role_begins_at_the_last_step_of_which_all_states_are_there(tmp_path: Path) -> None:
    lost = run(scenario(recovery={"every": 6}), tmp_path, None, killing((500, "bounds")))
    (entry,) = lost.recovered
    assert entry.begin % 6 == 0
    assert entry.step - 12 < entry.begin <= entry.step
    assert entry.begin > 0
    assert entry.text.startswith(f"bounds is gone: started anew from step {entry.begin} within ")


def test_a_run_goes_on_without_an_estimator_that_may_be_missed(tmp_path: Path) -> None:
    given = scenario(recovery={"roles": {"estimator.ff": "continue"}})
    plain = run(given, tmp_path / "plain")
    lost = run(given, tmp_path / "lost", None, killing((500, "estimator.ff")))
    (entry,) = lost.recovered
    assert (entry.policy, entry.role) == ("continue", "estimator.ff")
    last = entry.begin
    assert 0 < last < 20
    assert lost.status == "complete"
    before, after = without(plain), without(lost)
    ended, whole = after["estimators"].pop("ff"), before["estimators"].pop("ff")
    assert after["estimators"] == before["estimators"]
    assert ended["trace_P_mean"][:last] == whole["trace_P_mean"][:last]
    assert ended["trace_P_mean"][last:] == (None,) * (20 - last)
    assert f"went on without it from step {last + 1} on" in entry.text


def test_a_role_is_started_anew_only_so_often(tmp_path: Path) -> None:
    given = scenario(recovery={"every": 4, "restarts": 2})
    lost = run(given, tmp_path, None, killing(*((at, "plant") for at in range(100, 400, 50))))
    assert lost.status == "failed"
    assert lost.reason == "plant is gone; it was started anew 2 times before"


@pytest.mark.parametrize("recovery", [{"policy": "fail"}, {"roles": {"plant": "fail"}}, {"restarts": 0}])
def test_a_role_may_end_the_run(recovery: dict[str, Any], tmp_path: Path) -> None:
    lost = run(scenario(recovery=recovery), tmp_path, None, killing((100, "plant")))
    assert (lost.status, lost.reason) == ("failed", "plant is gone")
    assert lost.recovered == ()


def test_without_a_word_of_recovery_everything_in_one_process_keeps_nothing(tmp_path: Path) -> None:
    asked: list[str] = []

    class Watched(MemoryNetwork):
        def _publish(self, key: str, payload: bytes) -> None:
            asked.append(key)
            super()._publish(key, payload)

    run(scenario(), tmp_path, None, Watched)
    assert not [key for key in asked if "/state/" in key]


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        (
            {"recovery": {"roles": {"estimator.ff": "continue"}}, "input": {"kind": "feedback", "gain": [[0.6, 0.3]]}},
            "recovery.roles.estimator.ff: got 'continue'; allowed: restart, fail; the controller follows it",
        ),
        (
            {"recovery": {"roles": {"estimator.x": "restart"}}},
            "recovery.roles: got 'estimator.x'; allowed: controller, plant, link.control, link.observation, link.ack, "
            "bounds, estimator.ff",
        ),
        ({"recovery": {"roles": {"plant": "continue"}}}, "recovery.roles.plant: got 'continue'; allowed for plant: "),
        (
            {"recovery": {"roles": {"plants": "fail"}}},
            "recovery.roles: got 'plants'; allowed: controller, plant, link.control, ",
        ),
    ],
)
def test_wrong_policies_are_one_line(changes: dict[str, Any], text: str, tmp_path: Path) -> None:
    def go() -> None:
        run(scenario(estimators=[{"name": "ff", "acks": "none"}], **changes), tmp_path)

    assert text in refusal(go)


def refusal(call: Callable[[], None]) -> str:
    with pytest.raises(UsageError) as caught:
        call()
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_nobody_but_the_roles_is_told_where_to_begin(tmp_path: Path) -> None:
    """A role that the run does not have begins at the start, as one that joins later does."""
    answers: list[bytes] = []

    class Asking(MemoryNetwork):
        done = 0

        def step(self) -> bool:
            self.done += 1
            if self.done == 300:
                (key,) = [key for key in self._answers if key.endswith("/begin")]
                answers.append(self.bus().ask(key, b"nobody"))
                answers.append(self.bus().ask(key, b"\xff\xfe"))
            return super().step()

    run(scenario(recovery={"every": 2}), tmp_path, None, Asking)
    assert len(set(answers)) == 1
    assert b'"step":0,"late":false' in answers[0]


SWAPS = [
    {"at": 5, "action": "swap", "estimator": "aoe", "to": {"kind": "ff"}, "handover": "moments"},
    {"at": 6, "action": "shadow", "estimator": "ff", "name": "beside", "to": {"kind": "gpb1"}},
    {"at": 9, "action": "swap", "estimator": "ff", "to": "beside"},
    {"at": 11, "action": "add", "estimator": "late", "to": {"kind": "imm", "acks": "none"}},
    {"at": 14, "action": "swap", "estimator": "aoe", "to": {"kind": "ff"}, "handover": "full"},
    {"at": 16, "action": "remove", "estimator": "late"},
]


def killing_after(role: str, *published: int) -> type[MemoryNetwork]:
    """A network on which a role is lost each time that it has published so many messages of the loop, all told."""

    class Killing(MemoryNetwork):
        count = 0

        def _publish(self, key: str, payload: bytes) -> None:
            super()._publish(key, payload)
            if f'"source":"{role}","seq"'.encode() in payload:
                self.count += 1
                if self.count in published:
                    for bus in [bus for bus, token in self._tokens if token.endswith(f"/presence/{role}")]:
                        bus.call(bus.close)

    return Killing


@pytest.mark.parametrize("every", [2, pytest.param(7, marks=pytest.mark.slow), 50])
@pytest.mark.parametrize("role", ["estimator.aoe.2", "estimator.beside", "estimator.late", "estimator.aoe.3"])
def test_services_that_joined_on_the_way_are_recovered_too(role: str, every: int, tmp_path: Path) -> None:
    given = scenario(recovery={"every": every, "restarts": 100}, estimators=FOLLOWED, events=SWAPS)
    plain = run(given, tmp_path / "plain")
    lost = run(given, tmp_path / "lost", every, killing_after(role, 1, 4, 5, 9))
    assert all(event.ok for event in plain.events)
    assert {entry.role for entry in lost.recovered} == {role}
    assert without(lost) == without(plain)


def give(recovery: Recovery, role: str, step: int, life: int = 0, data: bytes | None = None) -> None:
    given = Given(role=role, step=step, lane=0, life=life)
    recovery.take(role, given.with_data(pack({}, step=step) if data is None else data))


def test_what_the_dead_have_given_is_no_checkpoint() -> None:
    """What a new process has not done itself may not be forgotten by those that sent it."""
    setup = Setup("run0test", scenario(lanes=1, estimators=[{"name": "ff", "acks": "none"}], recovery={"every": 5}))
    collector = Collector(setup)
    services = Services(MemoryNetwork().bus(), setup, collector, lambda line: None)
    specs = roles_of(setup.scenario)
    recovery = Recovery(setup, collector, services, specs, {spec.name: "restart" for spec in specs})
    recovery.launch = lambda role: None
    forgotten: list[int] = []
    recovery.forget = forgotten.append
    collector.completed = 12
    others = [spec.name for spec in specs if spec.name != "plant"]
    for role in others:
        give(recovery, role, 5)
        give(recovery, role, 10)
    assert recovery.lost("plant", "is gone", started=True)
    give(recovery, "plant", 5)
    give(recovery, "plant", 10)
    assert (recovery.checkpoint.step, forgotten) == (0, []), "from the process that is dead"
    give(recovery, "plant", 5, life=1)
    assert (recovery.checkpoint.step, forgotten) == (5, [5])
    assert recovery.begin("plant", late=True).life == 1
    assert recovery.lost("link.ack", "is gone", started=True)
    give(recovery, "plant", 10, life=1)
    assert forgotten == [5], "the state of 10 that link.ack gave went with it"
    give(recovery, "link.ack", 10, life=1)
    assert forgotten == [5, 10]


def test_a_step_that_is_not_complete_is_no_checkpoint() -> None:
    setup = Setup("run0test", scenario(lanes=1, estimators=[{"name": "ff", "acks": "none"}], recovery={"every": 5}))
    collector = Collector(setup)
    services = Services(MemoryNetwork().bus(), setup, collector, lambda line: None)
    specs = roles_of(setup.scenario)
    recovery = Recovery(setup, collector, services, specs, {spec.name: "restart" for spec in specs})
    collector.completed = 4
    for spec in specs:
        give(recovery, spec.name, 5)
    assert recovery.checkpoint.step == 0
    collector.completed = 5
    recovery.proceed()
    assert recovery.checkpoint.step == 5
