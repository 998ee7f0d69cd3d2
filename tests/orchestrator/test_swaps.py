"""Estimators that change while a run goes: nothing is lost, nothing is doubled, and what is handed over is exact."""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from orchestrator.commanding import commanded
from orchestrator.runs import SYSTEM, figures, recorded, run, scenario
from testbed.errors import UsageError
from testbed.estimator import service
from testbed.estimator.registry import create, kinds, model_of
from testbed.numerics.lanes import Floats
from testbed.orchestrator.conductor import Conductor
from testbed.orchestrator.recording import read_recording
from testbed.orchestrator.summary import EstimatorFigures, Summary
from testbed.orchestrator.transient import transient
from testbed.scenario import Scenario, parse_scenario, to_toml

STEPS, LANES = 20, 6
KINDS: dict[str, dict[str, Any]] = {
    "gpb": {"order": 2},
    "pf": {"particles": 8},
    "kfio": {"acks": "perfect"},
    "rseio": {"acks": "perfect"},
    "kf": {"acks": "perfect"},
    "oe": {"until": 12},
    "oe-exact": {"until": 9},
}
LATE = {
    "control": {"loss": {"kind": "bernoulli", "arrival": 0.7}},
    "observation": {
        "loss": {"kind": "bernoulli", "arrival": 0.8},
        "delay": {"kind": "uniform", "low": "0 s", "high": "35 ms"},
    },
    "ack": {"mode": "link", "delay": {"kind": "uniform", "low": "0 s", "high": "30 ms"}},
}


def swap(at: int, estimator: str, to: str | dict[str, Any], handover: str | None = None) -> dict[str, Any]:
    event = {"at": at, "action": "swap", "estimator": estimator, "to": to if isinstance(to, str) else dict(to)}
    return event if handover is None else {**event, "handover": handover}


def like(spec: dict[str, Any]) -> dict[str, Any]:
    """The table of the same estimator without its name."""
    return {"kind": spec.get("kind", spec["name"]), **{k: v for k, v in spec.items() if k not in ("name", "kind")}}


def identical(specs: list[dict[str, Any]], steps: tuple[int, ...]) -> list[dict[str, Any]]:
    """Each estimator swapped for one like it, with all it knows."""
    return [swap(at, spec["name"], like(spec), "full") for spec in specs for at in steps]


def determined(summary: Summary) -> dict[str, Any]:
    return {key: value for key, value in figures(summary).items() if key != "events"}


def estimates(folder: Path, name: str, steps: int = STEPS, lanes: int = LANES) -> tuple[Floats, Floats]:
    found = recorded(folder, lanes, steps)[f"estimate/{name}"]
    return found["x_hat"], found["P"]


def published(folder: Path) -> Counter[tuple[str, int, int]]:
    """How often there is an estimate of a name, a step and a lane."""
    found: Counter[tuple[str, int, int]] = Counter()
    for topic, packet, _ in read_recording(folder / "recording.mcap"):
        if topic.startswith("estimate/"):
            found.update((topic[9:], packet.step, packet.lane + row) for row in range(packet.lanes))
    return found


def able(**changes: Any) -> list[dict[str, Any]]:
    """Every built-in kind that can run in that scenario."""
    from testbed.orchestrator.preflight import check_parts

    out = []
    for kind in kinds():
        spec = {"name": kind, "acks": "none", **KINDS.get(kind, {})}
        try:
            check_parts(scenario(**{**changes, "estimators": [spec]}))
        except UsageError:
            continue
        out.append(spec)
    return out


