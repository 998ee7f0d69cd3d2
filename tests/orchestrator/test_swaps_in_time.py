"""Estimators that change in real time, by a clock that the test moves: nothing waits, is missing, or is there twice."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from orchestrator.runs import run, scenario
from orchestrator.test_swaps import determined, identical, like, published, swap
from orchestrator.wall_clock import MS, Simulated
from testbed.estimator import service
from testbed.orchestrator.summary import Summary

STEPS, LANES = 40, 6
TWO = [{"name": "aoe", "acks": "none"}, {"name": "kfio", "acks": "perfect"}]
SHADOW = {"at": 14, "action": "shadow", "estimator": "aoe", "name": "next", "to": {"kind": "imm"}}
TIMELINE = [
    {"at": 1, "action": "add", "estimator": "first", "to": {"kind": "ff", "acks": "none"}},
    swap(8, "aoe", {"kind": "gpb", "order": 2}, "cold"),
    swap(9, "kfio", like(TWO[1]), "full"),
    SHADOW,
    swap(20, "aoe", {"kind": "aoe"}, "moments"),
    {"at": 21, "action": "remove", "estimator": "first"},
    swap(32, "aoe", "next"),
]


def real(**changes: Any) -> Any:
    clock = {"mode": "real", "period": "10 ms", **changes.pop("clock", {})}
    return scenario(**{"steps": STEPS, "estimators": TWO, "bounds": False, **changes, "clock": clock})


def virtual(**changes: Any) -> Any:
    return scenario(**{"steps": STEPS, "estimators": TWO, "bounds": False, **changes, "clock": {"period": "10 ms"}})


def same(one: Summary, other: Summary) -> bool:
    return {**determined(one), "realtime": None} == {**determined(other), "realtime": None}


def once_each(folder: Path, summary: Summary) -> bool:
    expected = {
        (name, k, lane): 1
        for name, f in summary.estimators.items()
        for k in range(f.since, (f.until or STEPS) + 1)
        for lane in range(LANES)
    }
    return published(folder) == expected


@pytest.mark.parametrize("seed", [None, 3, 4])
@pytest.mark.parametrize("split", [{}, {"transport": {"lanes_per_packet": 4}}])
def test_a_timeline_in_real_time_is_that_of_virtual_time(split: Any, seed: int | None, tmp_path: Path) -> None:
    there = run(real(events=TIMELINE, **split), tmp_path / "real", seed, network=Simulated)
    then = run(virtual(events=TIMELINE, **split), tmp_path / "virtual")
    assert (there.status, there.rejected) == ("complete", {})
    assert [(e.step, e.ok) for e in there.events] == [(k, True) for k in (1, 8, 9, 14, 20, 21, 32)]
    assert [e.bytes for e in there.events] == [e.bytes for e in then.events]
    assert same(there, then)
    assert once_each(tmp_path / "real", there)
    assert there.realtime is not None
    assert there.realtime.missed == 0
    stages = there.realtime.stages
    assert {topic: stage.published.max for topic, stage in stages.items()} == dict.fromkeys(stages, 0.0)
    assert stages["estimate/next"].published_us == (None,) * 13 + (0.0,) * 18 + (None,) * 9
    assert stages["estimate/aoe"].role == "estimator.next"
    assert [(d.step, d.ms, d.late_ms, d.missed) for d in there.timing.swaps] == [
        (k, 0.0, 0.0, 0) for k in (1, 8, 9, 14, 20, 32)
    ]


@pytest.mark.parametrize("input_", [None, {"kind": "feedback", "gain": [[0.3, 0.1]], "estimator": "aoe"}])
def test_a_swap_for_an_identical_one_changes_no_bit(input_: Any, tmp_path: Path) -> None:
    changes = {} if input_ is None else {"input": input_}
    plain = run(real(**changes), tmp_path / "plain", network=Simulated)
    for seed in (None, 1, 2):
        events = identical(TWO, (1, 9, 30))
        swapped = run(real(**changes, events=events), tmp_path / str(seed), seed, network=Simulated)
        assert [event.ok for event in swapped.events] == [True] * 6
        assert same(plain, swapped)
        assert once_each(tmp_path / str(seed), swapped)


class Slow(Simulated):
    """The state that is handed over takes 25 ms."""

    def before(self, key: str, number: int) -> bool:
        if key == "handover/estimator.aoe.2/state":
            self.timers.at(self.clock.now_ns + 25 * MS, self.release)
            return False
        return True


def test_what_is_late_is_late_and_not_lost(tmp_path: Path) -> None:
    events = [swap(9, "aoe", {"kind": "gpb", "order": 2})]
    there = run(real(events=events), tmp_path / "real", network=Slow)
    then = run(virtual(events=events), tmp_path / "virtual")
    assert same(there, then)
    assert once_each(tmp_path / "real", there)
    assert there.realtime is not None
    # handed over at 70 ms, when step 8 was done, and there at 95 ms; step 9 was due at 80, step 10 at 90, 11 at 100
    assert there.realtime.stages["estimate/aoe"].published_us[7:12] == (0.0, 15_000.0, 5_000.0, 0.0, 0.0)
    (down,) = there.timing.swaps
    assert (down.step, down.steps, down.ms, down.late_ms, down.missed) == (9, 0, 0.0, 15.0, 1)


class TestFailures:
    """The old one stays in charge, and every figure is that of the run without the change."""

    def check(self, folder: Path, reason: str, network: type[Simulated] = Simulated) -> Summary:
        failed: Summary | None = None
        for seed in (None, 1):
            for action in ("swap", "shadow"):
                first = swap(9, "aoe", {"kind": "gpb", "order": 2}, "moments")
                if action == "shadow":
                    first |= {"action": "shadow", "name": "beside"}
                events = [first, swap(25, "kfio", like(TWO[1]), "full")]
                out = folder / f"{action}-{seed}"
                failed = run(real(events=events), out, seed, network=network)
                happened = failed.events[0]
                assert (happened.ok, happened.step, happened.bytes) == (False, 9, None)
                assert reason in (happened.reason or "")
                assert failed.events[1].ok
                assert (failed.status, failed.rejected) == ("complete", {})
                assert same(failed, run(real(), folder / "plain", network=Simulated))
                assert set(published(out).values()) == {1}
        assert failed is not None
        return failed

    def test_it_does_not_start(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        made = service.create

        def spoilt(kind: str, *arguments: Any, **options: Any) -> Any:
            if kind == "gpb":
                raise ZeroDivisionError("no luck")
            return made(kind, *arguments, **options)

        monkeypatch.setattr(service, "create", spoilt)
        self.check(tmp_path, "ZeroDivisionError: no luck")

    def test_it_refuses_the_state(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        from testbed.estimator.gpb import Gpb

        def refuse(self: Gpb, step: int, *arguments: Any) -> None:
            if step > 0 and self.__dict__.get("order") != 0:
                raise ValueError("not this one")

        from testbed.orchestrator import preflight

        monkeypatch.setattr(preflight, "check_change", lambda *_: None)
        monkeypatch.setattr(Gpb, "start_from", refuse)
        self.check(tmp_path, "ValueError: not this one")

    def test_it_is_lost_before_it_has_begun(self, tmp_path: Path) -> None:
        """Its bus closes when the state is on its way; what the old one has done since comes late, and once."""

        class Lost(Simulated):
            def before(self, key: str, number: int) -> bool:
                role = key.removesuffix("/state").removeprefix("handover/")
                if key.startswith("handover/") and key.endswith("/state") and role.endswith(("aoe.2", "beside")):
                    self.timers.at(self.clock.now_ns + 15 * MS, lambda: self.close(role))
                    return False
                return True

            def close(self, role: str) -> None:
                for bus, key in list(self._tokens):
                    if key.endswith(f"presence/{role}"):
                        bus.close()

        summary = self.check(tmp_path, "is gone", Lost)
        assert summary.realtime is not None


class Commanded(Simulated):
    """Somebody asks for changes when the truth of steps 10, 11, … is there."""

    asked: tuple[dict[str, Any], ...] = (
        {"action": "swap", "estimator": "aoe", "to": like(TWO[0]), "handover": "full"},
        {"action": "shadow", "estimator": "kfio", "name": "s", "to": like(TWO[1]), "handover": "full"},
        {"action": "swap", "estimator": "kfio", "to": "s"},
    )
    answers: list[dict[str, Any]]

    def before(self, key: str, number: int) -> bool:
        if key == "truth" and 0 <= number - 9 < len(self.asked):
            ask = next(k for k in self._answers if k.endswith("/ask"))
            if number == 9:
                type(self).answers = []
            answer = self._answers[ask][1](json.dumps({"event": self.asked[number - 9]}).encode())
            self.answers.append(json.loads(answer))
        return True


def test_by_command_a_change_is_made_as_soon_as_all_can_know(tmp_path: Path) -> None:
    summary = run(real(steps=100), tmp_path / "changed", network=Commanded)
    assert Commanded.answers == [{"number": 0}, {"number": 1}, {"number": 2}]
    assert [(e.action, e.ok) for e in summary.events] == [("swap", True), ("shadow", True), ("swap", True)]
    first, second, third = (e.step for e in summary.events)
    assert (first, second) == (10 + 6, 11 + 6)  # 50 ms after the step that is due
    assert second + 5 <= third <= second + 7
    assert set(published(tmp_path / "changed").values()) == {1}
    plain = run(real(steps=100), tmp_path / "plain", network=Simulated)
    for name in ("aoe", "kfio"):
        assert plain.estimators[name] == summary.estimators[name]


def losing(role: str, place: int) -> type[Simulated]:
    """A network on which a role is lost when the truth of step ``place`` + 1 is there."""

    class Losing(Simulated):
        def before(self, key: str, number: int) -> bool:
            if key == "truth" and number == place:
                self.timers.at(self.clock.now_ns, self.close)
            return True

        def close(self) -> None:
            for bus, token in list(self._tokens):
                if token.endswith(f"presence/{role}"):
                    bus.close()

    return Losing


def as_it_was(summary: Summary) -> list[dict[str, Any]]:
    steps = {event.number: event.step for event in summary.events}
    return [event | {"at": steps[number]} for number, event in enumerate(TIMELINE)]


@pytest.mark.parametrize("place", [8, 13, 19])
@pytest.mark.parametrize("role", ["aoe", "aoe.2", "next"])
def test_services_that_are_lost_around_changes_come_back(role: str, place: int, tmp_path: Path) -> None:
    given = {"recovery": {"every": 4, "restarts": 100}, "transport": {"lanes_per_packet": 4}}
    there = run(real(events=TIMELINE, **given), tmp_path / "real", place, losing(f"estimator.{role}", place))
    assert (there.status, there.rejected) == ("complete", {})
    if all(event.ok for event in there.events):
        then = run(virtual(events=as_it_was(there), **given), tmp_path / "virtual")
        assert figures(there) == figures(then)
    print(
        "PUT",
        [(e.step, e.due) for e in there.events if e.due],
        [e.reason for e in there.events if not e.ok],
        [r.step for r in there.recovered],
    )
    assert once_each(tmp_path / "real", there)


def figures(summary: Summary) -> Any:
    return {name: value.model_dump() for name, value in summary.estimators.items()}
