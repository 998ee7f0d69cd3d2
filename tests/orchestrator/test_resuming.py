"""A run that is cut off and finished from its journal is, to the bit, one that was not cut off."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from orchestrator.cutting import Meanwhile, cut_run, determined, resume
from orchestrator.runs import run, scenario
from orchestrator.test_recovery import killing
from testbed.errors import UsageError
from testbed.estimator import registry
from testbed.estimator.model import Estimate
from testbed.numerics.lanes import matrix_of, vector_of
from testbed.orchestrator.recording import read_recording
from testbed.orchestrator.resuming import resumed
from testbed.orchestrator.run import Run
from testbed.orchestrator.summary import Summary
from testbed.scenario import Scenario

FOLLOWED = [{"name": "aoe", "acks": "none"}, {"name": "ff", "acks": "none"}]


def journalled(**changes: Any) -> Scenario:
    recovery = {"journal": True, "every": 3, **changes.pop("recovery", {})}
    return scenario(**{"clock": {"window": 2}, "estimators": FOLLOWED, "recovery": recovery, **changes})


def packets(out: Path) -> dict[tuple[str, int, int], dict[str, bytes]]:
    """Of a recording: every packet once."""
    found: dict[tuple[str, int, int], dict[str, bytes]] = {}
    for topic, packet, arrays in read_recording(out / "recording.mcap"):
        key = (topic, packet.step, packet.lane)
        assert key not in found
        found[key] = {name: array.tobytes() for name, array in arrays.items()}
    return found


def same(plain: Path, whole: Summary, left: Path, again: Summary) -> None:
    assert again.status == "complete", again.reason
    assert determined(again) == determined(whole)
    assert packets(left) == packets(plain)
    with np.load(plain / "lanes.npz") as first, np.load(left / "lanes.npz") as second:
        assert sorted(first) == sorted(second)
        for name in first:
            assert first[name].tobytes() == second[name].tobytes(), name
    assert not (left / "journal").exists()


def check(
    given: Scenario, folder: Path, cuts: tuple[int, ...], *, settled: bool = True, meanwhile: Meanwhile | None = None
) -> list[int]:
    """Cut a run off at each of these messages, finish it, and compare; the steps after which it went on."""
    extra = {} if meanwhile is None else {"meanwhile": meanwhile}
    assert not cut_run(given, folder / "plain", -1, folder / "none", **extra)
    whole = Summary.model_validate_json((folder / "plain" / "summary.json").read_bytes())
    assert whole.status == "complete"
    assert all(event.ok for event in whole.events)
    begun = []
    for at in cuts:
        left = folder / f"left-{at}"
        assert cut_run(given, folder / f"cut-{at}", at, left, settled=settled, **extra)
        again, step = resume(left, schedule=at)
        same(folder / "plain", whole, left, again)
        assert (left / "scenario.toml").read_text() == (folder / "plain" / "scenario.toml").read_text()
        begun.append(step)
    return begun


@pytest.mark.parametrize(("every", "per_packet"), [(1, 6), (4, 2), (50, 6)])
def test_where_it_is_cut_off_does_not_matter(every: int, per_packet: int, tmp_path: Path) -> None:
    given = journalled(recovery={"every": every}, transport={"lanes_per_packet": per_packet})
    begun = check(given, tmp_path, (0, 5, 140, 233, 301), settled=False)
    assert all(step % every == 0 for step in begun)


def test_it_goes_on_from_what_is_on_disk(tmp_path: Path) -> None:
    begun = check(journalled(), tmp_path, (150, 250, 330))
    assert begun == sorted(begun)
    assert begun[0] > 0


EVENTS: list[list[dict[str, Any]]] = [
    [
        {"at": 5, "action": "swap", "estimator": "aoe", "to": {"kind": "ff"}, "handover": "moments"},
        {"at": 6, "action": "shadow", "estimator": "ff", "name": "beside", "to": {"kind": "gpb1"}},
        {"at": 9, "action": "swap", "estimator": "ff", "to": "beside"},
        {"at": 11, "action": "add", "estimator": "late", "to": {"kind": "imm", "acks": "none"}},
        {"at": 14, "action": "swap", "estimator": "aoe", "to": {"kind": "ff"}, "handover": "full"},
        {"at": 16, "action": "remove", "estimator": "late"},
    ],
    [
        {"at": 4, "action": "partition", "links": ["observation"]},
        {"at": 7, "action": "plant", "A": [[0.5, 0.0], [0.1, 0.9]], "over": 6},
        {"at": 9, "action": "heal"},
        {"at": 10, "action": "set", "link": "control", "set": {"loss": {"kind": "bernoulli", "arrival": 0.4}}},
        {"at": 12, "action": "input", "input": {"kind": "uniform", "low": -1.0, "high": 5.0}},
        {"at": 15, "action": "mark", "name": "here"},
        {"at": 16, "action": "acks", "acks": "perfect"},
    ],
]


@pytest.mark.parametrize("events", EVENTS, ids=["estimators", "parts"])
def test_events_before_and_behind_the_checkpoint(events: list[dict[str, Any]], tmp_path: Path) -> None:
    begun = check(journalled(events=events), tmp_path, (130, 190, 240, 290, 340))
    assert len(set(begun)) >= 2


@pytest.mark.parametrize(
    "source",
    [
        {"kind": "feedback", "gain": [[0.6, 0.3]], "low": -2.0, "high": 2.0},
        {"kind": "lqg", "Qx": [[1.0, 0.0], [0.0, 1.0]], "Ru": [[0.5]]},
        {"kind": "pid", "kp": 0.3, "ki": 0.05, "output": [[1.0, 0.0]]},
    ],
    ids=lambda source: source["kind"],
)
def test_closed_loops(source: dict[str, Any], tmp_path: Path) -> None:
    swap = {"at": 8, "action": "swap", "estimator": "aoe", "to": {"kind": "aoe"}, "handover": "full"}
    begun = check(journalled(input=source, events=[swap]), tmp_path, (150, 350))
    assert min(begun) < 8 < max(begun)


def test_what_is_on_its_way_on_timed_links(tmp_path: Path) -> None:
    delay = {"kind": "uniform", "low": "1 ms", "high": "35 ms"}
    links = {
        "control": {"delay": delay, "loss": {"kind": "bernoulli", "arrival": 0.8}},
        "observation": {"delay": delay, "transport": {"kind": "tcp"}, "loss": {"kind": "bernoulli", "arrival": 0.8}},
        "ack": {"mode": "link", "delay": delay},
    }
    begun = check(journalled(links=links, clock={"window": 2, "period": "10 ms"}), tmp_path, (150, 280))
    assert max(begun) > 3


ORDERS = {
    60: {"action": "swap", "estimator": "aoe", "to": {"kind": "imm"}, "handover": "cold"},
    120: {"action": "plant", "R": [[2.0]], "over": 3},
    180: {"action": "set", "link": "observation", "set": {"loss": {"kind": "bernoulli", "arrival": 0.3}}},
    240: {"action": "add", "estimator": "late", "to": {"kind": "kfio", "acks": "perfect"}},
    290: {"action": "remove", "estimator": "ff"},
}


def order(work: Run, delivered: int) -> None:
    """Commands that come after so many messages, as of somebody at a terminal."""
    if delivered in ORDERS:
        asked = ORDERS[delivered]
        work.desk.put(lambda conductor: conductor.order(asked))
        work.desk.work()


def same_as_planned(left: Path, again: Summary, orders: list[dict[str, Any]], folder: Path, **changes: Any) -> int:
    """The run is one whose scenario has what was done of the orders, at the steps at which it was; how much that is."""
    done = [event for event in again.events if event.ok]
    assert all(event.by == "command" for event in again.events)
    assert [event.action for event in done] == [orders[event.number or 0]["action"] for event in done]
    planned = [{**orders[event.number or 0], "at": event.step} for event in done]
    whole = run(journalled(events=planned, **changes), folder)
    assert [(event.step, event.ok) for event in whole.events] == [(event.step, True) for event in done]
    same(folder, whole, left, again.model_copy(update={"events": whole.events}))
    return len(done)


@pytest.mark.parametrize("every", [2, 7])
def test_what_was_commanded_happens_at_its_step_again(every: int, tmp_path: Path) -> None:
    """What was not decided before the cut is told as not done."""
    recovery, done = {"every": every}, set()
    for cut in (130, 170, 230, 280, 340):
        left = tmp_path / f"left-{cut}"
        given = journalled(recovery=recovery)
        assert cut_run(given, tmp_path / f"cut-{cut}", cut, left, settled=True, meanwhile=order)
        decided = {origin.number: step for step, origin in _decided(left)}
        again, _ = resume(left)
        assert {event.number: event.step for event in again.events if event.ok} == decided
        assert len(again.events) == sum(at < cut for at in ORDERS)
        orders = list(ORDERS.values())
        done.add(same_as_planned(left, again, orders, tmp_path / f"plain-{cut}", recovery=recovery))
    assert len(done) >= 3


def test_a_pause_in_the_scenario_and_one_by_command_do_not_hinder_the_end(tmp_path: Path) -> None:
    """The key of how long is no name that Python has."""
    pause = {"action": "pause", "role": "plant", "for": "10 ms"}
    given, left = journalled(events=[{**pause, "at": 3}]), tmp_path / "left"
    with patch.dict(ORDERS, {60: pause, 100: {**pause, "at": 19}}, clear=True):
        assert cut_run(given, tmp_path / "cut", 200, left, settled=True, meanwhile=order)
    again, _ = resume(left)
    assert [(event.action, event.lasts, event.ok) for event in again.events] == [("pause", "10 ms", True)] * 3
    assert (again.events[0].step, again.events[-1].step) == (3, 19)


def _decided(left: Path) -> list[tuple[Any, Any]]:
    """(step, origin) of what was commanded, as the journal has it."""
    begun = resumed(left)
    return [(begun.scenario.events[place].at, origin) for place, origin in begun.origins.items()]


def test_what_was_ordered_and_not_decided_yet_is_not_forgotten(tmp_path: Path) -> None:
    """What has a step of its own happens then; of what has none it is said that it was not done."""
    swap = {"action": "swap", "estimator": "aoe", "to": {"kind": "imm"}, "handover": "cold"}
    given, left = journalled(), tmp_path / "left"
    with patch.dict(ORDERS, {60: {**swap, "at": 17}, 199: swap}, clear=True):
        assert cut_run(given, tmp_path / "cut", 200, left, settled=True, meanwhile=order)
    again, step = resume(left)
    assert 0 < step < 17
    timed, untimed = sorted(again.events, key=lambda event: event.number or 0)
    assert (timed.step, timed.ok) == (17, True)
    assert (untimed.by, untimed.ok, untimed.reason) == ("command", False, "the run was cut off before it was decided")
    assert same_as_planned(left, again, [swap, swap], tmp_path / "plain") == 1


def test_a_run_is_resumed_more_than_once(tmp_path: Path) -> None:
    given = journalled(events=EVENTS[0])
    whole = run(given, tmp_path / "plain")
    left, steps = tmp_path / "left-0", []
    assert cut_run(given, tmp_path / "first", 130, left, settled=True)
    for again in range(1, 4):
        behind = tmp_path / f"left-{again}"
        begun = resumed(left)
        steps.append(begun.step)
        with interrupted_after(90):
            Run(begun.scenario, left, begun=begun).in_process()
        shutil.copytree(left, behind)
        left = behind
    last, step = resume(left)
    assert [*steps, step] == sorted({*steps, step})
    same(tmp_path / "plain", whole, left, last)
    assert [(entry.role, entry.begin) for entry in last.recovered] == [
        ("orchestrator", begin) for begin in (*steps, step)
    ]


@contextmanager
def interrupted_after(messages: int) -> Iterator[None]:
    """As by Ctrl-C."""
    from testbed.wire.memory_bus import MemoryNetwork

    class Interrupting(MemoryNetwork):
        done = 0

        def step(self) -> bool:
            self.done += 1
            if self.done == messages:
                import signal

                signal.raise_signal(signal.SIGINT)
            return super().step()

    with (
        patch("testbed.orchestrator.report.write_report"),
        patch("testbed.orchestrator.run.MemoryNetwork", Interrupting),
    ):
        yield


def test_a_role_that_is_lost_behind_the_checkpoint_is_started_anew(tmp_path: Path) -> None:
    given = journalled()
    whole = run(given, tmp_path / "plain")
    assert cut_run(given, tmp_path / "cut", 200, tmp_path / "left", settled=True)
    again, step = resume(tmp_path / "left", network=killing((20, "plant"), (90, "estimator.aoe")))
    same(tmp_path / "plain", whole, tmp_path / "left", again)
    assert [entry.role for entry in again.recovered] == ["orchestrator", "plant", "estimator.aoe"]
    assert all(entry.begin >= step > 0 for entry in again.recovered)


def test_an_estimator_that_the_run_went_on_without_stays_away(tmp_path: Path) -> None:
    given = journalled(recovery={"roles": {"estimator.ff": "continue"}})
    lost = killing((120, "estimator.ff"))
    whole = run(given, tmp_path / "plain", network=lost)
    with patch("orchestrator.cutting.MemoryNetwork", lost):
        assert cut_run(given, tmp_path / "cut", 260, tmp_path / "left", settled=True)
    (before,) = whole.recovered
    again, step = resume(tmp_path / "left")
    assert step > before.begin
    same(tmp_path / "plain", whole, tmp_path / "left", again)
    assert again.recovered[0] == before


@pytest.mark.parametrize("recovery", [{"policy": "fail"}, {"roles": {"plant": "fail", "estimator.ff": "continue"}}])
def test_also_what_is_not_started_anew_gives_its_state(recovery: dict[str, Any], tmp_path: Path) -> None:
    begun = check(journalled(recovery=recovery), tmp_path, (200, 300))
    assert begun[0] > 0


def test_conditions_are_looked_at_from_the_beginning(tmp_path: Path) -> None:
    events = [{"when": "trace_P(aoe) > 1 for 2 steps", "action": "mark", "name": "large"}]
    given = journalled(events=events)
    assert check(given, tmp_path, (300,)) == [0]
    assert cut_run(given, tmp_path / "cut", 300, tmp_path / "left", settled=True)
    assert resumed(tmp_path / "left").anew == "what its conditions have seen is in no checkpoint"


class Mute:
    """An estimator of somebody's own that cannot give its state."""

    def __init__(self, model: Any, lanes: int) -> None:
        self._model, self.counters = model, dict[str, int]()

    def step(self, u: Any, y: Any, arrived: Any, acks: Any = ()) -> Estimate:
        model = self._model
        return Estimate(
            vector_of(np.tile(model.x0_mean, (len(u), 1))), matrix_of(np.tile(model.P0, (len(u), 1, 1))), len(u)
        )