@pytest.mark.parametrize("case", ["in time", "late", "split", "schedule"])
def test_a_swap_for_an_identical_one_changes_no_bit(case: str, tmp_path: Path) -> None:
    changes: dict[str, Any] = {"links": LATE} if case == "late" else {}
    specs = able(**changes)
    assert {"aoe", "gpb", "imm", "kfio", "oe", "pf"} <= {spec["name"] for spec in specs}
    if case == "late":
        specs += [{"name": "acked", "kind": "aoe"}, {"name": "short", "kind": "gpb", "order": 1, "buffer": 2}]
    common = {"estimators": specs, **changes}
    plain = run(scenario(**common), tmp_path / "plain")
    split = {"transport": {"lanes_per_packet": 4}} if case in ("split", "schedule") else {}
    events = identical(specs, (1, 5, 9))
    swapped = run(scenario(**common, **split, events=events), tmp_path / "swapped", 5 if case == "schedule" else None)
    assert (plain.status, swapped.status, len(swapped.events)) == ("complete", "complete", 3 * len(specs))
    assert all(event.ok for event in swapped.events), swapped.events
    assert determined(plain) == determined(swapped)
    for spec in specs:
        for before, after in zip(
            estimates(tmp_path / "plain", spec["name"]), estimates(tmp_path / "swapped", spec["name"]), strict=True
        ):
            np.testing.assert_array_equal(before, after)
    if case == "late":
        assert swapped.estimators["aoe"].counters["late_observations"] > 0
        assert swapped.estimators["acked"].counters["refiltered"] > 0
    assert all(event.bytes for event in swapped.events)
    assert published(tmp_path / "plain") == published(tmp_path / "swapped")


def test_a_controller_follows_the_estimator_across_its_swaps(tmp_path: Path) -> None:
    specs = [{"name": "aoe", "acks": "none"}, {"name": "kfio", "acks": "perfect"}]
    common = {"estimators": specs, "input": {"kind": "feedback", "gain": [[0.3, 0.1]], "estimator": "aoe"}}
    split = {"transport": {"lanes_per_packet": 2}}
    plain = run(scenario(**common, **split), tmp_path / "plain")
    for i, schedule in enumerate((None, 3)):
        events = identical(specs, (2, 3, 11))
        swapped = run(scenario(**common, **split, events=events), tmp_path / str(i), schedule)
        assert determined(plain) == determined(swapped)
    other = run(scenario(**common, events=[swap(8, "aoe", {"kind": "gpb", "order": 1})]), tmp_path / "other")
    before, after = plain.estimators["kfio"].squared_error_mean, other.estimators["kfio"].squared_error_mean
    assert other.status == "complete"
    assert before[:8] == after[:8]


@pytest.mark.parametrize("handover", ["moments", "cold"])
def test_what_the_new_one_starts_from(handover: str, tmp_path: Path) -> None:
    """It does what an estimator does that is given these moments and then the packets from its step on."""
    at, new = 8, {"kind": "gpb", "order": 2, "acks": "none"}
    given_scenario = scenario(
        estimators=[{"name": "aoe", "acks": "none"}], events=[swap(at, "aoe", new, handover)], links={}
    )
    summary = run(given_scenario, tmp_path)
    (event,) = summary.events
    assert (event.ok, event.step, event.handover, bool(event.bytes)) == (True, at, handover, handover == "moments")
    model, packets = model_of(given_scenario), recorded(tmp_path, LANES, STEPS)
    x_hat, P = estimates(tmp_path, "aoe")
    alone: Any = create("gpb", model, lanes=LANES, options={"order": 2})
    if handover == "moments":
        alone.start_from(at - 1, x_hat[at - 2], P[at - 2])
    else:
        alone.start_from(at - 1, np.tile(SYSTEM["x0_mean"], (LANES, 1)), np.tile(SYSTEM["P0"], (LANES, 1, 1)))
    for k in range(at, STEPS + 1):
        u, y = packets["control/sent"]["u"][k - 1], packets["observation/delivered"]["y"][k - 1]
        expected = alone.step(u, y, packets["observation/delivered"]["mask"][k - 1].astype(np.uint8))
        np.testing.assert_array_equal(x_hat[k - 1], expected.x_hat)
        np.testing.assert_array_equal(P[k - 1], expected.P)


