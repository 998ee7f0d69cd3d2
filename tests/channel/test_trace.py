"""TRACE.csv: its rows, its figures, and that lanes and seeds are those of a run."""

from __future__ import annotations

import csv
from itertools import groupby
from pathlib import Path
from typing import Any

import pytest

from testbed.channel.service import loss_process
from testbed.channel.trace import sample_trace, write_trace
from testbed.scenario import Scenario, parse_scenario


def scenario(loss: dict[str, Any], **rest: Any) -> Scenario:
    system = {"A": [[1.0]], "C": [[1.0]], "Q": [[1.0]], "R": [[1.0]]}
    return parse_scenario({"system": system, "links": {"observation": {"loss": loss}}, **rest})


MARKOV = {"kind": "markov", "recovery": 0.4, "failure": 0.2}


def test_rows_are_a_packet_a_period(tmp_path: Path) -> None:
    trace = sample_trace(scenario(MARKOV, clock={"period": "2 ms"}), "observation", 500, seed=3)
    write_trace(tmp_path / "trace.csv", trace)
    with (tmp_path / "trace.csv").open(newline="") as file:
        header, *rows = list(csv.reader(file))
    assert header == ["seq", "sent_ns", "delivered_ns"]
    assert [int(seq) for seq, _, _ in rows] == list(range(500))
    assert [int(sent) for _, sent, _ in rows] == [2_000_000 * seq for seq in range(500)]
    assert all(delivered in ("", sent) for _, sent, delivered in rows)
    assert 0 < sum(delivered == "" for _, _, delivered in rows) < 500


def test_figures_are_those_of_the_rows() -> None:
    trace = sample_trace(scenario(MARKOV), "observation", 5000, seed=3)
    fates = [delivered is not None for _, _, delivered in trace.rows]
    bursts = [len(list(run)) for arrived, run in groupby(fates) if not arrived]
    figures = trace.figures()
    assert (figures["sent"], figures["delivered"], figures["dropped"]) == (5000, sum(fates), 5000 - sum(fates))
    assert figures["loss_rate"] == (5000 - sum(fates)) / 5000
    assert figures["mean_burst"] == sum(bursts) / len(bursts)
    assert figures["expected_loss_rate"] == pytest.approx(0.2 / 0.6, rel=1e-15)
    assert figures["expected_mean_burst"] == pytest.approx(2.5, rel=1e-15)


def test_figures_without_losses_are_not_there() -> None:
    figures = sample_trace(scenario({"kind": "none"}), "observation", 10, seed=1).figures()
    assert (figures["loss_rate"], figures["mean_burst"]) == (0.0, None)
    assert (figures["expected_loss_rate"], figures["expected_mean_burst"]) == (0.0, None)


def test_figures_of_a_link_that_delivers_nothing() -> None:
    figures = sample_trace(scenario({"kind": "bernoulli", "arrival": 0.0}), "observation", 10, seed=1).figures()
    assert (figures["loss_rate"], figures["mean_burst"], figures["expected_loss_rate"]) == (1.0, 10.0, 1.0)
    assert figures["expected_mean_burst"] is None


def test_a_lane_of_a_trace_is_that_lane_of_a_block() -> None:
    given = scenario(MARKOV, lanes=6, seed=8)
    process = loss_process(given, "observation", 0, 6)
    block = [process.next(number) for number in range(100)]
    for lane in range(6):
        rows = sample_trace(given, "observation", 100, seed=8, lane=lane).rows
        assert [delivered is not None for _, _, delivered in rows] == [bool(mask[lane]) for mask in block]
    first = sample_trace(given, "observation", 100, seed=8).rows
    assert first == sample_trace(given, "observation", 100, seed=8, lane=0).rows


def test_the_seed_given_is_the_seed_used() -> None:
    first, again, other = (sample_trace(scenario(MARKOV), "observation", 200, seed=s).rows for s in (1, 1, 2))
    assert first == again
    assert first != other


def test_links_have_draws_of_their_own() -> None:
    both = parse_scenario(
        {
            "system": {"A": [[1.0]], "B": [[1.0]], "C": [[1.0]], "Q": [[1.0]], "R": [[1.0]]},
            "links": {"observation": {"loss": MARKOV}, "control": {"loss": MARKOV}},
        }
    )
    assert sample_trace(both, "observation", 200, seed=1).rows != sample_trace(both, "control", 200, seed=1).rows


def test_a_perfect_ack_link_loses_nothing() -> None:
    given = scenario(MARKOV).model_copy()
    perfect = parse_scenario(
        {"system": {"A": [[1.0]], "C": [[1.0]], "Q": [[1.0]], "R": [[1.0]]}, "links": {"ack": {"mode": "perfect"}}}
    )
    assert sample_trace(perfect, "ack", 50, seed=1).figures()["dropped"] == 0
    assert sample_trace(given, "control", 50, seed=1).figures()["dropped"] == 0
