"""Whole runs over links that take time: what is known at each step, and what estimators make of it, by definition.

What arrives when is told by the pipelines of the lanes, asked directly; what follows from it by conditioning the
stacked Gaussian, and by estimators that are given the same packets by hand.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from estimator.reference import gaussian
from estimator.reference.cases import System
from orchestrator.runs import BERNOULLI, MARKOV, SYSTEM, Recorded, figures, late_ones, recorded, run, scenario, tables
from testbed.channel.packets import packet_bytes
from testbed.channel.pipeline import Pipeline
from testbed.cli.main import run_command
from testbed.estimator.model import Ack
from testbed.estimator.packets import read_packets, replay
from testbed.estimator.refilter import LateObservation, Refilter
from testbed.estimator.registry import create, model_of
from testbed.orchestrator.recording import packets_of_recording
from testbed.orchestrator.summary import Summary
from testbed.scenario import Scenario, parse_scenario, to_toml

MS = 1_000_000
PERIOD = 10 * MS
STEPS, LANES = 16, 4
NEVER = 10**6
BY = "10 ms"
MESSY: dict[str, Any] = {
    "delay": {"kind": "uniform", "low": "1 ms", "high": "38 ms"},
    "reorder": {"chance": 0.2, "by": "20 ms"},
    "duplicate": {"chance": 0.3, "after": "7 ms"},
    "corrupt": {"chance": 0.15},
}
KINDS = [
    {"name": "aoe", "acks": "none"},
    {"name": "aoe-acks", "kind": "aoe"},
    {"name": "kfio", "acks": "perfect"},
    {"name": "imm"},
    {"name": "gpb", "order": 2},
    {"name": "oe", "until": 7},
    {"name": "short", "kind": "kfio", "acks": "perfect", "buffer": 1},
    {"name": "none", "kind": "kfio", "acks": "perfect", "buffer": 0},
]
LINKS: dict[str, dict[str, Any]] = {
    "messy": {
        "control": {"loss": BERNOULLI, "delay": {"kind": "uniform", "low": "2 ms", "high": "12 ms"}},
        "observation": {"loss": MARKOV, **MESSY},
        "ack": {"mode": "link", "loss": BERNOULLI, **MESSY},
    },
    "batches": {
        "control": {"loss": MARKOV},
        "observation": {"delay": {"kind": "constant", "by": "25 ms"}, "loss": BERNOULLI, "deadline": "3 ms"},
        "ack": {"mode": "link", "loss": {"kind": "bernoulli", "arrival": 0.5}, "batch": 4, **MESSY},
    },
    "slots": {
        "control": {"loss": MARKOV, "clock": "time", "slot": "5 ms", "corrupt": {"chance": 0.1}},
        "observation": {"loss": MARKOV, "clock": "time", "slot": "15 ms", "delay": MESSY["delay"] | {"in_order": True}},
        "ack": {"mode": "link", "rate": {"bits_per_second": 1.2e5, "queue_packets": 4}, "batch": 2},
    },
}


@dataclass(frozen=True)
class Ran:
    """A run, and when each packet comes: step (STEPS, LANES), NEVER if it does not."""

    given: Scenario
    summary: Summary
    record: Recorded
    out: Path

    def comes(self, link: str) -> Any:
        settings = getattr(self.given.links, link)
        deadline, size = settings.deadline_ns(PERIOD), packet_bytes(self.given, link)
        first = 0 if link == "control" else 1
        result = np.full((STEPS, LANES), NEVER)
        for lane in range(LANES):
            pipe = Pipeline(settings, self.given.seed, f"link.{link}", lane)
            for i in range(STEPS):
                times = [copy.at_ns for copy in pipe.send(size, i * PERIOD) if copy.flip is None]
                if times:
                    result[i, lane] = max(0, -((deadline - min(times)) // PERIOD), i) + first
        return result

    def learnt(self) -> Any:
        """When ν_j is learnt over the ACK link, [j, lane]: with the first packet of its batch that comes."""
        comes, batch = self.comes("ack"), self.given.links.ack.batch
        return np.array([comes[j : j + batch].min(axis=0) for j in range(STEPS)])


@pytest.fixture(scope="module", params=LINKS)
def ran(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Ran:
    out = tmp_path_factory.mktemp(request.param)
    given = scenario(steps=STEPS, lanes=LANES, estimators=KINDS, links=LINKS[request.param])
    return Ran(given, run(given, out), recorded(out, LANES, STEPS), out)


def test_what_comes_is_what_the_pipelines_say(ran: Ran) -> None:
    sent = ran.record["observation/sent"]["y"]
    comes, step = ran.comes("observation"), np.arange(1, STEPS + 1)[:, None]
    np.testing.assert_array_equal(ran.record["observation/delivered"]["mask"], comes == step)
    expected = [
        (int(comes[k - 1, lane]), k, lane, sent[k - 1, lane].tolist())
        for k, lane in np.ndindex(STEPS + 1, LANES)
        if k and k < comes[k - 1, lane] <= STEPS
    ]
    assert late_ones(ran.out, "observation/delivered", "y") == sorted(expected, key=lambda one: one[:3])
    assert len(expected) > 10


def test_what_is_learnt_of_the_control_packets_is_in_the_acks_that_came(ran: Ran) -> None:
    nu, known = ran.record["truth"]["nu"], ran.learnt()
    if ran.given.links.ack.batch == 4:
        assert (known < ran.comes("ack")).any()
    for lane in range(LANES):
        lines = [
            json.loads(line) for line in packets_of_recording(ran.out / "recording.mcap", lane, perfect_acks=False)
        ]
        for line in lines:
            expected = [[j, int(nu[j, lane])] for j in range(STEPS) if known[j, lane] == line["k"]]
            assert sorted(line["acks"]) == expected, (lane, line["k"])


def test_a_control_packet_that_is_late_is_not_applied(ran: Ran) -> None:
    comes, step = ran.comes("control"), np.arange(STEPS)[:, None]
    np.testing.assert_array_equal(ran.record["truth"]["nu"], comes == step)
    late = int(((comes > step) & (comes < STEPS)).sum())
    assert ran.summary.links["control"].causes.get("late", 0) == late
    assert (late > 0) == (ran.given.links.control.delay is not None)


def test_the_books_add_up(ran: Ran) -> None:
    for name, link in ran.summary.links.items():
        comes, first = ran.comes(name), int(name != "control")
        step = np.arange(first, STEPS + first)[:, None]
        done = STEPS + first
        assert link.sent == STEPS * LANES
        assert link.sent + link.duplicated == link.delivered + link.dropped + link.in_flight
        assert link.dropped == sum(link.causes.values())
        late = int(((comes > step) & (comes < done)).sum())
        assert link.late == late
        assert link.delivered == int((comes == step).sum()) + (late if name != "control" else 0)
    assert {check.name: check.ok for check in ran.summary.checks}["books"]


def by_hand(ran: Ran, spec: dict[str, Any], lane: int) -> Iterator[tuple[Any, Any]]:
    """x̂ and P of an estimator of one lane that is given what has come."""
    options = {key: value for key, value in spec.items() if key not in ("name", "kind", "acks", "buffer", "until")}
    made = create(spec.get("kind", spec["name"]), model_of(ran.given), lanes=1, options=options, lane=lane)
    estimator = Refilter(made, spec.get("buffer", 20))
    u, y, nu = ran.record["control/sent"]["u"], ran.record["observation/sent"]["y"], ran.record["truth"]["nu"]
    comes = ran.comes("observation")[:, lane]
    learnt = {"none": np.full(STEPS, NEVER), "perfect": np.arange(1, STEPS + 1)}.get(
        spec.get("acks", ""), ran.learnt()[:, lane]
    )
    yes = np.ones(1, dtype=bool)
    for k in range(1, spec.get("until", STEPS) + 1):
        late = [LateObservation(j, y[j - 1, lane][None], yes) for j in range(1, k) if comes[j - 1] == k]
        acks = tuple(Ack(j, nu[j, lane][None].astype(int), yes) for j in range(k) if learnt[j] == k)
        arrived = np.array([comes[k - 1] == k])
        estimate = estimator.step(u[k - 1, lane][None], y[k - 1, lane][None] * arrived, arrived, acks, late)
        yield estimate.x_hat[0], estimate.P[0]


@pytest.mark.parametrize("spec", KINDS, ids=lambda spec: spec["name"])
def test_estimates_are_those_of_an_estimator_that_is_given_what_has_come(ran: Ran, spec: dict[str, Any]) -> None:
    record = ran.record[f"estimate/{spec['name']}"]
    for lane in range(LANES):
        for k, (x_hat, P) in enumerate(by_hand(ran, spec, lane)):
            np.testing.assert_array_equal(record["x_hat"][k, lane], x_hat, err_msg=f"lane {lane}, step {k + 1}")
            np.testing.assert_array_equal(record["P"][k, lane], P)


def test_the_recording_replays_to_the_estimates(ran: Ran) -> None:
    model = model_of(ran.given)
    for spec in ran.given.estimators:
        record = ran.record[f"estimate/{spec.name}"]
        for lane in range(LANES):
            made = create(spec.kind, model, lanes=1, options=spec.options, lane=lane)
            refilter = Refilter(made, 20 if spec.buffer is None else spec.buffer)
            texts = packets_of_recording(ran.out / "recording.mcap", lane, perfect_acks=spec.acks == "perfect")
            lines = replay(refilter, model, read_packets(texts, model), use_acks=spec.acks != "none", until=spec.until)
            for k, line in enumerate(map(json.loads, lines)):
                assert line["x_hat"] == record["x_hat"][k, lane].tolist()
                assert line["P"] == record["P"][k, lane].tolist()


def test_the_command_replays_a_recording(ran: Ran, tmp_path: Path) -> None:
    source, out = tmp_path / "s.toml", tmp_path / "out.jsonl"
    source.write_text(to_toml(ran.given))
    arguments = ["replay", str(source), str(ran.out / "recording.mcap"), "--lane", "2", "--out", str(out)]
    for name in ("kfio", "aoe-acks"):
        assert run_command([*arguments, "--estimator", name, "--buffer", "20"]) == 0
        lines = [json.loads(line) for line in out.read_text().splitlines()]
        assert [line["x_hat"] for line in lines] == ran.record[f"estimate/{name}"]["x_hat"][:, 2].tolist()


def system() -> System:
    arrays = {name: np.array(value) for name, value in SYSTEM.items()}
    return System(**arrays, recovery=0.7, failure=0.3, start=0.7)


def test_the_lower_bound_is_that_of_what_has_come_and_holds_for_all(ran: Ran) -> None:
    comes, bound = ran.comes("observation"), ran.record["bounds"]["trace_lower"]
    for lane in range(LANES):
        for k in range(1, STEPS + 1):
            expected = np.trace(gaussian.lower_bound(system(), comes[:k, lane] <= k))
            assert bound[k - 1, lane] == pytest.approx(expected, rel=1e-9)
    for spec in KINDS:
        until = spec.get("until", STEPS)
        trace = np.trace(ran.record[f"estimate/{spec['name']}"]["P"][:until], axis1=2, axis2=3)
        assert (trace >= bound[:until] * (1 - 1e-9)).all(), spec


def test_with_a_long_memory_it_is_as_if_all_had_come_in_time(ran: Ran) -> None:
    record, comes = ran.record, ran.comes("observation")
    u, y, nu = record["control/sent"]["u"], record["observation/sent"]["y"], record["truth"]["nu"]
    for lane in range(LANES):
        for k in (1, 2, 5, 9, STEPS):
            arrived = comes[:k, lane] <= k
            x_hat, P = gaussian.kfio(system(), u[:k, lane], y[:k, lane], arrived, nu[:k, lane].astype(int))
            np.testing.assert_allclose(record["estimate/kfio"]["x_hat"][k - 1, lane], x_hat, rtol=1e-8, atol=1e-9)
            np.testing.assert_allclose(record["estimate/kfio"]["P"][k - 1, lane], P, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize(
    ("by", "deadline", "steps"),
    [
        ("10 ms", "10 ms", 0),
        ("10 ms", "9 ms", 1),
        ("20 ms", "10 ms", 1),
        ("20 ms", "4 ms", 2),
        ("30 ms", "10 ms", 2),
        ("30 ms", "1 ns", 3),
        ("31 ms", "10 ms", 3),
        ("8 ms", "7 ms", 1),
        ("8 ms", "8 ms", 0),
    ],
)
def test_when_all_is_late_the_estimate_is_a_prediction(by: str, deadline: str, steps: int, tmp_path: Path) -> None:
    """x̂_k is the mean of x_k given y_1 … y_{k−d}; without a memory that reaches so far, it is given nothing at all."""
    observation = {"delay": {"kind": "constant", "by": by}, "deadline": deadline}
    kinds = [
        {"name": "kfio", "buffer": steps},
        {"name": "oe", "until": 7},
        {"name": "short", "kind": "kfio", "buffer": max(0, steps - 1)},
        {"name": "usual", "kind": "kfio"},
    ]
    links = {"control": {"loss": BERNOULLI}, "observation": observation, "ack": {"mode": "perfect"}}
    given = scenario(steps=10, lanes=2, estimators=kinds, links=links)
    run(given, tmp_path)
    record = recorded(tmp_path, 2, 10)
    u, y, nu = record["control/sent"]["u"], record["observation/sent"]["y"], record["truth"]["nu"]
    for lane, k in np.ndindex(2, 10):
        for name in ("kfio", "short", "usual"):
            has = k + 1 - steps if name != "short" or steps == 0 else 0
            arrived = np.arange(1, k + 2) <= has
            pushed = nu[: k + 1, lane].astype(int)
            x_hat, P = gaussian.kfio(system(), u[: k + 1, lane], y[: k + 1, lane], arrived, pushed)
            np.testing.assert_allclose(record[f"estimate/{name}"]["x_hat"][k, lane], x_hat, rtol=1e-9, atol=1e-10)
            np.testing.assert_allclose(record[f"estimate/{name}"]["P"][k, lane], P, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize(("lanes_per_packet", "schedule"), [(1, 1), (3, None), (None, 2)])
def test_figures_do_not_depend_on_packets_or_order(
    lanes_per_packet: int | None, schedule: int | None, ran: Ran, tmp_path: Path
) -> None:
    given = ran.given.model_copy(
        update={"transport": ran.given.transport.model_copy(update={"lanes_per_packet": lanes_per_packet})}
    )
    assert figures(run(given, tmp_path, schedule)) == figures(ran.summary)
    for topic in ("observation/delivered", "ack/delivered"):
        content = "nu" if topic.startswith("ack") else "y"
        assert late_ones(tmp_path, topic, content) == late_ones(ran.out, topic, content)
    again = recorded(tmp_path, LANES, STEPS)
    for topic, arrays in ran.record.items():
        for name, values in arrays.items():
            np.testing.assert_array_equal(again[topic][name], values, err_msg=f"{topic} {name}")


def test_a_link_in_time_is_a_link_without_time(tmp_path: Path) -> None:
    """A delay within the deadline, and copies, change nothing."""
    quick = {"delay": {"kind": "uniform", "low": "0 s", "high": "10 ms"}, "duplicate": {"chance": 0.5}}
    plain = tables(steps=STEPS, lanes=LANES)
    timed = {name: {**table, **quick} for name, table in plain["links"].items()}
    one = run(parse_scenario(plain), tmp_path / "plain")
    other = run(parse_scenario({**plain, "links": timed}), tmp_path / "timed")
    assert other.estimators.keys() == one.estimators.keys()
    for name, own in one.estimators.items():
        assert other.estimators[name].trace_P_mean == own.trace_P_mean
        assert other.estimators[name].squared_error_mean == own.squared_error_mean
    assert other.bounds == one.bounds
    for name, link in one.links.items():
        assert other.links[name].transitions == link.transitions
        assert (other.links[name].sent, other.links[name].delivered) == (link.sent, link.delivered)


def test_a_closed_loop_over_late_links_is_as_deterministic(tmp_path: Path) -> None:
    given = {
        "steps": STEPS,
        "lanes": LANES,
        "input": {"kind": "feedback", "gain": [[0.6, 0.3]], "estimator": "aoe"},
        "estimators": [{"name": "aoe"}, {"name": "kfio", "acks": "perfect"}],
        "links": LINKS["messy"],
    }
    whole = run(scenario(**given), tmp_path / "whole")
    split = run(scenario(transport={"lanes_per_packet": 1}, **given), tmp_path / "split", 2)
    assert whole.status == "complete"
    assert figures(split) == figures(whole)
