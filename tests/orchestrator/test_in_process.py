"""Whole runs on the in-process bus: determinism, books, windows, who hears what, and how a run fails."""

from __future__ import annotations

import re
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from orchestrator.runs import BERNOULLI, MARKOV, SYSTEM, Recorded, figures, recorded, run, scenario
from testbed.errors import UsageError
from testbed.orchestrator.outcome import books
from testbed.orchestrator.run import Run
from testbed.orchestrator.summary import LinkFigures, Summary
from testbed.scenario import parse_scenario
from testbed.wire.asyncapi import asyncapi
from testbed.wire.memory_bus import MemoryBus, MemoryNetwork, matches

CLOSED = {
    "input": {"kind": "feedback", "gain": [[0.6, 0.3]], "estimator": "aoe"},
    "estimators": [{"name": "aoe", "acks": "none"}, {"name": "kfio", "acks": "perfect"}],
}
MARKOV_BOTH = {
    "links": {"control": {"loss": MARKOV}, "observation": {"loss": BERNOULLI}},
    "estimators": [{"name": "aoe"}, {"name": "oe", "until": 6}, {"name": "kfio", "acks": "perfect"}],
    "input": {"kind": "uniform", "low": -1.0, "high": 2.0},
}


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> tuple[Summary, Recorded]:
    out = tmp_path_factory.mktemp("base")
    summary = run(scenario(), out)
    return summary, recorded(out, 6, 20)


@pytest.fixture(scope="module")
def closed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Summary, Recorded]:
    out = tmp_path_factory.mktemp("closed")
    summary = run(scenario(**CLOSED), out)
    return summary, recorded(out, 6, 20)


def test_a_run_completes_and_refuses_nothing(base: tuple[Summary, Recorded]) -> None:
    summary, _ = base
    assert (summary.status, summary.reason, summary.completed_steps) == ("complete", None, 20)
    assert summary.rejected == {}
    assert all(check.ok for check in summary.checks)
    assert {check.name for check in summary.checks} >= {"books", "aoe within bounds", "oe within bounds"}


def assert_equal(one: Recorded, other: Recorded) -> None:
    assert one.keys() == other.keys()
    for topic in one:
        assert one[topic].keys() == other[topic].keys()
        for name, values in one[topic].items():
            np.testing.assert_array_equal(values, other[topic][name], err_msg=f"{topic} {name}")


VARIANTS: list[tuple[int | None, int | None, int | None]] = [
    (None, 1, None),
    (None, 4, None),
    (None, None, 1),
    (0, None, 3),
    (1, 2, None),
    (2, 5, 2),
    (3, 1, 7),
    (4, None, None),
]


@pytest.mark.parametrize(("schedule", "lanes_per_packet", "window"), VARIANTS)
def test_figures_depend_on_scenario_and_seed_alone(
    schedule: int | None,
    lanes_per_packet: int | None,
    window: int | None,
    base: tuple[Summary, Recorded],
    tmp_path: Path,
) -> None:
    transport = {} if lanes_per_packet is None else {"lanes_per_packet": lanes_per_packet}
    clock = {} if window is None else {"window": window}
    summary = run(scenario(transport=transport, clock=clock), tmp_path, schedule)
    assert figures(summary) == figures(base[0])
    assert_equal(recorded(tmp_path, 6, 20), base[1])


@pytest.mark.parametrize(("schedule", "lanes_per_packet"), [(None, 1), (1, 4), (2, None), (3, 2)])
def test_a_closed_loop_is_as_deterministic(
    schedule: int | None, lanes_per_packet: int | None, closed: tuple[Summary, Recorded], tmp_path: Path
) -> None:
    transport = {} if lanes_per_packet is None else {"lanes_per_packet": lanes_per_packet}
    summary = run(scenario(transport=transport, **CLOSED), tmp_path, schedule)
    assert figures(summary) == figures(closed[0])
    assert_equal(recorded(tmp_path, 6, 20), closed[1])


@pytest.mark.parametrize("schedule", [None, 1])
def test_markov_losses_on_both_links(schedule: int | None, tmp_path: Path) -> None:
    whole = run(scenario(**MARKOV_BOTH), tmp_path / "whole")
    split = run(scenario(transport={"lanes_per_packet": 1}, **MARKOV_BOTH), tmp_path / "split", schedule)
    assert whole.status == "complete"
    assert figures(whole) == figures(split)


