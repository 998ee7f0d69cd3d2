"""Links that change while a run goes: what changes, and what does not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from orchestrator.runs import Recorded, figures, recorded, run, scenario
from testbed.errors import UsageError
from testbed.orchestrator.conductor import Conductor
from testbed.orchestrator.summary import Summary
from testbed.scenario import parse_scenario
from testbed.scenario.changes import changed, parse_setting, together
from testbed.scenario.links import Link

NO_BOUNDS = {"bounds": False}
TIMED = {
    "links": {
        "control": {"loss": {"kind": "bernoulli", "arrival": 0.7}, "delay": {"kind": "constant", "by": "2 ms"}},
        "observation": {
            "loss": {"kind": "gilbert-elliott", "to_bad": 0.2, "to_good": 0.4, "loss_bad": 0.8},
            "delay": {"kind": "uniform", "low": "0 s", "high": "25 ms"},
        },
        "ack": {"mode": "none"},
    },
    "estimators": [{"name": "aoe"}, {"name": "kfio", "acks": "perfect"}],
}


def event(at: int | str, link: str, **settings: Any) -> dict[str, Any]:
    return {"at": at, "action": "set", "link": link, "set": settings}


def pair(folder: Path, events: list[dict[str, Any]], **changes: Any) -> tuple[Summary, Summary, Recorded, Recorded]:
    """A run without and with events: summaries and recordings."""
    plain, eventful = folder / "plain", folder / "eventful"
    one, other = run(scenario(**changes), plain), run(scenario(events=events, **changes), eventful)
    return one, other, recorded(plain, 6, 20), recorded(eventful, 6, 20)


@pytest.mark.parametrize("changes", [{}, TIMED], ids=["instant", "timed"])
def test_an_event_that_changes_nothing_changes_no_bit(changes: dict[str, Any], tmp_path: Path) -> None:
    tables = scenario(**changes).links
    same = tables.observation.model_dump(mode="json")["loss"]
    loss = {key: value for key, value in same.items() if value is not None}
    one, other, _, _ = pair(
        tmp_path, [event(7, "observation", loss=loss), event(8, "control", clock="packet")], **changes
    )
    assert [happened.step for happened in other.events] == [7, 8]
    assert {**figures(one), "events": ()} == {**figures(other), "events": ()}


@pytest.mark.parametrize("changes", [{}, TIMED], ids=["instant", "timed"])
@pytest.mark.parametrize("arrival", [0.0, 1.0])
def test_it_holds_from_its_step_on_and_not_before(changes: dict[str, Any], arrival: float, tmp_path: Path) -> None:
    new = {"kind": "bernoulli", "arrival": arrival}
    settings = {"loss": new, "delay": "none"} if changes else {"loss": new}
    events = [event("90 ms", "observation", **settings), event(11, "control", **settings)]
    _, other, before, after = pair(tmp_path, events, **changes)
    for topic, first in (("observation/delivered", 9), ("control/delivered", 11)):
        start = 1 if topic.startswith("observation") else 0
        was, now = before[topic]["mask"], after[topic]["mask"]
        np.testing.assert_array_equal(was[: first - start], now[: first - start])
        assert (now[first - start :] == arrival).all()
        assert not (was[first - start :] == arrival).all()
    assert [happened.by for happened in other.events] == ["timeline", "timeline"]


def test_what_is_in_flight_arrives_as_it_would_have(tmp_path: Path) -> None:
    links = {"observation": {"delay": {"kind": "constant", "by": "35 ms"}}}
    events = [event(10, "observation", delay={"kind": "constant", "by": "1 ms"})]
    summary = run(scenario(links=links, events=events, estimators=[{"name": "kfio", "acks": "perfect"}]), tmp_path)
    link = summary.links["observation"]
    assert (link.delivered, link.late, link.in_flight) == (120, 6 * 9, 0)


@pytest.mark.parametrize("changes", [{}, TIMED], ids=["instant", "timed"])
def test_events_do_not_depend_on_packets_or_schedules(changes: dict[str, Any], tmp_path: Path) -> None:
    events = [
        event(5, "observation", loss={"kind": "markov", "recovery": 0.3, "failure": 0.6}),
        event(9, "control", loss={"arrival": 0.2}),
    ]
    base = figures(run(scenario(events=events, **changes), tmp_path / "base"))
    for i, (size, schedule) in enumerate([(1, None), (4, 3), (6, 5)]):
        split = scenario(events=events, transport={"lanes_per_packet": size}, **changes)
        assert figures(run(split, tmp_path / str(i), schedule)) == base


class Commanding(Conductor):
    """A conductor of which somebody asks for a change when step 8 is complete."""

    answers: list[int]

    def _collected(self, *arguments: Any) -> None:
        super()._collected(*arguments)
        if self.collector.completed == 8 and not hasattr(self, "answers"):
            self.answers = [self.change_link("observation", {"loss": {"kind": "bernoulli", "loss": 1.0}})]


def test_a_command_takes_effect_at_the_step_that_it_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("testbed.orchestrator.run.Conductor", Commanding)
    summary = run(scenario(clock={"window": 2}), tmp_path)
    ((happened,), mask) = summary.events, recorded(tmp_path, 6, 20)["observation/delivered"]["mask"]
    assert (happened.by, happened.link, summary.status) == ("command", "observation", "complete")
    assert 9 <= happened.step <= 12
    assert not mask[happened.step - 1 :].any()
    assert mask[: happened.step - 1].any(axis=1).all()


@pytest.mark.parametrize(
    ("link", "change", "problem"),
    [
        (
            "observatio",
            {"loss": "none"},
            "link 'observatio': no such link; allowed: control, observation, ack; did you",
        ),
        ("observation", {"delay": {"kind": "constant", "by": "1 ms"}}, "link 'observation' began without time"),
        ("observation", {"loss": {"failur": 0.1}}, "loss: unknown key 'failur'; did you mean 'failure'?"),
        ("observation", {"deadline": "1 ms"}, "deadline: cannot be set while a run goes"),
        ("observation", {"loss": {"failure": 2}}, "loss.failure: got 2; allowed: 0 … 1"),
    ],
)
def test_a_command_that_does_not_fit_is_refused(
    link: str, change: dict[str, Any], problem: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[str] = []

    class Refusing(Conductor):
        def _collected(self, *arguments: Any) -> None:
            super()._collected(*arguments)
            if not seen:
                with pytest.raises(UsageError) as refusal:
                    self.change_link(link, change)
                seen.append(str(refusal.value))

    monkeypatch.setattr("testbed.orchestrator.run.Conductor", Refusing)
    summary = run(scenario(steps=5, clock={"window": 1}, events=[], estimators=[{"name": "aoe"}]), tmp_path)
    assert seen[0].startswith(problem)
    assert (summary.status, summary.events) == ("complete", ())


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"loss": {"failure": 0.4}}, {"kind": "markov", "recovery": 0.5, "failure": 0.4}),
        ({"loss": {"loss": 0.5}}, {"kind": "markov", "recovery": 0.5, "failure": 0.5}),
        ({"loss": {"mean_burst": 4.0}}, {"kind": "markov", "recovery": 0.25, "failure": 0.25 * 0.375 / 0.625}),
        ({"loss": {"kind": "bernoulli", "arrival": 0.3}}, {"kind": "bernoulli", "arrival": 0.3}),
        ({"loss": "none"}, {"kind": "none"}),
    ],
)
def test_keys_change_one_by_one(change: dict[str, Any], expected: dict[str, Any]) -> None:
    link = Link.model_validate({"loss": {"kind": "markov", "recovery": 0.5, "failure": 0.3}})
    loss = changed(link, change).loss.model_dump(exclude_none=True)
    assert loss == {key: pytest.approx(value) if isinstance(value, float) else value for key, value in expected.items()}


def test_settings_on_the_command_line() -> None:
    texts = ["loss.failure=0.4", "loss.kind = markov", "delay.by='20 ms'", "rate=none", "delay.kind=constant"]
    assert together([parse_setting(text) for text in texts]) == {
        "loss": {"failure": 0.4, "kind": "markov"},
        "delay": {"by": "20 ms", "kind": "constant"},
        "rate": "none",
    }
    for text in ("loss", "=3", "loss.=3", "a b=3"):
        with pytest.raises(UsageError, match="allowed: KEY=VALUE"):
            parse_setting(text)
    with pytest.raises(UsageError, match="got a value and a table"):
        together([{"loss": {"failure": 1}}, {"loss": "none"}])


@pytest.mark.parametrize(
    ("wrong", "problem"),
    [
        (event(21, "control", loss="none"), "events[0].at: got 21; allowed: at most 20, the steps of the scenario"),
        (event("1 week", "control", loss="none"), "events[0].at: got '1 week'; allowed: a duration with a unit"),
        (event(-1, "control", loss="none"), "events[0].at: got -1; allowed: a step, 0 or more, or a duration such as"),
        (event(1, "control"), "events[0].set: got a table; allowed: a table with keys of the link"),
        (event(1, "control", los={}), "events[0].set: los: cannot be set while a run goes; allowed: loss, clock"),
        (event(1, "contro", loss="none"), "events[0].link: got 'contro'; allowed: control, observation, ack; did you"),
        ({**event(1, "control", loss="none"), "action": "sett"}, "events[0].action: got 'sett'; allowed: set, swap, "),
    ],
)
def test_wrong_events_are_one_line(wrong: dict[str, Any], problem: str) -> None:
    with pytest.raises(UsageError) as refusal:
        scenario(events=[wrong])
    assert str(refusal.value).startswith(f"scenario: {problem}")


def test_an_event_on_an_ack_link_that_is_none_is_refused() -> None:
    with pytest.raises(
        UsageError, match=r"events\[0\].link: got 'ack' with mode 'none'; allowed: only with mode 'link'"
    ):
        scenario(links={"ack": {"mode": "none"}}, events=[event(1, "ack", loss="none")])


def test_events_are_in_the_resolved_scenario() -> None:
    from testbed.scenario import to_toml

    given = scenario(events=[event("35 ms", "control", loss={"kind": "markov", "recovery": 0.5, "failure": 0.1})])
    assert parse_scenario(to_toml(given)) == given
    assert given.changes_of("control")[0][0] == 4
