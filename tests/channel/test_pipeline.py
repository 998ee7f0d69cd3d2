"""A pipeline against its stages one by one: each is seen alone, and together they do what they do alone."""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np
import pytest
from scipy import stats

from channel.impaired import MS, NAME, Sent, impairments, pipeline, send_all, times_of
from testbed.channel.pipeline import Copy, Pipeline
from testbed.channel.processes import process_of
from testbed.channel.service import loss_process
from testbed.numerics.streams import Stream
from testbed.scenario import parse_scenario

N = 300
TIMES = times_of(N)
LOSSES: dict[str, dict[str, Any]] = {
    "bernoulli": {"kind": "bernoulli", "arrival": 0.7},
    "markov": {"kind": "markov", "recovery": 0.4, "failure": 0.2},
    "gilbert-elliott": {"kind": "gilbert-elliott", "to_bad": 0.1, "to_good": 0.3, "loss_good": 0.05, "loss_bad": 0.8},
}
STAGES: dict[str, Any] = {
    "loss": LOSSES["markov"],
    "rate": {"bits_per_second": 8e5, "burst_bytes": 150, "queue_packets": 2},
    "delay": {"kind": "uniform", "low": "1 ms", "high": "9 ms"},
    "reorder": {"chance": 0.3, "by": "5 ms"},
    "duplicate": {"chance": 0.4, "after": "2 ms"},
    "corrupt": {"chance": 0.3},
}
ALONE: dict[str, Sent] = {
    name: send_all(pipeline(**{name: stage}), TIMES) for name, stage in STAGES.items() if name != "rate"
}
FLIPS = send_all(pipeline(duplicate={"chance": 1.0}, corrupt=STAGES["corrupt"]), TIMES)


def composed(stages: set[str]) -> Sent:
    """What the stages, each seen alone, do one after the other."""
    line = pipeline(rate=STAGES["rate"])
    result: Sent = []
    for i, sent_ns in enumerate(TIMES):
        copies: tuple[Copy, ...] = ()
        if "loss" not in stages or ALONE["loss"][i]:
            left = line.send(100, sent_ns) if "rate" in stages else (Copy(sent_ns),)
            if left:
                at = left[0].at_ns
                at += sum(ALONE[name][i][0].at_ns - sent_ns for name in ("delay", "reorder") if name in stages)
                arrivals = [at]
                if "duplicate" in stages:
                    arrivals += [at + copy.at_ns - sent_ns for copy in ALONE["duplicate"][i][1:]]
                flips = [copy.flip if "corrupt" in stages else None for copy in FLIPS[i]]
                copies = tuple(Copy(at, flip) for at, flip in zip(arrivals, flips, strict=False))
        result.append(copies)
    return result


@pytest.mark.parametrize("count", range(len(STAGES) + 1))
def test_the_stages_together_do_what_each_does_alone(count: int) -> None:
    for chosen in combinations(STAGES, count):
        found = send_all(pipeline(**{name: STAGES[name] for name in chosen}), TIMES)
        assert found == composed(set(chosen)), chosen


def test_each_stage_does_something() -> None:
    assert 0 < sum(not copies for copies in ALONE["loss"]) < N
    assert len({copies[0].at_ns - at for copies, at in zip(ALONE["delay"], TIMES, strict=True)}) == N
    assert {copies[0].at_ns - at for copies, at in zip(ALONE["reorder"], TIMES, strict=True)} == {0, 5 * MS}
    assert {len(copies) for copies in ALONE["duplicate"]} == {1, 2}
    assert all(copies[-1].at_ns - copies[0].at_ns == 2 * MS for copies in ALONE["duplicate"] if len(copies) == 2)
    flips = np.array([[copy.flip is not None for copy in copies] for copies in FLIPS])
    assert stats.chi2_contingency(np.histogram2d(*flips.T.astype(int), bins=2)[0]).pvalue > 1e-6
    assert 0.2 < flips[:, 0].mean() < 0.4
    assert 0.2 < flips[:, 1].mean() < 0.4