def test_gilbert_elliott_losses_on_all_links(tmp_path: Path) -> None:
    loss = {"kind": "gilbert-elliott", "to_bad": 0.2, "to_good": 0.3, "loss_good": 0.1, "loss_bad": 0.7}
    links = {"control": {"loss": loss}, "observation": {"loss": loss}, "ack": {"mode": "link", "loss": loss}}
    kinds = [
        {"name": "kfio", "acks": "perfect"},
        {"name": "aoe"},
        {"name": "imm"},
        {"name": "gpb", "order": 3},
        {"name": "pf", "particles": 50},
    ]
    given = {"links": links, "estimators": kinds, "steps": 12}
    whole = run(scenario(**given), tmp_path / "whole")
    split = run(scenario(transport={"lanes_per_packet": 1}, **given), tmp_path / "split", 1)
    assert whole.status == "complete"
    assert figures(whole) == figures(split)
    assert all(0 < link.dropped < link.sent == 72 for link in whole.links.values())
    assert {check.name: check.ok for check in whole.checks}["books"]
    assert whole.bounds is not None
    assert whole.bounds.upper_correlated_mean is not None


@pytest.mark.parametrize(("lanes_per_packet", "schedule"), [(7, None), (64, 1), (100, 2), (1, None)])
def test_figures_of_many_lanes_do_not_depend_on_the_packets(
    lanes_per_packet: int, schedule: int | None, tmp_path: Path
) -> None:
    own = {"lanes": 150, "steps": 4, "record": "none", "estimators": [{"name": "aoe"}, {"name": "ff"}, {"name": "oe"}]}
    whole = run(scenario(**own), tmp_path / "whole")
    split = run(scenario(transport={"lanes_per_packet": lanes_per_packet}, **own), tmp_path / "split", schedule)
    assert figures(split) == figures(whole)


def test_several_inputs_and_outputs_and_noise_through_G(tmp_path: Path) -> None:
    system = {
        "A": [[1.05, 0.1, 0.0], [0.0, 0.9, -0.2], [0.1, 0.0, 0.5]],
        "B": [[1.0, 0.0], [0.0, 0.0], [-1.0, 2.0]],
        "C": [[1.0, 0.0, 0.5], [0.0, 1.0, 0.0]],
        "G": [[1.0], [0.5], [0.0]],
        "Q": [[0.3]],
        "R": [[0.5, 0.1], [0.1, 0.4]],
        "P0": [[1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 2.0]],
    }
    source = {"kind": "uniform", "low": [-1.0, 0.0], "high": [1.0, 3.0]}
    whole = run(scenario(system=system, input=source), tmp_path / "whole")
    split = run(scenario(system=system, input=source, transport={"lanes_per_packet": 1}), tmp_path / "split", 1)
    assert whole.status == "complete"
    assert figures(split) == figures(whole)
    assert_equal(recorded(tmp_path / "split", 6, 20), recorded(tmp_path / "whole", 6, 20))


def test_a_lane_does_not_depend_on_the_lanes_beside_it(base: tuple[Summary, Recorded], tmp_path: Path) -> None:
    for lanes in (1, 3):
        run(scenario(lanes=lanes), tmp_path)
        expected = {t: {n: values[:, :lanes] for n, values in arrays.items()} for t, arrays in base[1].items()}
        assert_equal(recorded(tmp_path, lanes, 20), expected)


def test_a_step_does_not_depend_on_the_steps_that_follow(base: tuple[Summary, Recorded], tmp_path: Path) -> None:
    summary = run(scenario(steps=11), tmp_path)
    assert summary.estimators["aoe"].nees_mean == base[0].estimators["aoe"].nees_mean[:11]


def test_another_seed_is_another_run(base: tuple[Summary, Recorded], tmp_path: Path) -> None:
    other = run(scenario(seed=8), tmp_path)
    assert not set(other.estimators["kfio"].squared_error_mean) & set(base[0].estimators["kfio"].squared_error_mean)
    assert other.links != base[0].links


def test_estimators_see_the_same_packets_whatever_else_runs(base: tuple[Summary, Recorded], tmp_path: Path) -> None:
    alone = run(scenario(estimators=[{"name": "aoe", "acks": "none"}], bounds=False), tmp_path)
    assert alone.estimators["aoe"] == base[0].estimators["aoe"]
    assert alone.links == base[0].links
    assert alone.bounds is None