class Point:
    name, value, dist = "mute", "somewhere:Mute", None

    def load(self) -> type[Mute]:
        return Mute


@pytest.fixture
def mute(monkeypatch: pytest.MonkeyPatch) -> None:
    def entry_points(group: str, name: str | None = None) -> list[Point]:
        return [Point()] if group == registry.GROUP and name in (None, "mute") else []

    monkeypatch.setattr(registry, "entry_points", entry_points)


@pytest.mark.usefixtures("mute")
def test_a_run_with_a_role_that_gives_no_state_begins_anew(tmp_path: Path) -> None:
    own = {"name": "own", "kind": "mute", "acks": "none"}
    assert check(journalled(estimators=[*FOLLOWED, own]), tmp_path, (250,)) == [0]


def spoil(path: Path, cut: int) -> None:
    content = path.read_bytes()
    path.write_bytes(content[:cut] + bytes([content[cut] ^ 0x40]) + content[cut + 1 :])


@pytest.mark.parametrize("damage", ["checkpoint", "checkpoints", "figures", "notes", "no figures"])
def test_a_damaged_journal_gives_what_is_whole_in_it(damage: str, tmp_path: Path) -> None:
    given = journalled(recovery={"every": 2})
    whole = run(given, tmp_path / "plain")
    left = tmp_path / "left"
    assert cut_run(given, tmp_path / "cut", 250, left, settled=True)
    journal = left / "journal"
    before = resumed(left).step
    newest = journal / f"checkpoint-{before}.bin"
    if damage == "checkpoints":
        for path in journal.glob("checkpoint-*"):
            spoil(path, 200)
    elif damage == "checkpoint":
        newest.write_bytes(newest.read_bytes()[:-1])
    elif damage == "notes":
        with (journal / "notes.jsonl").open("ab") as file:
            file.write(b'{"command": {"act')
    else:
        figures = journal / "figures.bin"
        figures.write_bytes(figures.read_bytes()[: 30 if damage == "no figures" else -40])
    begun = resumed(left)
    assert begun.lost
    if damage in ("checkpoints", "no figures"):
        assert (begun.step, begun.anew) == (0, "there is no checkpoint of it")
    elif damage == "checkpoint":
        assert 0 < begun.step < before
    again, _ = resume(left)
    same(tmp_path / "plain", whole, left, again)