def test_what_was_late_for_the_old_one_is_counted_where_it_is_lost(tmp_path: Path) -> None:
    spec = {"name": "kfio", "acks": "perfect"}
    common = {"estimators": [spec], "links": {**LATE, "ack": {"mode": "none"}}}
    plain = run(scenario(**common), tmp_path / "a").estimators["kfio"].counters
    events = [swap(10, "kfio", like(spec), "moments")]
    swapped = run(scenario(**common, events=events), tmp_path / "b").estimators["kfio"].counters
    assert plain.get("old_observations", 0) == 0
    assert swapped["old_observations"] > 0
    assert swapped["old_observations"] + swapped["late_observations"] == plain["late_observations"]


def test_a_shadow_runs_beside_and_is_promoted(tmp_path: Path) -> None:
    specs = [{"name": "aoe", "acks": "none"}, {"name": "ff", "acks": "none"}]
    shadow = {"at": 5, "action": "shadow", "estimator": "aoe", "name": "next", "to": {"kind": "aoe"}}
    events = [{**shadow, "handover": "full"}, swap(12, "aoe", "next")]
    plain = run(scenario(estimators=specs), tmp_path / "plain")
    for schedule in (None, 11):
        folder = tmp_path / str(schedule)
        split = {"transport": {"lanes_per_packet": 4}} if schedule else {}
        promoted = run(scenario(estimators=specs, events=events, **split), folder, schedule)
        assert [(e.step, e.action, e.ok, e.to) for e in promoted.events] == [
            (5, "shadow", True, {"kind": "aoe"}),
            (12, "swap", True, "next"),
        ]
        own, beside = promoted.estimators["aoe"], promoted.estimators["next"]
        assert (own.since, own.until, beside.since, beside.until) == (1, None, 5, 11)
        assert own.trace_P_mean == plain.estimators["aoe"].trace_P_mean
        assert own.squared_error_mean == plain.estimators["aoe"].squared_error_mean
        assert beside.nees_mean == (None,) * 4 + own.nees_mean[4:11] + (None,) * 9
        times = published(folder)
        assert set(times.values()) == {1}
        assert {k for name, k, _ in times if name == "next"} == set(range(5, 12))
        assert {k for name, k, _ in times if name == "aoe"} == set(range(1, STEPS + 1))


def test_estimators_are_added_and_removed(tmp_path: Path) -> None:
    specs = [{"name": "aoe", "acks": "none"}, {"name": "ff", "acks": "none"}]
    events = [
        {"at": 4, "action": "add", "estimator": "further", "to": {"kind": "aoe", "acks": "none", "until": 17}},
        {"at": 9, "action": "remove", "estimator": "ff"},
        swap(15, "aoe", {"kind": "gpb", "order": 2}),
        {"at": 1, "action": "add", "estimator": "first", "to": {"kind": "aoe", "acks": "none"}},
    ]
    summary = run(scenario(estimators=specs, events=events), tmp_path)
    assert (summary.status, [e.step for e in summary.events if e.ok]) == ("complete", [1, 4, 9, 15])
    ran = {name: (f.since, f.until) for name, f in summary.estimators.items()}
    assert ran == {"aoe": (1, None), "ff": (1, 8), "first": (1, None), "further": (4, 17)}
    for name, (since, until) in ran.items():
        there = [k for k, mean in enumerate(summary.estimators[name].trace_P_mean, 1) if mean is not None]
        assert there == list(range(since, (until or STEPS) + 1))
    assert set(published(tmp_path).values()) == {1}
    assert summary.estimators["first"].trace_P_mean[:14] == summary.estimators["aoe"].trace_P_mean[:14]


def test_all_estimators_may_leave(tmp_path: Path) -> None:
    events = [{"at": 7, "action": "remove", "estimator": "aoe"}]
    summary = run(scenario(estimators=[{"name": "aoe", "acks": "none"}], events=events), tmp_path)
    assert (summary.status, summary.completed_steps, summary.estimators["aoe"].until) == ("complete", STEPS, 6)