def test_the_books_balance(base: tuple[Summary, Recorded]) -> None:
    summary, record = base
    for name, link in summary.links.items():
        mask = record[f"{name}/delivered"]["mask"]
        assert link.sent == 120 == link.delivered + link.dropped
        assert link.delivered == int(mask.sum())
        moves = link.transitions
        assert moves.lost_lost + moves.lost_delivered + moves.delivered_lost + moves.delivered_delivered == 6 * 19
        before, after = mask[:-1], mask[1:]
        assert moves.lost_delivered == int(((before == 0) & (after == 1)).sum())
        assert moves.delivered_lost == int(((before == 1) & (after == 0)).sum())
        assert link.loss_rate == link.dropped / link.sent
        bursts = int((mask[0] == 0).sum()) + moves.delivered_lost
        assert link.mean_burst == (link.dropped / bursts if bursts else None)
    np.testing.assert_array_equal(record["truth"]["nu"], record["control/delivered"]["mask"])


def test_what_is_lost_is_blank_and_what_arrives_is_as_sent(base: tuple[Summary, Recorded]) -> None:
    _, record = base
    for link, content in (("control", "u"), ("observation", "y"), ("ack", "nu")):
        sent, arrived = record[f"{link}/sent"][content], record[f"{link}/delivered"]
        mask = arrived["mask"] == 1
        np.testing.assert_array_equal(arrived[content][mask], sent[mask])
        assert not arrived[content][~mask].any()
        assert 0 < mask.sum() < mask.size


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({}, True),
        ({"sent": 119, "delivered": 99}, False),
        ({"delivered": 99}, False),
        ({"dropped": 21}, False),
        ({"delivered": 101, "dropped": 19}, False),
        (None, False),
    ],
)
def test_books_that_do_not_balance_are_found(change: dict[str, int] | None, expected: bool) -> None:
    good = {"sent": 120, "delivered": 100, "dropped": 20}
    links = {"observation": LinkFigures(**good)}
    if change is not None:
        links["control"] = LinkFigures(**{**good, **change})
    (check,) = books(scenario(), links, applied=100)
    assert check.ok is expected


def test_until_ends_an_estimator_and_nothing_else(base: tuple[Summary, Recorded]) -> None:
    summary, record = base
    for name, until in (("oe", 7), ("oe-acks", 9)):
        own = summary.estimators[name]
        assert own.until == until
        assert [v is None for v in own.trace_P_mean] == [False] * until + [True] * (20 - until)
        assert [v is None for v in own.excess_stderr] == [False] * until + [True] * (20 - until)
        assert np.isnan(record[f"estimate/{name}"]["x_hat"][until:]).all()
    assert all(v is not None for v in summary.estimators["aoe"].trace_P_mean)


def test_acks_are_those_the_scenario_gives(base: tuple[Summary, Recorded]) -> None:
    acks = {name: own.acks for name, own in base[0].estimators.items()}
    expected = {"aoe": "none", "aoe-acks": "link", "ff": "none", "kfio": "perfect", "oe": "none", "oe-acks": "link"}
    assert acks == expected


def test_with_perfect_acks_they_are_all_one_filter(tmp_path: Path) -> None:
    kinds = ["kfio", "aoe", "ff", "oe"]
    run(scenario(estimators=[{"name": kind, "acks": "perfect"} for kind in kinds]), tmp_path)
    record = recorded(tmp_path, 6, 20)
    for kind in kinds[1:]:
        for name in ("x_hat", "P"):
            expected = record["estimate/kfio"][name]
            np.testing.assert_allclose(record[f"estimate/{kind}"][name], expected, rtol=1e-9, atol=1e-10)


def test_perfect_acks_on_the_link_are_perfect_acks(tmp_path: Path) -> None:
    links = {"control": {"loss": BERNOULLI}, "observation": {"loss": MARKOV}, "ack": {"mode": "perfect"}}
    one = run(scenario(links=links, estimators=[{"name": "aoe"}, {"name": "kfio"}]), tmp_path / "one")
    own = [{"name": "aoe", "acks": "perfect"}, {"name": "kfio", "acks": "perfect"}]
    other = run(scenario(links={k: links[k] for k in ("control", "observation")}, estimators=own), tmp_path / "other")
    for name in ("aoe", "kfio"):
        assert one.estimators[name] == other.estimators[name]
    assert one.links["ack"].dropped == 0
    assert "ack" not in other.links


