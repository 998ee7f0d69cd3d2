"""What the report, its CSV and the end table say of a run in real time; priorities."""

from __future__ import annotations

import csv
import io
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from orchestrator.runs import scenario
from orchestrator.wall_clock import Simulated
from testbed.orchestrator.priority import Priorities
from testbed.orchestrator.realtime_figures import quantiles
from testbed.orchestrator.report.csv_data import lateness_csv
from testbed.orchestrator.report.page import report_html
from testbed.orchestrator.run import Run
from testbed.orchestrator.summary import Summary
from testbed.orchestrator.table import end_table
from testbed.scenario import to_toml


class Busy(Simulated):
    """Each message takes 0.3 ms; the estimate of step 4 more than its period."""

    def before(self, key: str, number: int) -> bool:
        self.clock.now_ns += 12_000_000 if (key, number) == ("estimate/aoe", 3) else 300_000
        return True


@pytest.fixture(scope="module")
def summary(tmp_path_factory: pytest.TempPathFactory) -> Summary:
    out = tmp_path_factory.mktemp("real")
    given = scenario(clock={"mode": "real", "period": "10 ms"}, estimators=[{"name": "aoe"}], steps=8)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("testbed.orchestrator.run.MemoryNetwork", Busy)
        return Run(given, out).in_process()


def test_the_hops_of_a_step_add_up(summary: Summary) -> None:
    assert summary.realtime is not None
    stages = summary.realtime.stages
    way = ["control/sent", "control/delivered", "observation/sent", "observation/delivered", "estimate/aoe"]
    times = [np.array(stages[topic].published_us, dtype=float) for topic in way]
    before = np.zeros(8)
    for topic, published in zip(way, times, strict=True):
        hops = np.sort(published - before)
        assert stages[topic].hop.max == pytest.approx(hops[-1])
        assert stages[topic].hop.p50 == pytest.approx(hops[3])
        before = published
    assert "ack/delivered" in stages


def test_the_report_shows_every_stage(summary: Summary) -> None:
    html = report_html(summary, to_toml(scenario(clock={"mode": "real"})))
    assert summary.realtime is not None
    table = html[html.index('id="realtime"') :]
    for topic, stage in summary.realtime.stages.items():
        assert f"<td>{topic}</td><td>{stage.role}</td>" in table
    assert 'id="lateness-figure"' in html
    assert "take no time" in html


def test_a_run_in_virtual_time_has_no_such_section(summary: Summary) -> None:
    virtual = summary.model_copy(update={"realtime": None})
    html = report_html(virtual, to_toml(scenario()))
    assert 'id="realtime"' not in html
    assert 'id="lateness-figure"' not in html


def test_the_numbers_behind_the_figure(summary: Summary) -> None:
    assert summary.realtime is not None
    rows = list(csv.DictReader(io.StringIO(lateness_csv(8, summary.realtime))))
    assert [int(row["k"]) for row in rows] == list(range(1, 9))
    for topic, stage in summary.realtime.stages.items():
        assert tuple(float(row[f"published_us:{topic}"]) for row in rows) == stage.published_us


def test_the_end_table_counts_what_was_missed(summary: Summary) -> None:
    out = io.StringIO()
    Console(file=out, width=80, no_color=True).print(end_table(summary, Path("out")))
    assert summary.realtime is not None
    missed = summary.realtime.stages["estimate/aoe"].missed
    assert missed > 0
    rows = [line.split() for line in out.getvalue().splitlines()]
    aoe = [row for row in rows if row[:1] == ["aoe"]][-1]
    assert aoe[-2:] == [str(missed), "0"]
    assert "Deadline 10\u2009000 µs after t_k, when u of the step was due; soft." in out.getvalue()


@given(st.lists(st.integers(-(10**9), 10**9), min_size=1, max_size=300))
def test_a_quantile_is_the_smallest_value_that_so_many_do_not_exceed(ns: list[int]) -> None:
    found = quantiles(ns)
    for share, value in ((0.5, found.p50), (0.9, found.p90), (0.99, found.p99), (1.0, found.max)):
        enough = [one for one in ns if sum(other <= one for other in ns) >= share * len(ns) - 1e-9]
        assert value == pytest.approx(min(enough) / 1e3)


def test_priorities_are_told_only_where_the_system_granted_them(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def refuse(thread: int, policy: int, _: os.sched_param) -> None:
        asked.append(thread)
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    priorities = Priorities(10)
    priorities.raise_all({"plant": os.getpid(), "gone": 2**22 + 1})
    assert asked
    assert priorities.raised == {}
    priorities.lower_own()


def test_a_priority_that_was_refused_is_a_finding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr("testbed.orchestrator.run.MemoryNetwork", Simulated)
    monkeypatch.setattr("testbed.orchestrator.report.write_report", lambda *_: None)
    given = scenario(clock={"mode": "real", "priority": 7}, estimators=[{"name": "aoe"}], steps=3)
    summary = Run(given, tmp_path).in_process()
    check = next(check for check in summary.checks if check.name == "priority")
    assert (check.ok, check.text) == (False, "SCHED_FIFO 7 for no process")
    assert summary.status == "complete"