def refused(folder: Path) -> str:
    with pytest.raises(UsageError) as caught:
        resume(folder)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_what_cannot_be_resumed_is_one_line(tmp_path: Path) -> None:
    allowed = "; allowed: the folder of a run that was not finished"
    assert refused(tmp_path / "none") == f"{tmp_path / 'none'}: no run to be resumed{allowed}"
    run(journalled(), tmp_path / "whole")
    assert refused(tmp_path / "whole") == f"{tmp_path / 'whole'}: its run is complete{allowed}"
    run(scenario(recovery={"policy": "fail"}), tmp_path / "lost", network=killing((50, "plant")))
    assert refused(tmp_path / "lost") == f"{tmp_path / 'lost'}: its run failed, and kept no journal{allowed}"
    assert cut_run(journalled(), tmp_path / "cut", 200, tmp_path / "left")
    begin = tmp_path / "left" / "journal" / "begin.json"
    kept = begin.read_bytes()
    begin.write_bytes(kept[:-5])
    assert refused(tmp_path / "left") == f"{begin}: damaged: the run must begin anew"
    begin.write_bytes(kept.replace(b'"v": 1', b'"v": 99'))
    assert "of another version of the testbed" in refused(tmp_path / "left")
    begin.write_bytes(kept.replace(b"steps = 20", b"steps = -1"))
    assert "steps: got -1" in refused(tmp_path / "left")
    begin.unlink()
    assert "no such file" in refused(tmp_path / "left")


def test_a_run_that_still_goes_is_not_resumed(tmp_path: Path) -> None:
    tried: list[str] = []

    def try_it(work: Run, delivered: int) -> None:
        if delivered == 200:
            tried.append(refused(tmp_path / "out"))

    assert not cut_run(journalled(), tmp_path / "out", -1, tmp_path / "left", meanwhile=try_it)
    assert "another process writes this journal; is the run still going?" in tried[0]
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["status"] == "complete"