def test_the_lower_bound_is_the_covariance_with_acks(base: tuple[Summary, Recorded]) -> None:
    summary, _ = base
    assert summary.bounds is not None
    np.testing.assert_allclose(summary.bounds.lower_mean, summary.estimators["kfio"].trace_P_mean, rtol=1e-12)
    upper = summary.bounds.upper_mean
    assert upper is not None
    for name, until in (("aoe", 20), ("oe", 7)):
        for k in range(until):
            mean = summary.estimators[name].trace_P_mean[k]
            assert mean is not None
            assert summary.bounds.lower_mean[k] * (1 - 1e-12) <= mean <= upper[k] * (1 + 1e-12)  # type: ignore[operator]


def test_more_acks_do_not_hurt_on_average(tmp_path: Path) -> None:
    """Conditional expectation given more is better: tr E[P] of OE without, with some and with all ACKs."""
    names = {"none": "none", "some": None, "all": "perfect"}
    own = [{"name": n, "kind": "oe", **({"acks": acks} if acks else {})} for n, acks in names.items()]
    summary = run(scenario(lanes=300, steps=7, record="none", estimators=own), tmp_path)
    for k in range(1, 7):  # u_0 = 0: at the first step there is nothing to know
        none, some, every = (summary.estimators[name].trace_P_mean[k] for name in names)
        assert every < some < none  # type: ignore[operator]


def test_exact_estimators_are_consistent(tmp_path: Path) -> None:
    """E[‖x − x̂‖²] = E[tr P] for OE and KFIO at every step; the NEES of KFIO, which is Gaussian, is χ²."""
    own = [{"name": "oe", "acks": "none"}, {"name": "oe-acks", "kind": "oe"}, {"name": "kfio", "acks": "perfect"}]
    summary = run(scenario(lanes=4000, steps=7, record="none", estimators=own), tmp_path)
    for figures_of in summary.estimators.values():
        for mean, error in zip(figures_of.excess_mean, figures_of.excess_stderr, strict=True):
            assert abs(mean) < 4.0 * error  # type: ignore[arg-type, operator]
    kfio = summary.estimators["kfio"]
    low, high = kfio.nees_band_95
    centre, width = (low + high) / 2, high - low
    assert all(abs(nees - centre) < width for nees in kfio.nees_mean)  # type: ignore[operator]
    assert centre == pytest.approx(2.0, rel=1e-3)


def test_the_loop_is_closed_through_the_estimate(closed: tuple[Summary, Recorded]) -> None:
    summary, record = closed
    gain = np.array([[0.6, 0.3]])
    u, x_hat = record["control/sent"]["u"], record["estimate/aoe"]["x_hat"]
    np.testing.assert_allclose(u[0], np.tile(-gain @ SYSTEM["x0_mean"], (6, 1)), rtol=1e-14)
    np.testing.assert_allclose(u[1:], -x_hat[:-1] @ gain.T, rtol=1e-13, atol=1e-14)
    assert summary.timing.window == 1
    assert summary.bounds is not None
    assert summary.bounds.upper_mean is None
    assert "feedback" in str(summary.bounds.upper_reason)


def test_a_closed_loop_holds_what_an_open_one_loses(tmp_path: Path) -> None:
    """A = 1.1 in one mode: without feedback the state grows, with it it stays small."""
    own = {"lanes": 200, "steps": 40, "links": {}, "estimators": [{"name": "kfio"}]}
    closed_loop = {"input": {"kind": "feedback", "gain": [[0.6, 0.3]]}, **own}
    run(scenario(**closed_loop), tmp_path / "closed")
    run(scenario(input={"kind": "constant", "value": [0.0]}, **own), tmp_path / "open")
    spread = [(recorded(tmp_path / d, 200, 40)["truth"]["x"][-1] ** 2).sum(axis=1).mean() for d in ("closed", "open")]
    assert spread[1] > 20.0 * spread[0]


class Watched(MemoryNetwork):
    """Notes every publication, and who listens to what."""

    current: Watched

    def __init__(self, seed: int | None = None, **rest: Any) -> None:
        super().__init__(seed, **rest)
        type(self).current = self
        self.buses: list[MemoryBus] = []
        self.published: list[tuple[str, bytes]] = []
        self.listeners: list[tuple[str, int]] = []

    def bus(self) -> MemoryBus:
        self.buses.append(super().bus())
        return self.buses[-1]

    def _publish(self, key: str, payload: bytes) -> None:
        self.published.append((key, payload))
        super()._publish(key, payload)

    def _subscribe(self, key: str, bus: MemoryBus, handler: Any) -> None:
        self.listeners.append((key, self.buses.index(bus)))
        super()._subscribe(key, bus, handler)


def topic(key: str) -> str:
    return key.split("/", 2)[2]