def test_the_flipped_bit_is_any_bit() -> None:
    copies = send_all(pipeline(corrupt={"chance": 1.0}), range(20_000), [3] * 20_000)
    flips = [copy.flip for (copy,) in copies]
    assert None not in flips
    bits = np.array(flips, dtype=object) % 24
    assert stats.chisquare(np.bincount(bits.astype(int), minlength=24)).pvalue > 1e-6


def test_decisions_are_independent_of_one_another() -> None:
    often = {"reorder": {"chance": 0.5, "by": "1 s"}, "duplicate": {"chance": 0.5}, "corrupt": {"chance": 0.5}}
    delay = {"kind": "uniform", "low": "0 s", "high": "10 ms"}
    packets = 4000
    loss = {"kind": "bernoulli", "arrival": 0.5}
    lost = [not copies for copies in send_all(pipeline(loss=loss), [0] * packets)]
    sent = send_all(pipeline(delay=delay, **often), [0] * packets)
    decisions = [
        lost,
        [copies[0].at_ns >= 1000 * MS for copies in sent],
        [copies[0].at_ns % (1000 * MS) >= 5 * MS for copies in sent],
        [len(copies) == 2 for copies in sent],
        [copies[0].flip is not None for copies in sent],
    ]
    for one, other in combinations(np.array(decisions, dtype=int), 2):
        table = np.histogram2d(one, other, bins=2)[0]
        assert stats.chi2_contingency(table).pvalue > 1e-6


def test_a_packet_held_back_does_not_hold_up_those_that_wait_for_one_another() -> None:
    in_order = {**STAGES["delay"], "in_order": True}
    only = send_all(pipeline(delay=in_order, loss=STAGES["loss"]), TIMES)
    with_held = send_all(pipeline(delay=in_order, loss=STAGES["loss"], reorder=STAGES["reorder"]), TIMES)
    latest = 0
    for i, at in enumerate(TIMES):
        if only[i]:
            latest = max(latest, ALONE["delay"][i][0].at_ns)
            held = ALONE["reorder"][i][0].at_ns - at
            assert (only[i][0].at_ns, with_held[i][0].at_ns) == (latest, latest + held)


@pytest.mark.parametrize("change", [{"seed": 4}, {"lane": 1}])
def test_seed_and_lane_alone_decide(change: dict[str, int]) -> None:
    found = send_all(pipeline(**STAGES), TIMES)
    assert send_all(pipeline(**STAGES), TIMES) == found
    other = send_all(pipeline(**change, **STAGES), TIMES)
    assert [len(copies) for copies in other] != [len(copies) for copies in found]


@pytest.mark.parametrize("kind", LOSSES)
@pytest.mark.parametrize("lanes", [1, 3])
def test_losses_are_those_of_the_link_without_time(kind: str, lanes: int) -> None:
    eye = [[1.0]]
    given = parse_scenario(
        {
            "seed": 9,
            "system": {"A": eye, "B": eye, "C": eye, "Q": eye, "R": eye},
            "links": {"observation": {"loss": LOSSES[kind]}},
            "estimators": [{"name": "aoe"}],
        }
    )
    process = loss_process(given, "observation", 2, lanes)
    pipes = [Pipeline(given.links.observation, 9, NAME, 2 + i) for i in range(lanes)]
    for number in range(N):
        found = [bool(pipe.send(10, number)) for pipe in pipes]
        np.testing.assert_array_equal(found, np.atleast_1d(process.next(number)))
    assert [pipe.books.dropped.keys() for pipe in pipes] == [{"loss"}] * lanes