@settings(deadline=None, max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_random_timelines_lose_nothing(data: st.DataObject, tmp_path: Path) -> None:
    """Whatever changes when: each step has one estimate of each name that is there, and the run is the same twice."""
    steps = 12
    forms = st.sampled_from(["cold", "moments", None])
    to = st.sampled_from([{"kind": "aoe"}, {"kind": "gpb", "order": 1}, {"kind": "ff"}, {"kind": "imm"}])
    events: list[dict[str, Any]] = []
    at = 0
    for number in range(data.draw(st.integers(1, 5))):
        at = data.draw(st.integers(at + 1, at + 3))
        if at > steps - 1:
            break
        event = swap(at, data.draw(st.sampled_from(["a", "b"])), data.draw(to), data.draw(forms))
        if data.draw(st.booleans()):
            event = {**event, "action": "shadow", "name": f"s{number}"}
        events.append(event)
        if event["action"] == "shadow" and at < steps and data.draw(st.booleans()):
            events.append(swap(at + 1, event["estimator"], event["name"]))
            at += 1
    specs = [{"name": "a", "kind": "aoe", "acks": "none"}, {"name": "b", "kind": "ff", "acks": "none"}]
    common = {"steps": steps, "estimators": specs, "events": events}
    first = run(scenario(**common, transport={"lanes_per_packet": 4}), tmp_path / "a", data.draw(st.integers(0, 99)))
    again = run(scenario(**common), tmp_path / "b")
    assert (first.status, first.rejected) == ("complete", {})
    assert [event.ok for event in first.events] == [True] * len(events)
    strip = {"bytes", "number"}
    assert determined(first) == determined(again)
    assert [e.model_dump(exclude=strip) for e in first.events] == [e.model_dump(exclude=strip) for e in again.events]
    expected = {
        (name, k, lane): 1
        for name, f in first.estimators.items()
        for k in range(f.since, (f.until or steps) + 1)
        for lane in range(LANES)
    }
    assert published(tmp_path / "a") == expected


def test_an_order_to_wait_costs_no_step(tmp_path: Path) -> None:
    summary = run(scenario(events=[swap(6, "aoe", {"kind": "imm"})]), tmp_path)
    (down,) = summary.timing.swaps
    assert (down.step, down.estimator, down.steps) == (6, "aoe", 0)


class TestFailures:
    """The old one stays in charge, and the run is the one without the swap."""

    def check(self, folder: Path, reason: str, **changes: Any) -> None:
        specs = [{"name": "aoe", "acks": "none"}, {"name": "kfio", "acks": "perfect"}]
        events = [swap(6, "aoe", {"kind": "gpb", "order": 2}), swap(9, "kfio", {"kind": "kfio"}, "full")]
        failed = run(scenario(estimators=specs, events=events, **changes), folder / "failed")
        happened = failed.events[0]
        assert (happened.ok, happened.step, happened.bytes) == (False, 6, None)
        assert happened.reason is not None
        assert reason in happened.reason
        assert failed.events[1].ok
        assert (failed.status, failed.rejected) == ("complete", {})
        plain = run(scenario(estimators=specs, **changes), folder / "plain")
        assert determined(plain) == determined(failed)

    def test_it_does_not_start(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        made = service.create

        def spoilt(kind: str, *arguments: Any, **options: Any) -> Any:
            if kind == "gpb":
                raise ZeroDivisionError("no luck")
            return made(kind, *arguments, **options)

        monkeypatch.setattr(service, "create", spoilt)
        self.check(tmp_path, "ZeroDivisionError: no luck")

    @pytest.mark.parametrize("lane", [0, 4])
    def test_it_refuses_a_state(self, lane: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        from testbed.estimator.gpb import Gpb

        given_from, seen = Gpb.start_from, []

        def refuse(self: Gpb, *arguments: Any) -> None:
            seen.append(1)
            if len(seen) == (2 if lane else 1) + 1:  # the first is made before anything starts
                raise ValueError("not with me")
            given_from(self, *arguments)

        monkeypatch.setattr(Gpb, "start_from", refuse)
        self.check(tmp_path, "ValueError: not with me", transport={"lanes_per_packet": 4})

    def test_the_old_one_gives_none(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        made = service.give

        def give(refilter: Any, form: str, **rest: Any) -> bytes:
            data = made(refilter, form, **rest)  # type: ignore[arg-type]
            return data if form == "full" else data[:-1] + bytes([data[-1] ^ 1])

        monkeypatch.setattr(service, "give", give)
        self.check(tmp_path, "snapshot: damaged")


def test_one_that_does_not_join_in_time_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody starts it; when its time is over, the clock goes on without it."""

    class Impatient(Conductor):
        waited = False

        def fail(self, reason: str) -> None:
            if not self.waited and "nothing moves any more" in reason:
                self.waited = True
                assert "a service of aoe to join" in reason
                self.services.launch = lambda role: None
                time.sleep(0.002)
                self.tick(0.001)
                self.ended("estimator.aoe.2", "killed by SIGKILL")
                return
            super().fail(reason)

    monkeypatch.setattr("testbed.orchestrator.run.Conductor", Impatient)
    monkeypatch.setattr("testbed.orchestrator.services.builder", lambda *_: lambda *_: Silent())
    monkeypatch.setattr("testbed.wire.node.Node.announce", announce_unless_second)
    specs = [{"name": "aoe", "acks": "none"}]
    summary = run(scenario(estimators=specs, events=[swap(6, "aoe", {"kind": "imm"})]), tmp_path)
    (event,) = summary.events
    assert (summary.status, event.ok, event.step) == ("complete", False, 6)
    assert event.reason == "estimator.aoe.2 did not join within 0.001 s"


class Silent:
    counters: dict[str, int] = {}  # noqa: RUF012


def announce_unless_second(self: Any) -> None:
    if self.name != "estimator.aoe.2":
        self.bus.announce(self.keys.presence(self.name))


def test_what_builds_on_a_change_that_was_refused_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = service.create

    def spoilt(kind: str, *arguments: Any, **options: Any) -> Any:
        if kind == "imm":
            raise ValueError("no luck")
        return made(kind, *arguments, **options)

    monkeypatch.setattr(service, "create", spoilt)
    shadow = {"at": 5, "action": "shadow", "estimator": "aoe", "name": "next", "to": {"kind": "imm"}}
    events = [shadow, swap(8, "aoe", "next"), swap(10, "aoe", {"kind": "ff"})]
    summary = run(scenario(estimators=[{"name": "aoe", "acks": "none"}], events=events), tmp_path)
    assert [event.ok for event in summary.events] == [False, False, True]
    assert summary.events[1].reason == "there is no estimator 'next'"
    assert (summary.status, list(summary.estimators)) == ("complete", ["aoe"])


def test_by_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plain, _ = commanded(tmp_path / "plain", monkeypatch, {})
    event = {"action": "swap", "estimator": "aoe", "to": {"kind": "aoe"}, "handover": "full"}
    shadow = {"action": "shadow", "estimator": "ff", "name": "beside", "to": {"kind": "imm"}}
    summary, answers = commanded(
        tmp_path / "swapped",
        monkeypatch,
        {
            5: {"event": event},
            8: {"event": shadow},
            11: {"do": "status"},
            13: {"event": {**event, "to": {"kind": "x"}}},
        },
    )
    assert [a.get("number") for a in answers] == [0, 1, None, None]
    assert answers[2]["estimators"]["aoe"] == {"role": "estimator.aoe.2", "kind": "aoe"}
    assert (answers[2]["completed"], answers[2]["steps"], answers[2]["pending"]) == (11, STEPS, [])
    assert [event["step"] for event in answers[2]["events"]] == [event.step for event in summary.events]
    assert answers[3]["error"].startswith("swap of 'aoe' at step")
    assert [(e.by, e.ok, e.action) for e in summary.events] == [("command", True, a) for a in ("swap", "shadow")]
    assert 6 <= summary.events[0].step <= 12
    assert summary.estimators["beside"].since == summary.events[1].step
    assert plain.estimators["aoe"] == summary.estimators["aoe"]
    assert set(published(tmp_path / "swapped").values()) == {1}


def test_a_run_is_stopped_by_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    summary, answers = commanded(tmp_path, monkeypatch, {7: {"do": "stop"}})
    assert (summary.status, summary.reason) == ("interrupted", "stopped by command")
    assert 7 <= summary.completed_steps < STEPS
    assert answers[0]["completed"] == 7


@pytest.mark.parametrize(
    ("event", "problem"),
    [
        ({"action": "swap", "estimator": "aeo", "to": {"kind": "ff"}}, "got 'aeo'; allowed at step"),
        ({"action": "swap", "estimator": "aoe", "to": {"kind": "fff"}}, "unknown estimator 'fff'; allowed: aoe"),
        ({"action": "swop", "estimator": "aoe"}, "action: got 'swop'; allowed: set, swap, add, shadow, remove, acks,"),
        ({"action": "swap", "estimator": "aoe", "to": {"kind": "ff"}, "handover": "full"}, "which do not share the"),
        ({"action": "set", "link": "control", "set": {}}, "set: got a table; allowed: a table with keys of the link"),
        ({"action": "mark", "name": "x", "at": 2}, "at: got 2; allowed: "),
        ({"action": "heal"}, "got all, and none is cut then; allowed: none"),
        ({"action": "kill", "role": "plnt"}, "role: got 'plnt'; allowed: controller, plant, link.control, "),
        ({"action": "mark", "name": "x", "when": "loss_rate(control) > 0"}, "when: got loss_rate(control); allowed: "),
        ({"action": "add", "estimator": "aoe", "to": {"kind": "ff"}}, "got 'aoe' a second time; allowed: a name of"),
    ],
)
def test_a_command_that_does_not_fit_is_refused(
    event: dict[str, Any], problem: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    summary, answers = commanded(tmp_path, monkeypatch, {4: {"event": event}}, record="none")
    assert problem in answers[0]["error"]
    assert (summary.status, summary.events) == ("complete", ())


REMOVE = {"at": 5, "action": "remove", "estimator": "aoe"}
SHADOW = {"at": 5, "action": "shadow", "estimator": "aoe", "name": "next", "to": {"kind": "ff"}}


@pytest.mark.parametrize(
    ("events", "problem"),
    [
        (
            [swap(5, "aeo", {"kind": "ff"})],
            "events[0].estimator: got 'aeo'; allowed at step 5: aoe, aoe-acks, ff, kfio",
        ),
        ([swap(5, "aoe", {"order": 3})], "events[0].to.kind: missing; needed: Which estimator it is"),
        ([swap(5, "aoe", "aoe")], "events[0].to: got 'aoe', the estimator itself; allowed: another one that runs"),
        ([swap(5, "aoe", "next")], "events[0].to: got 'next'; allowed at step 5: aoe, "),
        (
            [{**swap(5, "aoe", "ff"), "to": 3}],
            "events[0].to: got 3; allowed: a table with the kind of the new estimator",
        ),
        (
            [swap(5, "aoe", {"kind": "ff"}, "ful")],
            "events[0].handover: got 'ful'; allowed: cold, moments, full; did you",
        ),
        ([swap(5, "aoe", "ff", "cold")], "events[0].handover: got 'cold'; allowed: none, for 'ff' has a state"),
        ([swap(0, "aoe", {"kind": "ff"})], "events[0].at: got 0; allowed: a step 1 … 20, those of the scenario"),
        ([swap(21, "aoe", {"kind": "ff"})], "events[0].at: got 21; allowed: a step 1 … 20, those of the scenario"),
        (
            [swap(9, "oe", {"kind": "ff"})],
            "events[0].estimator: got 'oe', which ends at step 7; allowed: one that runs",
        ),
        ([swap(9, "aoe", {"kind": "ff", "until": 8})], "events[0].to.until: got 8; allowed: 9 … 20"),
        ([REMOVE, swap(6, "aoe", {"kind": "ff"})], "events[1].estimator: got 'aoe'; allowed at step 6: aoe-acks, ff"),
        ([REMOVE, swap(5, "aoe", {"kind": "ff"})], "events[1].estimator: got 'aoe'; allowed at step 5: aoe-acks, ff"),
        ([swap(5, "aoe", "ff"), swap(5, "aoe", "kfio")], "events[1].estimator: got 'aoe' a second time at step 5"),
        ([SHADOW, {**SHADOW, "at": 7}], "events[1].name: got 'next' a second time; allowed: a name of its own"),
        ([{**SHADOW, "nam": 1}], "events[0]: unknown key 'nam'; did you mean 'name'?"),
        ([{"at": 5, "estimator": "aoe"}], "events[0].action: missing; allowed: set, swap, add, shadow, remove"),
        ([swap(5, "aoe", {"kind": "ff", "acks": "no"})], "events[0].to.acks: got 'no'; allowed: none, perfect"),
    ],
)
def test_wrong_events_are_one_line(events: list[dict[str, Any]], problem: str) -> None:
    with pytest.raises(UsageError) as refusal:
        scenario(events=events)
    assert str(refusal.value).startswith(f"scenario: {problem}")


def test_the_estimator_of_a_closed_loop_stays() -> None:
    loop = {"input": {"kind": "feedback", "gain": [[0.3, 0.1]], "estimator": "aoe"}}
    for event, problem in (
        (REMOVE, "events[0].estimator: got 'aoe', which the controller follows; allowed: another estimator"),
        (swap(5, "ff", "aoe"), "events[0].to: got 'aoe', which the controller follows; allowed: another estimator"),
        (swap(5, "aoe", {"kind": "ff", "until": 9}), "events[0].to.until: got 9; allowed: none, for the controller"),
    ):
        with pytest.raises(UsageError) as refusal:
            scenario(events=[event], **loop)
        assert str(refusal.value).startswith(f"scenario: {problem}")


@pytest.mark.parametrize(
    ("to", "handover", "problem"),
    [
        (
            {"kind": "ff"},
            "full",
            "got handover 'full' from 'aoe' to 'ff', which do not share the state; allowed: moments",
        ),
        ({"kind": "kfi"}, "cold", "unknown estimator 'kfi'; allowed: aoe, "),
        ({"kind": "gpb", "ordr": 2}, "cold", "estimator 'gpb': unknown option 'ordr'; allowed: "),
    ],
)
def test_what_cannot_be_handed_over_is_refused_before_the_start(
    to: dict[str, Any], handover: str, problem: str, tmp_path: Path
) -> None:
    with pytest.raises(UsageError) as refusal:
        run(scenario(events=[swap(5, "aoe", to, handover)]), tmp_path)
    assert str(refusal.value).startswith(f"swap of 'aoe' at step 5: {problem}")
    assert not (tmp_path / "summary.json").exists()


def test_full_needs_the_same_options(tmp_path: Path) -> None:
    specs = [{"name": "gpb", "order": 2, "acks": "none"}]
    for to, fits in (({"kind": "gpb", "order": 2}, True), ({"kind": "gpb", "order": 3}, False)):
        events = [swap(5, "gpb", to, "full")]
        if fits:
            assert run(scenario(estimators=specs, events=events), tmp_path).events[0].ok
        else:
            with pytest.raises(UsageError, match=r"'gpb' \(order = 2.*to 'gpb' \(order = 3"):
                run(scenario(estimators=specs, events=events), tmp_path)


def test_the_new_one_has_the_acks_and_the_buffer_of_the_old_one() -> None:
    given_scenario = scenario(
        events=[swap(5, "kfio", {"kind": "kfio"}), swap(7, "kfio", {"kind": "ff", "acks": "none"})]
    )
    assert [plan.spec.acks for plan in given_scenario.swaps if plan.spec] == ["perfect", "none"]


def test_events_are_in_the_resolved_scenario() -> None:
    events = [
        swap(5, "aoe", {"kind": "gpb", "order": 3}),
        SHADOW | {"at": 6},
        swap(9, "aoe", "next"),
        REMOVE | {"at": 12},
    ]
    given_scenario: Scenario = scenario(events=events)
    assert parse_scenario(to_toml(given_scenario)) == given_scenario


def series(*values: float | None) -> EstimatorFigures:
    none = (None,) * len(values)
    return EstimatorFigures(
        kind="aoe",
        acks="none",
        trace_P_mean=none,
        trace_P_stderr=none,
        squared_error_mean=values,
        squared_error_stderr=none,
        nees_mean=none,
        nees_stderr=none,
        excess_mean=none,
        excess_stderr=none,
        nees_band_95=(0.0, 1.0),
    )


def test_the_transient_is_the_difference_to_the_twin() -> None:
    swapped, twin = series(9.0, 5.0, 3.0, 2.0, 2.0, 8.0), series(1.0, 1.0, 2.0, 2.0, 2.01, 2.0)
    found = transient("twin", 2, 5, swapped, twin)
    assert found is not None
    assert (found.twin, found.last, found.largest, found.settled) == ("twin", 5, 4.0, 4)
    assert found.mean == pytest.approx((4.0 + 1.0 + 0.0 - 0.01) / 4)
    assert transient("twin", 2, 6, swapped, twin).settled is None  # type: ignore[union-attr]
    assert transient("twin", 2, 6, series(None), series(1.0)) is None


def test_a_twin_is_of_the_new_kind_and_was_never_swapped(tmp_path: Path) -> None:
    specs = [{"name": name, "kind": kind, "acks": "none"} for name, kind in (("a", "ff"), ("b", "aoe"), ("c", "imm"))]
    events = [swap(8, "a", {"kind": "aoe"}, "cold"), swap(12, "a", {"kind": "imm"}), swap(15, "c", {"kind": "ff"})]
    first, second, third = run(scenario(estimators=specs, events=events, lanes=50), tmp_path).events
    assert first.transient is not None
    assert (first.transient.twin, first.transient.last) == ("b", 11)
    assert (second.transient, third.transient) == (None, None)


@pytest.mark.parametrize("lanes", [1, 4])
def test_windows_of_lanes_that_begin_before_an_estimator_have_no_mean(lanes: int, tmp_path: Path) -> None:
    specs = [{"name": "aoe", "acks": "none"}]
    events = [{"at": 8, "action": "shadow", "estimator": "aoe", "name": "s", "to": {"kind": "aoe"}, "handover": "full"}]
    seen: list[Conductor] = []

    class Seen(Conductor):
        def stop(self) -> None:
            seen.append(self)
            super().stop()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("testbed.orchestrator.run.Conductor", Seen)
        run(scenario(estimators=specs, events=events, lanes=lanes), tmp_path)
    figures = seen[0].collector.by_lane()
    begins = np.array([0, *figures.ends[:-1]])
    own, shadow = figures.figures["aoe"]["squared_error"], figures.figures["s"]["squared_error"]
    assert own.shape == shadow.shape == (len(begins), lanes)
    assert np.isnan(shadow[begins + 1 < 8]).all()
    assert (begins + 1 >= 8).any()
    np.testing.assert_array_equal(shadow[begins + 1 >= 8], own[begins + 1 >= 8])


def test_the_statement_on_an_lqg_controller_knows_of_swaps() -> None:
    from testbed.control.optimality import statement

    weights = {"Qx": [[1.0, 0.0], [0.0, 1.0]], "Ru": [[1.0]]}
    loop = {"kind": "lqg", **weights, "estimator": "kfio"}
    for events, text in (
        ([], "optimal: no controller"),
        ([swap(9, "kfio", {"kind": "kfio"}, "full")], "optimal: no controller"),
        ([swap(9, "kfio", {"kind": "kfio"})], "not optimal: kfio is swapped at step 9, and the new one does not know"),
    ):
        found = statement(scenario(input=loop, events=events))
        assert found is not None
        assert found.startswith(text)