def step_of(payload: bytes) -> int:
    match = re.search(rb'"step": *(\d+)', payload)
    assert match is not None
    return int(match[1])


@pytest.mark.parametrize("window", [1, 2, 5, None])
@pytest.mark.parametrize("schedule", [None, 3])
def test_no_more_steps_without_all_estimates_are_sent_than_the_window(
    window: int | None, schedule: int | None, tmp_path: Path
) -> None:
    clock = {} if window is None else {"window": window}
    made = scenario(clock=clock, record="none", steps=30, lanes=4, transport={"lanes_per_packet": 2})
    summary = run(made, tmp_path, schedule, Watched)
    allowed = summary.timing.window
    assert allowed is not None
    assert window in (None, allowed)
    done: dict[int, int] = defaultdict(int)
    complete, ahead = 0, []
    for key, payload in Watched.current.published:
        what = topic(key)
        if what == "control/sent":
            ahead.append(step_of(payload) + 1 - complete)
        elif what.startswith("estimate/"):
            done[step_of(payload)] += 1
            while done[complete + 1] == 2 * estimators_at(complete + 1):
                complete += 1
    assert complete == 30
    assert max(ahead) == min(allowed, 30)


def estimators_at(k: int) -> int:
    """Of the scenario: four that run to the end, and two that end early."""
    return 4 + (k <= 7) + (k <= 9)


def test_everybody_hears_what_is_theirs(tmp_path: Path) -> None:
    """Truth goes to the orchestrator alone; an estimator hears u, what arrives of y, and its ACKs."""
    run(scenario(record="none"), tmp_path, None, Watched)
    network = Watched.current
    heard: dict[int, set[str]] = defaultdict(set)
    for key, bus in network.listeners:
        heard[bus].add(topic(key))
    names = ["orchestrator", "controller", "plant", "control", "observation", "ack", "bounds"]
    names += ["aoe", "aoe-acks", "ff", "kfio", "oe", "oe-acks"]
    by_name = {name: heard[i] - {"command"} for i, name in enumerate(names)}
    assert len(network.buses) == len(names)
    assert [name for name in names if "truth" in by_name[name]] == ["orchestrator"]
    assert by_name["controller"] == {"clock", "controller/change"}
    assert by_name["plant"] == {"control/delivered", "plant/change"}
    assert by_name["bounds"] == {"observation/delivered"}
    for link in ("control", "observation", "ack"):
        assert by_name[link] == {f"{link}/sent", f"{link}/change"}
    blind = {"control/sent", "observation/delivered"}
    assert by_name["aoe"] == by_name["ff"] == by_name["oe"] == blind
    assert by_name["aoe-acks"] == by_name["oe-acks"] == blind | {"ack/delivered"}
    assert by_name["kfio"] == blind | {"ack/sent"}


def test_every_key_of_a_run_is_documented(tmp_path: Path) -> None:
    run(scenario(record="first"), tmp_path, None, Watched)
    patterns = [re.sub(r"\{\w+\}", "*", channel["address"]) for channel in asyncapi()["channels"].values()]
    keys = {key for key, _ in Watched.current.published}
    assert all(sum(matches(pattern, key) for pattern in patterns) == 1 for key in keys)
    unused = [pattern for pattern in patterns if not any(matches(pattern, key) for key in keys)]
    assert all(pattern.endswith("/change") for pattern in unused), "only where one is ordered"


