"""TRACE.csv: its rows, its figures, that lanes and seeds are those of a run; and what is read from one."""

from __future__ import annotations

import csv
from itertools import groupby
from pathlib import Path
from typing import Any

import pytest

from testbed.channel.service import loss_process
from testbed.channel.trace import sample_trace, write_trace
from testbed.errors import UsageError
from testbed.scenario import Scenario, parse_scenario
from testbed.scenario.trace_file import read_fates


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


def test_what_was_written_is_read(tmp_path: Path) -> None:
    trace = sample_trace(scenario(MARKOV), "observation", 300, seed=2)
    write_trace(tmp_path / "trace.csv", trace)
    fates = read_fates(tmp_path / "trace.csv")
    assert fates.arrived.tolist() == [delivered is not None for _, _, delivered in trace.rows]
    assert fates.duplicates == 0


HEAD = "seq,sent_ns,delivered_ns\n"


@pytest.mark.parametrize(
    ("rows", "arrived", "duplicates"),
    [
        ("", [], 0),
        ("5,0,\n6,1,9\n", [False, True], 0),
        ("6,1,9\n5,0,\n", [False, True], 0),  # late
        ("5,0,3\n6,1,\n5,0,4\n", [True, False], 1),
        ("5,0,\n5,0,4\n5,0,\n", [True], 2),  # copies of which one came through
        ("\r\n5, 0, 3 \r\n\r\n6,1,\r\n", [True, False], 0),
    ],
)
def test_rows_of_a_packet_are_one_fate(tmp_path: Path, rows: str, arrived: list[bool], duplicates: int) -> None:
    (tmp_path / "trace.csv").write_text(HEAD + rows)
    fates = read_fates(tmp_path / "trace.csv")
    assert (fates.arrived.tolist(), fates.duplicates) == (arrived, duplicates)


@pytest.mark.parametrize(
    ("text", "error"),
    [
        (b"", "trace.csv: not a trace: got an empty file; allowed: CSV in UTF-8 with the header seq,sent_ns,"),
        (b"time,value\n1,2\n", "trace.csv: not a trace: got the header 'time,value'; allowed"),
        (b"\x89PNG\xff", "trace.csv: not a trace; allowed: CSV"),
        (HEAD.encode() + b"1,2\n", "trace.csv:2: got 2 fields; allowed: 3"),
        (HEAD.encode() + b"1,2,x\n", "trace.csv:2: delivered_ns: got 'x'; allowed: a whole number, or nothing for a"),
        (HEAD.encode() + b"1,2,3\n,2,3\n", "trace.csv:3: seq: got ''; allowed: a whole number$"),
        (HEAD.encode() + b"9" * 5000 + b",2,3\n", "trace.csv:2: seq: got '9{40}'; allowed: a whole number$"),
        (HEAD.encode() + b"1,2,3\n4,2,3\n", "no row for packet 2; allowed: a row for each from 1 to 4, with"),
    ],
)
def test_what_is_no_trace_is_refused(tmp_path: Path, text: bytes, error: str) -> None:
    (tmp_path / "trace.csv").write_bytes(text)
    with pytest.raises(UsageError, match=error):
        read_fates(tmp_path / "trace.csv")


def test_a_trace_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"cannot read .*none\.csv: no such file"):
        read_fates(tmp_path / "none.csv")
