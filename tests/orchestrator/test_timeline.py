"""Events of a timeline: each takes effect at exactly the step that it should, and does what its definition says."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from orchestrator.commanding import commanded
from orchestrator.runs import SYSTEM, figures, recorded, run, scenario
from orchestrator.wall_clock import MS, Simulated
from testbed.errors import RunFailed, UsageError
from testbed.estimator.snapshot import Snapshot
from testbed.orchestrator.asked import status_of
from testbed.orchestrator.conductor import Conductor
from testbed.orchestrator.processes import NoProcesses
from testbed.orchestrator.summary import Happened, Summary
from testbed.wire.bundle import unbundle

STEPS, LANES = 20, 6
AOE = [{"name": "aoe", "acks": "none"}, {"name": "ff", "acks": "none"}]
TIMED = {
    "control": {"loss": {"kind": "bernoulli", "arrival": 0.7}, "delay": {"kind": "constant", "by": "2 ms"}},
    "observation": {
        "loss": {"kind": "gilbert-elliott", "to_bad": 0.2, "to_good": 0.4, "loss_bad": 0.8},
        "delay": {"kind": "uniform", "low": "0 s", "high": "9 ms"},
    },
}


def mark(name: str = "here", **moment: Any) -> dict[str, Any]:
    return {"action": "mark", "name": name, **moment}


def of(summary: Summary, action: str) -> list[Happened]:
    return [event for event in summary.events if event.action == action]


def determined(summary: Summary) -> dict[str, Any]:
    return {key: value for key, value in figures(summary).items() if key not in ("events", "checks")}


def first(holds: list[bool], length: int) -> int:
    """The first step, from 1, at which something has held for so many steps."""
    return next(k for k in range(length, len(holds) + 1) if all(holds[k - length : k]))


# Conditions


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> tuple[Summary, Any]:
    folder = tmp_path_factory.mktemp("plain")
    summary = run(scenario(estimators=AOE), folder)
    return summary, recorded(folder, LANES, STEPS)


def expectations(summary: Summary, records: Any) -> dict[str, int]:
    """By condition: the step at which it begins to hold, from what a run without events recorded."""
    trace, error = summary.estimators["aoe"].trace_P_mean, summary.estimators["ff"].squared_error_mean
    assert None not in (*trace, *error)
    x, x_hat = records["truth"]["x"], records["estimate/aoe"]["x_hat"]
    each = ((x - x_hat) ** 2).sum(axis=2)
    lost = 1.0 - records["observation/delivered"]["mask"]
    levels = np.quantile(np.array(trace, dtype=float), 0.4), np.median(each.max(axis=1))
    gone = np.cumsum(lost.sum(axis=1)) / (LANES * np.arange(1, STEPS + 1))
    level = float(np.quantile(gone[3:], 0.7))
    return {
        f"trace_P(aoe) > {levels[0]} for 2 steps": first([bool(t > levels[0]) for t in trace], 2),  # type: ignore[operator]
        f"any lane (error(aoe) > {levels[1]}) and step > 3": 1
        + next(k for k in range(3, STEPS) if each[k].max() > levels[1]),
        "error(ff) < trace_P(aoe) and time >= 50 ms": 1 + next(k for k in range(4, STEPS) if error[k] < trace[k]),  # type: ignore[operator]
        f"loss_rate(observation) >= {level}": 1 + next(k for k in range(STEPS) if gone[k] >= level),
    }


@pytest.mark.parametrize(("split", "schedule", "window"), [(6, None, None), (4, 3, None), (1, 5, 4)])
def test_a_condition_fires_where_the_figures_of_a_run_without_it_say(
    split: int, schedule: int | None, window: int | None, plain: tuple[Summary, Any], tmp_path: Path
) -> None:
    expected = expectations(*plain)
    events = [mark(str(i), when=text) for i, text in enumerate(expected)]
    clock = {"period": "10 ms"} | ({} if window is None else {"window": window})
    given = scenario(estimators=AOE, events=events, clock=clock, transport={"lanes_per_packet": split})
    summary = run(given, tmp_path, schedule)
    found = {int(event.name or ""): (event.true_at, event.step) for event in of(summary, "mark")}
    assert found == {i: (k, k + 1) for i, k in enumerate(expected.values())}
    assert all((event.ok, event.by) == (True, "condition") for event in summary.events)
    assert determined(summary) == determined(plain[0])


CHANGES: list[dict[str, Any]] = [
    {"action": "set", "link": "observation", "set": {"loss": {"kind": "bernoulli", "arrival": 0.3}}},
    {"action": "swap", "estimator": "aoe", "to": {"kind": "imm"}},
    {"action": "partition", "links": ["control", "observation"]},
    {"action": "plant", "A": [[0.5, 0.0], [0.1, 0.9]], "over": 3},
    {"action": "input", "input": {"kind": "uniform", "low": -1.0, "high": 5.0}},
    {"action": "acks", "acks": "perfect"},
    {"action": "remove", "estimator": "ff"},
]


@pytest.mark.parametrize("change", CHANGES, ids=lambda change: change["action"])
def test_what_a_condition_brings_is_what_comes_at_the_step_after_it(change: dict[str, Any], tmp_path: Path) -> None:
    waiting = run(scenario(estimators=AOE, events=[{**change, "when": "step == 7"}]), tmp_path / "when", 2)
    timed = run(scenario(estimators=AOE, events=[{**change, "at": 8}]), tmp_path / "at")
    assert determined(waiting) == determined(timed)
    assert {e.step for e in waiting.events} == {8}
    assert {e.true_at for e in waiting.events} == {7}
    assert determined(timed) != determined(run(scenario(estimators=AOE), tmp_path / "plain"))


def test_a_condition_that_never_holds_is_in_the_results(tmp_path: Path) -> None:
    summary = run(scenario(estimators=AOE, events=[mark(when="trace_P(aoe) > 1e9")]), tmp_path)
    (event,) = summary.events
    assert (event.ok, event.reason) == (False, "its condition did not begin to hold")


def test_a_change_that_does_not_fit_when_its_condition_holds_is_refused_and_told(tmp_path: Path) -> None:
    events = [
        {"at": 4, "action": "remove", "estimator": "ff"},
        {"when": "step == 9", "action": "swap", "estimator": "ff", "to": {"kind": "imm"}},
        {"when": "step == 10", "action": "heal"},
    ]
    summary = run(scenario(estimators=AOE, events=events), tmp_path)
    assert summary.status == "complete"
    refused = [(e.step, e.reason) for e in summary.events if not e.ok]
    assert [step for step, _ in refused] == [10, 11]
    assert str(refused[0][1]).startswith("got 'ff'; allowed at step 10: aoe")
    assert refused[1][1] == "got all, and none is cut then; allowed: none"


# Partitions


@pytest.mark.parametrize("links", [{}, {"links": TIMED}], ids=["instant", "timed"])
def test_a_cut_loses_what_is_sent_meanwhile_and_nothing_else(links: dict[str, Any], tmp_path: Path) -> None:
    events = [{"at": 5, "action": "partition"}, {"at": 9, "action": "heal", "links": ["control"]}]
    events.append({"at": 12, "action": "heal"})
    one = run(scenario(estimators=AOE, **links), tmp_path / "plain")
    other = run(scenario(estimators=AOE, events=events, **links), tmp_path / "cut")
    before, after = (recorded(tmp_path / name, LANES, STEPS) for name in ("plain", "cut"))
    for link, whole, ends in (("control", 0, 9), ("observation", 1, 12)):
        expected = before[f"{link}/delivered"]["mask"].copy()
        would_have = int(expected[5 - whole : ends - whole].sum())
        expected[5 - whole : ends - whole] = 0.0
        np.testing.assert_array_equal(after[f"{link}/delivered"]["mask"], expected)
        assert would_have > 0
        assert other.links[link].causes["cut"] == would_have
        assert one.links[link].delivered - other.links[link].delivered == would_have
    assert next(check.ok for check in other.checks if check.name == "books")
    assert [e.links for e in other.events][1:] == [("control",), ("observation",) if links else ("observation", "ack")]


# The plant and the input


def test_the_input_is_the_other_one_from_its_step_on(tmp_path: Path) -> None:
    table = [[float(k), -2.0][:1] for k in range(STEPS)]
    events = [
        {"at": 4, "action": "input", "input": {"kind": "constant", "value": [2.5]}},
        {"at": 9, "action": "input", "input": {"kind": "table", "values": table}},
    ]
    summary = run(scenario(estimators=AOE, events=events), tmp_path)
    u = recorded(tmp_path, LANES, STEPS)["control/sent"]["u"][:, :, 0]
    k = np.arange(STEPS)
    expected = np.where(k < 4, 4.0 * np.sin(2 * np.pi * k / 7.0), np.where(k < 9, 2.5, k))
    np.testing.assert_allclose(u, np.tile(expected[:, None], (1, LANES)), atol=1e-12)
    assert summary.bounds is not None
    assert summary.bounds.upper_reason is None


def test_bounds_say_when_an_input_is_beyond_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    event = {"action": "input", "input": {"kind": "constant", "value": [100.0]}}
    summary, answers = commanded(tmp_path, monkeypatch, {5: {"event": event}})
    assert answers == [{"number": 0}]
    assert summary.bounds is not None
    assert "the input is one that the scenario does not have" in str(summary.bounds.upper_reason)


def ramp(old: Any, new: Any, at: int, over: int, k: int) -> Any:
    """A straight line from what was at step at − 1 to what is at step at + over − 1."""
    return np.array(old) + min(max((k - at + 1) / over, 0.0), 1.0) * (np.array(new) - np.array(old))


@pytest.mark.parametrize("lanes", [1, LANES])
@pytest.mark.parametrize("over", [1, 4])
def test_a_drifting_plant_is_the_recursion_with_the_parameters_of_each_step(
    lanes: int, over: int, tmp_path: Path
) -> None:
    """The noises are taken from a run that does not drift, where x and y are known."""
    links = {"observation": {"loss": {"kind": "none"}}}
    new_a, new_c, new_q, new_r = [[0.7, 0.1], [0.3, 0.9]], [[2.0, -1.0]], [[2.0, 0.3], [0.3, 1.0]], [[1.6]]
    event = {"at": 7, "action": "plant", "A": new_a, "C": new_c, "Q": new_q, "R": new_r, "over": over}
    common = {"estimators": AOE[:1], "links": links, "lanes": lanes}
    run(scenario(**common), tmp_path / "plain")
    summary = run(scenario(**common, events=[event]), tmp_path / "drift")
    was, now = (recorded(tmp_path / name, lanes, STEPS) for name in ("plain", "drift"))
    A, B, C = (np.array(SYSTEM[key]) for key in "ABC")
    x, u, nu = was["truth"]["x"], was["control/sent"]["u"], was["truth"]["nu"]
    root, seen = np.linalg.cholesky(np.array(SYSTEM["Q"])), np.sqrt(SYSTEM["R"][0][0])
    found = now["truth"]["x"]
    np.testing.assert_array_equal(found[:6], x[:6])
    for k in range(6, STEPS):  # from x_k to x_{k+1}; row k − 1 is step k
        push = nu[k, :, None] * (u[k] @ B.T)
        w = np.linalg.solve(root, (x[k] - x[k - 1] @ A.T - push).T).T
        v = (was["observation/sent"]["y"][k] - x[k] @ C.T) / seen
        a, q = ramp(A, new_a, 7, over, k), ramp(SYSTEM["Q"], new_q, 7, over, k)
        expected = found[k - 1] @ a.T + push + w @ np.linalg.cholesky(q).T
        np.testing.assert_allclose(found[k], expected, rtol=1e-9, atol=1e-9)
        c, r = ramp(C, new_c, 7, over, k + 1), ramp(SYSTEM["R"], new_r, 7, over, k + 1)
        y = now["truth"]["x"][k] @ c.T + v * np.sqrt(r[0][0])
        np.testing.assert_allclose(now["observation/sent"]["y"][k], y, rtol=1e-8, atol=1e-8)
    assert "skipped: from step 7 on the plant is not" in next(c.text for c in summary.checks if c.name == "finite mean")
    assert summary.bounds is not None
    assert "the plant departs from it at step 7" in str(summary.bounds.upper_reason)


def test_a_drift_does_not_depend_on_packets_or_schedules(tmp_path: Path) -> None:
    events = [
        {"at": 3, "action": "plant", "A": [[0.9, 0.1], [0.0, 0.8]], "over": 6},
        {"at": 5, "action": "plant", "R": [[2.0]], "A": [[0.2, 0.0], [0.0, 0.2]], "over": 5},
        {"at": 12, "action": "plant", "B": [[0.0], [0.0]], "G": [[0.5, 0.0], [0.0, 2.0]]},
    ]
    base = figures(run(scenario(estimators=AOE, events=events, lanes=40), tmp_path / "base"))
    for i, (size, schedule) in enumerate([(1, 3), (16, 5)]):
        split = scenario(estimators=AOE, events=events, lanes=40, transport={"lanes_per_packet": size})
        assert figures(run(split, tmp_path / str(i), schedule)) == base


# Snapshots and ACKs


def test_a_snapshot_holds_the_estimate_of_the_step_before(tmp_path: Path) -> None:
    events = [{"at": 9, "action": "snapshot", "estimator": "aoe"}]
    events.append({"when": "step == 12", "action": "snapshot", "estimator": "ff", "name": "kept"})  # type: ignore[dict-item]
    summary = run(scenario(estimators=AOE, events=events, transport={"lanes_per_packet": 4}), tmp_path)
    found = recorded(tmp_path, LANES, STEPS)
    assert [event.file for event in summary.events] == ["snapshots/aoe-9.bin", "snapshots/kept-13.bin"]
    for event, name in zip(summary.events, ("aoe", "ff"), strict=True):
        blocks = [Snapshot.from_bytes(part) for part in unbundle((tmp_path / str(event.file)).read_bytes())]
        assert [(block.step, block.form, block.lanes) for block in blocks] == [
            (event.step - 1, "full", 4),
            (event.step - 1, "full", 2),
        ]
        for key in ("x_hat", "P"):
            together = np.concatenate([block.arrays[key] for block in blocks])
            np.testing.assert_array_equal(together, found[f"estimate/{name}"][key][event.step - 2])
    assert determined(summary) == determined(
        run(scenario(estimators=AOE, transport={"lanes_per_packet": 4}), tmp_path / "plain")
    )


def test_acks_are_switched_by_a_swap_for_the_same_kind_with_all_it_knows(tmp_path: Path) -> None:
    events = [{"at": 6, "action": "acks", "acks": "perfect"}, {"at": 14, "action": "acks", "acks": "none"}]
    events[1]["estimator"] = "ff"
    summary = run(scenario(estimators=AOE, events=events), tmp_path / "acks")
    swaps = [
        {"at": 6, "action": "swap", "estimator": name, "to": {"kind": name, "acks": "perfect"}, "handover": "full"}
        for name in ("aoe", "ff")
    ]
    swaps.append({**swaps[1], "at": 14, "to": {"kind": "ff", "acks": "none"}})
    assert determined(summary) == determined(run(scenario(estimators=AOE, events=swaps), tmp_path / "swaps"))
    assert [(e.step, e.estimator, e.acks) for e in summary.events] == [
        (6, "aoe", "perfect"),
        (6, "ff", "perfect"),
        (14, "ff", "none"),
    ]


# Processes


class Killer:
    """Notes what it is asked for, and where the clock stands then."""

    def __init__(self, conductor: Conductor) -> None:
        self._conductor, self.done = conductor, list[tuple[Any, ...]]()

    def _note(self, *what: Any) -> None:
        self.done.append((*what, self._conductor._granted, self._conductor.collector.estimated))

    def kill(self, role: str) -> None:
        self._note("kill", role)

    def pause(self, role: str, for_s: float) -> None:
        self._note("pause", role, for_s)

    def restart(self, role: str) -> None:
        raise RunFailed(f"{role} would not end")


@pytest.fixture
def killers(monkeypatch: pytest.MonkeyPatch) -> list[Killer]:
    made: list[Killer] = []

    def in_place(_: Any, restart: Any) -> Killer:
        made.append(Killer(restart.__self__))
        return made[-1]

    monkeypatch.setattr("testbed.orchestrator.run.OneProcess", in_place)
    return made


def test_processes_are_ended_while_the_clock_stands_before_their_step(killers: list[Killer], tmp_path: Path) -> None:
    events = [
        {"at": 8, "action": "kill", "role": "plant"},
        {"at": 3, "action": "swap", "estimator": "aoe", "to": {"kind": "aoe"}, "handover": "full"},
        {"when": "step == 10", "action": "pause", "role": "estimator.aoe", "for": "1500 ms"},
        {"at": "150 ms", "action": "restart", "role": "link.ack"},
    ]
    summary = run(scenario(estimators=AOE, events=events, clock={"period": "10 ms"}), tmp_path, 4)
    (killer,) = killers
    assert killer.done == [("kill", "plant", 7, 7), ("pause", "estimator.aoe.2", 1.5, 10, 10)]
    assert [(e.step, e.action, e.ok) for e in summary.events] == [
        (3, "swap", True),
        (8, "kill", True),
        (11, "pause", True),
        (15, "restart", False),
    ]
    assert summary.events[-1].text == "restart link.ack: not done: link.ack would not end"


@pytest.mark.parametrize("end", ["kill", "restart"])
def test_what_is_ended_is_recovered(end: str, tmp_path: Path) -> None:
    summary = run(scenario(estimators=AOE, events=[{"at": 8, "action": end, "role": "plant"}]), tmp_path / "ended")
    plain = run(scenario(estimators=AOE), tmp_path / "plain")
    assert [(event.step, event.ok) for event in summary.events] == [(8, True)]
    assert [(lost.role, lost.step) for lost in summary.recovered] == [("plant", 7)]
    assert {**determined(summary), "recovered": (), "repeated": {}} == determined(plain)


def test_a_pause_delays_and_changes_nothing(tmp_path: Path) -> None:
    events = [{"at": 8, "action": "pause", "role": "plant", "for": "200 ms"}]
    began = time.monotonic()
    summary = run(scenario(estimators=AOE, events=events), tmp_path / "paused", 3)
    assert time.monotonic() - began > 0.2
    assert [(event.step, event.ok) for event in summary.events] == [(8, True)]
    assert determined(summary) == determined(run(scenario(estimators=AOE), tmp_path / "plain"))


def test_what_has_no_processes_ends_none() -> None:
    for end in (lambda p: p.kill("plant"), lambda p: p.pause("plant", 1.0), lambda p: p.restart("plant")):
        with pytest.raises(RunFailed, match=r"nobody can \w+ plant in this run"):
            end(NoProcesses())


ROLES = ("plant", "controller", "link.observation", "estimator.ff")


@pytest.mark.parametrize("schedule", [None, 3])
def test_what_roles_were_told_on_the_way_outlives_them(schedule: int | None, tmp_path: Path) -> None:
    """They are told of drift, input and cuts once; a new process must know of it, to the same bits."""
    events: list[dict[str, Any]] = [
        {"when": "step == 5", "action": "plant", "A": [[0.6, 0.1], [0.0, 0.5]], "over": 8},
        {"when": "step == 6", "action": "input", "input": {"kind": "uniform", "low": -2.0, "high": 9.0}},
        {"when": "step == 7", "action": "partition", "links": ["observation"]},
        {"when": "loss_rate(observation, last 6 steps) > 0.95", "action": "heal"},
        {"at": 9, "action": "acks", "acks": "perfect", "estimator": "aoe"},
    ]
    kills = [{"at": at, "action": "kill", "role": role} for at, role in zip((8, 10, 12, 14), ROLES, strict=True)]
    kept = run(scenario(estimators=AOE, events=events), tmp_path / "kept")
    killed = run(scenario(estimators=AOE, events=[*events, *kills]), tmp_path / "killed", schedule)
    assert [event.text for event in killed.events if not event.ok] == []
    assert len(killed.events) == 9
    assert of(killed, "heal")[0].true_at == of(kept, "heal")[0].true_at
    left_out = ("recovered", "repeated")
    assert {k: v for k, v in determined(killed).items() if k not in left_out} == {
        k: v for k, v in determined(kept).items() if k not in left_out
    }


def test_in_real_time_events_come_when_their_step_is_due(
    killers: list[Killer], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    seen: list[int] = []
    clocks: list[Simulated] = []

    class Noted(Simulated):
        def __init__(self, *arguments: Any, **options: Any) -> None:
            super().__init__(*arguments, **options)
            clocks.append(self)

    monkeypatch.setattr(Killer, "kill", lambda self, role: seen.append(clocks[0].clock.date_ns()))
    events = [
        {"at": 8, "action": "kill", "role": "plant"},
        mark(at=5),
        {"at": 4, "action": "partition", "links": ["observation"]},
        {"at": 6, "action": "heal"},
        {"at": 9, "action": "plant", "R": [[4.0]]},
        {"at": 11, "action": "input", "input": {"kind": "constant", "value": [1.0]}},
    ]
    real = run(scenario(estimators=AOE, events=events, clock={"mode": "real", "period": "10 ms"}), tmp_path / "real",
               network=Noted)  # fmt: skip
    virtual = run(scenario(estimators=AOE, events=events[1:], clock={"period": "10 ms"}), tmp_path / "virtual")
    assert real.realtime is not None
    assert {k: v for k, v in determined(real).items() if k != "realtime"} == {
        k: v for k, v in determined(virtual).items() if k != "realtime"
    }
    start_ns = killers[0]._conductor.pacing.times.start_ns  # type: ignore[union-attr]
    assert seen == [start_ns + 7 * 10 * MS]


# From outside


def test_a_command_with_a_step_or_a_condition(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plant = {"action": "plant", "A": [[0.5, 0.0], [0.0, 0.5]], "at": 15}
    swap = {"action": "swap", "estimator": "ff", "to": {"kind": "imm"}, "at": 12}
    summary, answers = commanded(
        tmp_path / "commanded",
        monkeypatch,
        {
            2: {"event": plant},
            3: {"event": swap},
            4: {"event": mark(when="step >= 10")},
            5: {"event": mark("now")},
            6: {"event": mark("late", at=6)},
            7: {"do": "status"},
        },
    )
    assert [answer.get("number") for answer in answers] == [0, 1, 2, 3, None, None]
    assert answers[4]["error"].startswith("at: got 6; allowed: ")
    assert answers[5]["pending"] == [0, 1, 2]
    by_number = {event.number: event for event in summary.events}
    assert (by_number[0].step, by_number[1].step, by_number[2].true_at) == (15, 12, 10)
    assert [by_number[n].by for n in range(4)] == ["command", "command", "condition", "command"]
    timed, _ = commanded(tmp_path / "timed", monkeypatch, {}, events=[plant, swap])
    assert {**determined(summary), "bounds": None} == {**determined(timed), "bounds": None}


def test_the_clock_is_held_until_it_is_released(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    held: list[tuple[int, int]] = []

    class Held(Conductor):
        def _collected(self, *arguments: Any) -> None:
            super()._collected(*arguments)
            if self.collector.completed == 2 and self.timeline.held_at is None and not held:
                self.hold(8)
            if self.collector.completed == 8 and self.timeline.held_at == 8:
                held.append((self._granted, status_of(self)["held"]))
                self.order({"action": "swap", "estimator": "ff", "to": {"kind": "imm"}, "at": 9})
                self.release()

    monkeypatch.setattr("testbed.orchestrator.run.Conductor", Held)
    summary = run(scenario(estimators=AOE, clock={"window": 3}), tmp_path)
    assert held == [(8, 8)]
    assert [(event.step, event.ok) for event in summary.events] == [(9, True)]
    assert summary.status == "complete"


@pytest.mark.parametrize(
    ("events", "problem"),
    [
        ([mark()], "events[0].at: got neither of at and when; allowed: exactly one of them"),
        ([mark(at=1, when="step > 1")], "events[0].at: got both of at and when; allowed: exactly one of them"),
        (
            [mark(when="trace_P(aeo) > 5")],
            "events[0].when: got 'aeo' at character 9 for the estimator; allowed: aoe, f",
        ),
        ([mark(when="loss_rate(contro) > 0")], "events[0].when: got 'contro' at character 11 for the link; allowed: c"),
        ([mark(at=21)], "events[0].at: got 21; allowed: at most 20, the steps of the scenario"),
        ([{"at": 0, "action": "kill", "role": "plant"}], "events[0].at: got 0; allowed: a step 1 … 20, those of the"),
        ([{"at": 1, "action": "pause", "role": "plant"}], "events[0].for: missing; needed: How long"),
        ([{"at": 1, "action": "plant"}], "events[0]: got none of A, B, C, Q, R, G; allowed: one or more of them"),
        ([{"at": 1, "action": "plant", "A": [[1.0]]}], "events[0]: A: got 1 × 1; allowed: 2 × 2, as in [system]"),
        ([{"at": 1, "action": "plant", "R": [[-1.0]]}], "events[0]: R: "),
        (
            [{"at": 1, "action": "input", "input": {"kind": "table", "values": [[1.0]]}}],
            "events[0].input.values: got 1 rows; allowed: at least 20, one for each step of the run",
        ),
        (
            [{"at": 1, "action": "input", "input": {"kind": "pid"}}],
            "events[0].input.kind: got 'pid'; allowed: constant",
        ),
        ([{"at": 3, "action": "heal"}], "events[0].links: got all, and none is cut then; allowed: none"),
        ([{"at": 3, "action": "partition", "links": ["x"]}], "events[0].links: got ['x']; allowed: a list of control,"),
        (
            [{"at": 3, "action": "partition"}, {"at": 4, "action": "set", "link": "control", "set": {"loss": "none"}}],
            "events[1].link: got 'control', which is cut then; allowed: after its heal",
        ),
        ([{"at": 3, "action": "set", "link": "control", "set": {"up": False}}], "events[0].set: up: cannot be set;"),
        (
            [{"at": 3, "action": "snapshot", "estimator": "aeo"}],
            "events[0].estimator: got 'aeo'; allowed: aoe, ff; did",
        ),
        (
            [{"when": "step > 3", "action": "remove", "estimator": "fg"}],
            "events[0].estimator: got 'fg'; allowed: aoe, f",
        ),
    ],
)
def test_wrong_events_are_one_line(events: list[dict[str, Any]], problem: str) -> None:
    with pytest.raises(UsageError) as refusal:
        scenario(estimators=AOE, events=events)
    assert str(refusal.value).startswith(f"scenario: {problem}"), str(refusal.value)


def checked(**changes: Any) -> Callable[[], None]:
    from testbed.orchestrator.preflight import check_parts

    return lambda: check_parts(scenario(**changes))


@pytest.mark.parametrize(
    ("event", "problem"),
    [
        ({"at": 3, "action": "kill", "role": "plnt"}, "events[0].role: got 'plnt'; allowed: controller, plant, link."),
        ({"at": 3, "action": "acks", "acks": "none", "estimator": "kfio"}, "acks of 'kfio' at step 3: "),
        ({"when": "step > 3", "action": "acks", "acks": "none", "estimator": "kfio"}, "events[0]: "),
        ({"when": "step > 3", "action": "add", "estimator": "new", "to": {"kind": "fff"}}, "events[0]: "),
    ],
)
def test_what_cannot_be_is_refused_before_the_run(event: dict[str, Any], problem: str) -> None:
    with pytest.raises(UsageError) as refusal:
        checked(events=[event])()
    assert str(refusal.value).startswith(problem), str(refusal.value)
    assert "\n" not in str(refusal.value)