def test_progress_is_told_step_by_step(tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    Run(scenario(record="none"), tmp_path, progress=lambda done, of: told.append((done, of))).in_process()
    assert told[-1] == (20, 20)
    assert [of for _, of in told] == [20] * len(told)
    assert [done for done, _ in told] == sorted({done for done, _ in told})
    assert (tmp_path / "report.html").exists()
    assert not (tmp_path / "recording.mcap").exists()


class Forgetful(MemoryNetwork):
    """Loses the observation of step 5 on its way out of the link."""

    def _publish(self, key: str, payload: bytes) -> None:
        if not (topic(key) == "observation/delivered" and step_of(payload) == 5):
            super()._publish(key, payload)


def test_a_message_that_the_transport_loses_fails_the_run(tmp_path: Path) -> None:
    summary = run(scenario(estimators=[{"name": "aoe", "acks": "none"}]), tmp_path, None, Forgetful)
    assert (summary.status, summary.completed_steps) == ("failed", 4)
    assert "step 5: bounds, estimate of aoe" in str(summary.reason)
    assert summary.rejected["estimator.aoe"]["sequence"] > 0
    assert len(summary.estimators["aoe"].trace_P_mean) == 4


def test_an_observation_that_overflows_fails_the_run(tmp_path: Path) -> None:
    system = {"A": [[1.0]], "C": [[1e300]], "Q": [[1e20]], "R": [[1.0]]}
    summary = run(parse_scenario({"system": system, "estimators": [{"name": "kfio"}]}), tmp_path)
    assert summary.status == "failed"
    assert "left the range of floating-point numbers at step 1" in str(summary.reason)


def test_an_estimate_that_overflows_fails_the_run(tmp_path: Path) -> None:
    system = {"A": [[1e10]], "C": [[1.0]], "Q": [[1.0]], "R": [[1.0]], "P0": [[1e300]]}
    lost = {"observation": {"loss": {"kind": "bernoulli", "arrival": 0.0}}}
    own = {"system": system, "links": lost, "steps": 3, "bounds": False}
    summary = run(parse_scenario({**own, "estimators": [{"name": "kfio"}]}), tmp_path)
    assert summary.status == "failed"
    assert summary.reason == "the estimate of 'kfio' left the range of floating-point numbers at step 1"


def test_estimators_that_all_end_early_do_not_stop_the_run(tmp_path: Path) -> None:
    own = [{"name": "aoe", "acks": "none", "until": 5}, {"name": "kfio", "acks": "perfect", "until": 2}]
    for window in (1, 3):
        summary = run(scenario(estimators=own, clock={"window": window}), tmp_path)
        assert (summary.status, summary.completed_steps) == ("complete", 20)
        assert [mean is None for mean in summary.estimators["aoe"].trace_P_mean] == [False] * 5 + [True] * 15


def test_a_state_that_overflows_fails_the_run(tmp_path: Path) -> None:
    system = {"A": [[1e100]], "C": [[1.0]], "Q": [[1.0]], "R": [[1.0]]}
    own = {"system": system, "steps": 9, "links": {"observation": {"loss": {"kind": "bernoulli", "arrival": 0.0}}}}
    for lanes in (1, 3):
        for window, completed in ((1, 1), (9, 0)):
            tables = {**own, "lanes": lanes, "clock": {"window": window}, "estimators": [{"name": "kfio"}]}
            summary = run(parse_scenario(tables), tmp_path / f"{lanes}-{window}")
            assert summary.status == "failed"
            assert "left the range of floating-point numbers at step" in str(summary.reason)
            assert summary.completed_steps == completed


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"estimators": []}, "no [[estimators]]"),
        ({"estimators": [{"name": "kalman"}]}, "estimators.kalman: unknown estimator 'kalman'"),
        ({"estimators": [{"name": "aoe", "depth": 3}]}, "estimators.aoe: estimator 'aoe': unknown option 'depth'"),
        ({"estimators": [{"name": "kfio", "acks": "none"}]}, "estimators.kfio: kfio needs every ACK"),
        ({"estimators": [{"name": "kfio"}]}, "estimators.kfio: kfio needs every ACK"),
        (
            {"estimators": [{"name": "oe-exact", "acks": "none"}]},
            "estimators.oe-exact: oe-exact enumerates 2^k histories",
        ),
        ({"estimators": [{"name": "ff"}], "links": MARKOV_BOTH["links"]}, "estimators.ff: "),
    ],
)
def test_what_cannot_run_is_refused_before_anything_starts(
    changes: dict[str, Any], expected: str, tmp_path: Path
) -> None:
    with pytest.raises(UsageError) as refusal:
        Run(scenario(**{"steps": 40, **changes}), tmp_path / "out")
    assert expected in str(refusal.value)
    assert len(str(refusal.value).splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_a_system_without_input_runs(tmp_path: Path) -> None:
    system = {key: value for key, value in SYSTEM.items() if key != "B"}
    own = {"system": system, "steps": 8, "lanes": 3, "record": "all", "links": {"observation": {"loss": MARKOV}}}
    made = parse_scenario({**own, "estimators": [{"name": "kfio"}, {"name": "aoe"}, {"name": "ff"}, {"name": "oe"}]})
    summary = run(made, tmp_path)
    assert summary.status == "complete"
    kfio = summary.estimators["kfio"]
    for other in ("aoe", "ff", "oe"):
        np.testing.assert_allclose(summary.estimators[other].trace_P_mean, kfio.trace_P_mean, rtol=1e-12)
        np.testing.assert_allclose(summary.estimators[other].nees_mean, kfio.nees_mean, rtol=1e-9)
