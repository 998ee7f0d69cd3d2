"""Losses that are written down: traces and scripts give the fates that they say, and the law that was counted."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from testbed.channel.chains import chain_of
from testbed.channel.in_time import law_of_link
from testbed.channel.law import law_of
from testbed.channel.loss import Chain
from testbed.channel.pipeline import Pipeline
from testbed.channel.service import loss_process
from testbed.channel.trace import sample_trace, write_trace
from testbed.errors import UsageError
from testbed.scenario import MarkovLoss, Scenario, ScriptedLoss, TraceLoss, load_scenario, parse_scenario, to_toml

check = settings(deadline=None, max_examples=60, derandomize=True)
words = st.text("01", min_size=1, max_size=12)
SYSTEM = {"A": [[1.0]], "C": [[1.0]], "Q": [[1.0]], "R": [[1.0]]}


def scenario(loss: dict[str, Any], steps: int = 100, **rest: Any) -> Scenario:
    return parse_scenario({"system": SYSTEM, "steps": steps, "links": {"observation": {"loss": loss}}, **rest})


def fates(loss: dict[str, Any], packets: int, *, lane: int = 0, lanes: int = 1, seed: int = 1) -> NDArray[np.bool_]:
    """(packets, lanes)."""
    process = loss_process(scenario(loss, seed=seed), "observation", lane, lanes)
    return np.array([process.next(k) for k in range(packets)], dtype=np.bool_).reshape(packets, lanes)


def word_of(bits: NDArray[np.bool_]) -> str:
    return "".join("1" if bit else "0" for bit in bits)


def assumed(loss: dict[str, Any], steps: int = 100) -> Chain:
    chain = chain_of(scenario(loss, steps).links.observation.loss)
    assert isinstance(chain, Chain)
    return chain


@check
@given(words, st.integers(0, 11))
def test_a_trace_is_replayed_around_from_its_offset(word: str, offset: int) -> None:
    offset %= len(word)
    expected = (word[offset:] + word * 40)[:40]
    for lanes in (1, 3):
        bits = fates({"kind": "trace", "fates": word, "offset": offset}, 40, lanes=lanes)
        assert {word_of(bits[:, lane]) for lane in range(lanes)} == {expected}


def test_each_lane_begins_where_its_seed_says() -> None:
    word = "".join("01"[k % 7 == 0 or k % 3 == 1] for k in range(101))
    loss = {"kind": "trace", "fates": word}
    whole = fates(loss, 101, lanes=400)
    begins = [(word + word).index(word_of(whole[:, lane])) for lane in range(400)]
    assert len(set(begins)) > 80
    assert 30 < np.mean(begins) < 70
    for lane, lanes in ((0, 1), (7, 1), (3, 50)):
        np.testing.assert_array_equal(fates(loss, 101, lane=lane, lanes=lanes), whole[:, lane : lane + lanes])
    assert (fates(loss, 101, lanes=400, seed=2) != whole).any()


def test_a_trace_that_ends_says_so() -> None:
    loss = {"kind": "trace", "fates": "1101" * 25, "repeat": False}
    assert word_of(fates(loss, 100)[:, 0]) == "1101" * 25
    assert fates(loss, 100, lanes=2).shape == (100, 2)
    for lanes in (1, 2):
        with pytest.raises(UsageError, match="the trace ends before packet 100: it has 100 from its offset on"):
            fates(loss, 101, lanes=lanes)


def test_what_a_link_sampled_is_replayed_from_its_file(tmp_path: Path) -> None:
    """Through the file of a scenario in a folder of its own, and through the resolved scenario."""
    trace = sample_trace(scenario({"kind": "markov", "recovery": 0.4, "failure": 0.2}), "observation", 150, seed=3)
    write_trace(tmp_path / "trace.csv", trace)
    table = 'loss = { kind = "trace", file = "trace.csv", offset = 0, repeat = false }'
    system = "\n".join(f"{key} = {value}" for key, value in SYSTEM.items())
    (tmp_path / "a.toml").write_text(f"steps = 150\n[system]\n{system}\n[links.observation]\n{table}\n")
    loaded = load_scenario(tmp_path / "a.toml")
    assert sample_trace(loaded, "observation", 150, seed=9).rows == trace.rows
    (tmp_path / "trace.csv").unlink()
    assert sample_trace(parse_scenario(to_toml(loaded)), "observation", 150, seed=9).rows == trace.rows


@pytest.mark.parametrize(
    ("content", "error"),
    [
        (None, "links.observation.loss.file: cannot read t.csv: no such file or directory"),
        ("a,b\n", "links.observation.loss.file: t.csv: not a trace: got the header 'a,b'; allowed: CSV in UTF-8"),
        ("seq,sent_ns,delivered_ns\n0,0,\n2,0,\n", "links.observation.loss.file: t.csv: no row for packet 1"),
        ("seq,sent_ns,delivered_ns\n0,x,\n", "links.observation.loss.file: t.csv:2: sent_ns: got 'x'"),
        ("seq,sent_ns,delivered_ns\n", "links.observation.loss.file: t.csv: no packets"),
    ],
)
def test_a_file_that_is_no_trace_is_refused(content: str | None, error: str, tmp_path: Path) -> None:
    if content is not None:
        (tmp_path / "t.csv").write_text(content)
    table = {"system": SYSTEM, "links": {"observation": {"loss": {"kind": "trace", "file": "t.csv"}}}}
    with pytest.raises(UsageError) as caught:
        parse_scenario(table, tmp_path)
    assert str(caught.value).startswith(f"scenario: {error}")


@check
@given(st.sets(st.integers(0, 30), min_size=1), st.lists(st.tuples(st.integers(0, 30), st.integers(0, 5)), max_size=3))
def test_exactly_the_packets_of_the_list_are_lost(numbers: set[int], ranges: list[tuple[int, int]]) -> None:
    listed = [*numbers, *(f"{first}-{first + more}" for first, more in ranges)]
    lost = numbers | {k for first, more in ranges for k in range(first, first + more + 1)}
    bits = fates({"kind": "scripted", "lost": listed}, 40, lanes=2)
    for lane in range(2):
        assert {k for k in range(40) if not bits[k, lane]} == lost


def test_a_pattern_is_repeated() -> None:
    assert word_of(fates({"kind": "scripted", "pattern": "1101"}, 11)[:, 0]) == "11011101110"


@check
@given(words)
def test_the_law_is_that_of_the_counts_around_the_circle(word: str) -> None:
    """Its loss is the share that was lost, and every transition that occurs is possible."""
    for loss in ({"kind": "trace", "fates": word}, {"kind": "scripted", "pattern": word}):
        chain = assumed(loss)
        around = list(pairwise(word + word[0]))
        assert chain.first_arrival == pytest.approx(word.count("1") / len(word))
        for before, failed in (("0", "recovery"), ("1", "failure")):
            follow = [after for first, after in around if first == before]
            if "0" in word and "1" in word:
                share = sum(after != before for after in follow) / len(follow)
                assert getattr(chain, failed) == pytest.approx(share)
        law = law_of(chain)
        weights = law.initial * (law.arrived == int(word[0]))
        for letter in word[1:]:
            weights = (weights @ law.transition) * (law.arrived == int(letter))
        assert weights.sum() > 0.0


@check
@given(st.sets(st.integers(0, 14), min_size=1), st.integers(1, 12))
def test_the_law_of_a_list_is_counted_over_the_steps_of_the_run(lost: set[int], steps: int) -> None:
    word = "".join("01"[k not in lost] for k in range(steps))
    by_list = assumed({"kind": "scripted", "lost": sorted(lost)}, steps)
    assert by_list == assumed({"kind": "trace", "fates": word}, steps)


def test_what_is_assumed_is_taken() -> None:
    given_ = {"kind": "four-state", "to_burst": 0.1, "to_good": 0.5, "to_isolated": 0.1}
    for loss in ({"kind": "trace", "fates": "10"}, {"kind": "scripted", "lost": [3]}):
        assert len(law_of(chain_of(scenario({**loss, "assumed": given_}).links.observation.loss)).arrived) == 3


def test_outside_a_scenario_a_list_is_counted_up_to_the_packet_after_the_last() -> None:
    assert ScriptedLoss(lost=(3, "5-6")).law == MarkovLoss(recovery=2 / 3, failure=2 / 5)
    assert TraceLoss(fates="0111").law == MarkovLoss(recovery=1.0, failure=1 / 3)


def test_by_time_all_packets_of_a_slot_have_its_fate() -> None:
    """Ten packets a slot of 10 ms, through the pipeline."""
    link = {"loss": {"kind": "scripted", "pattern": "1101"}, "clock": "time", "slot": "10 ms"}
    settings_ = parse_scenario({"system": SYSTEM, "links": {"observation": link}}).links.observation
    pipeline = Pipeline(settings_, 1, "link.test")
    arrived = [bool(pipeline.send(100, k * 1_000_000)) for k in range(80)]
    assert arrived == [bool(int("1101"[k // 10 % 4])) for k in range(80)]


def test_losses_of_another_kind_begin_anew_and_those_of_as_many_states_go_on() -> None:
    """From an absorbing loss: a chain of two states stays there, four states begin in the good one."""

    def settings_of(**loss: Any) -> Any:
        return scenario(loss).links.observation

    dead = settings_of(kind="markov", recovery=0.0, failure=1.0, start=0.0)
    stays = settings_of(kind="gilbert-elliott", to_good=0.0, to_bad=0.5, start_good=1.0)
    begins = settings_of(kind="four-state", to_burst=0.0, to_good=1.0)
    scripted = settings_of(kind="scripted", pattern="10")
    pipeline = Pipeline(dead, 1, "link.test")
    seen = []
    for link in (dead, stays, begins, scripted, dead):
        pipeline.change(link)
        seen.append([bool(pipeline.send(1, 0)) for _ in range(4)])
    assert seen == [[False] * 4, [False] * 4, [True] * 4, [True, False, True, False], [False] * 4]


def test_through_a_bottleneck_the_law_is_that_of_the_assumed_losses() -> None:
    """Sampled, and not from the trace, which would end."""
    link = {"rate": {"bits_per_second": 1e6}, "clock": "packet"}
    loss = {"kind": "trace", "fates": "0011111111" * 10, "repeat": False}
    replayed, chain = (
        parse_scenario({"system": SYSTEM, "steps": 100, "links": {"observation": {**link, "loss": given_}}})
        for given_ in (loss, {"kind": "markov", "recovery": 0.5, "failure": 0.125})
    )
    laws = [law_of_link(at, "observation") for at in (replayed, chain)]
    assert laws[0] == laws[1]