def test_the_books_balance_after_every_packet() -> None:
    pipe = pipeline(**STAGES)
    causes = {"loss": 0, "queue": 0}
    copies = second = spoilt = 0
    for i, at in enumerate(TIMES):
        assert pipe.sent == i
        out = pipe.send(100, at)
        copies += len(out)
        second += len(out) == 2
        spoilt += sum(copy.flip is not None for copy in out)
        if out:
            assert pipe.cause is None
        else:
            assert pipe.cause in causes
            causes[pipe.cause] += 1
        books = pipe.books
        assert (books.sent, books.duplicated, books.corrupted) == (i + 1, second, spoilt)
        assert {cause: books.dropped[cause] for cause in causes} == causes
        assert books.sent + books.duplicated == sum(causes.values()) + copies
        assert books.in_flight == copies - books.delivered
        counters = books.as_counters()
        assert counters["dropped"] == sum(causes.values())
        assert {cause: counters.get(f"dropped_{cause}", 0) for cause in causes} == causes
    assert min(causes.values()) > 0


def halves(before: dict[str, Any], after: dict[str, Any]) -> tuple[Sent, Sent, Sent]:
    """(changed half way, all as before, all as after)"""
    pipe = pipeline(**before)
    found = send_all(pipe, TIMES[: N // 2])
    pipe.change(impairments(**after))
    found += [pipe.send(100, at) for at in TIMES[N // 2 :]]
    return found, send_all(pipeline(**before), TIMES), send_all(pipeline(**after), TIMES)


@pytest.mark.parametrize("name", ["loss", "delay", "reorder", "duplicate", "corrupt"])
def test_a_change_acts_from_now_on(name: str) -> None:
    stages = {key: stage for key, stage in STAGES.items() if key != "rate"} | {"loss": LOSSES["bernoulli"]}
    others = {
        "loss": {"kind": "bernoulli", "arrival": 0.4},
        "delay": {"kind": "normal", "mean": "4 ms", "std": "2 ms"},
        "reorder": {"chance": 0.6, "by": "1 ms"},
        "duplicate": {"chance": 0.1},
        "corrupt": {"chance": 0.9},
    }
    for after in (stages | {name: others[name]}, {key: stages[key] for key in stages if key != name}):
        found, old, new = halves(stages, after)
        assert found[: N // 2] == old[: N // 2]
        assert found[N // 2 :] == new[N // 2 :] != old[N // 2 :]


@pytest.mark.parametrize("kind", LOSSES)
@pytest.mark.parametrize("clock", [{}, {"clock": "time", "slot": "1 ms"}])
def test_a_change_to_the_same_changes_nothing(kind: str, clock: dict[str, str]) -> None:
    stages = {**STAGES, "loss": LOSSES[kind], **clock, "delay": {**STAGES["delay"], "in_order": True}}
    found, old, _ = halves(stages, stages)
    assert found == old


@pytest.mark.parametrize(
    "after",
    [{"recovery": 0.9, "failure": 0.05}, {"recovery": 0.1, "failure": 0.5}, {"recovery": 0.01, "failure": 0.01}],
)
def test_a_chain_goes_on_from_its_state(after: dict[str, float]) -> None:
    other = {"kind": "markov", **after}
    found, old, _ = halves({"loss": LOSSES["markov"]}, {"loss": other})
    process = process_of(
        impairments(loss=other).loss, lambda purpose: Stream(3, NAME, purpose, width=1, lane=0, lanes=1), 1
    )
    process.state = bool(old[N // 2 - 1])
    assert found[: N // 2] == old[: N // 2]
    assert [bool(copies) for copies in found[N // 2 :]] == [bool(process.next(i)) for i in range(N // 2, N)]


def test_who_waits_for_those_before_does_so_beyond_a_change() -> None:
    slow = {"kind": "uniform", "low": "200 ms", "high": "300 ms", "in_order": True}
    fast = {"kind": "uniform", "low": "1 ms", "high": "2 ms", "in_order": True}
    found, _, _ = halves({"delay": slow}, {"delay": fast})
    arrivals = [copies[0].at_ns for copies in found]
    assert arrivals == sorted(arrivals)
