"""Comparison of runs: which lanes are paired, over which steps, and what is said where they cannot be."""

from __future__ import annotations

import csv
import io
import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from orchestrator.runs import BERNOULLI, run, scenario
from testbed.errors import UsageError
from testbed.orchestrator.comparison import Item, RunFigures, compare, load_run, load_runs
from testbed.orchestrator.lanes_file import LaneFigures
from testbed.orchestrator.report.comparison_page import comparison_html, differences_csv
from testbed.orchestrator.summary import Check

STEPS, LANES = 16, 40
ESTIMATORS = [{"name": "aoe", "acks": "none"}, {"name": "kfio", "acks": "perfect"}, {"name": "ff", "until": 10}]
SETTING: dict[str, Any] = {"steps": STEPS, "lanes": LANES, "record": "none", "estimators": ESTIMATORS}
Make = Callable[..., RunFigures]


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Runs that differ in one thing from the first."""
    base = tmp_path_factory.mktemp("runs")
    variants: dict[str, dict[str, Any]] = {
        "first": {},
        "again": {"name": "again"},
        "lossy": {"links": {"control": {"loss": BERNOULLI}, "observation": {"loss": {**BERNOULLI, "arrival": 0.5}}}},
        "seed": {"seed": 77},
        "one": {"lanes": 1},
    }
    for name, changes in variants.items():
        run(scenario(**{**SETTING, **changes}), base / name)
    return {name: base / name for name in variants}


@pytest.fixture(scope="module")
def runs(folders: dict[str, Path]) -> dict[str, RunFigures]:
    return {name: load_run(folder) for name, folder in folders.items()}


def lane_means(of: RunFigures, name: str | None, figure: str, first: int, last: int) -> np.ndarray:
    """(lanes,) over the steps first … last; every step is a window here."""
    assert of.lanes.ends.tolist() == list(range(1, STEPS + 1))
    assert name is not None
    means: np.ndarray = of.lanes.figures[name][figure][first - 1 : last].mean(axis=0)
    return means


def test_pairs_within_a_run_are_those_of_its_lanes(runs: dict[str, RunFigures]) -> None:
    found = compare([runs["first"]], figure="squared_error")
    assert [(p.a.estimator, p.b.estimator, p.first, p.last) for p in found.pairs] == [
        ("aoe", "kfio", 13, 16),
        ("aoe", "ff", 9, 10),
        ("kfio", "ff", 9, 10),
    ]
    p_values = []
    for pair in found.pairs:
        a, b = (
            lane_means(runs["first"], item.estimator, "squared_error", pair.first, pair.last)
            for item in (pair.a, pair.b)
        )
        expected = stats.ttest_rel(a, b)
        assert pair.found.method == "paired t"
        assert pair.found.interval == pytest.approx(expected.confidence_interval(0.95), rel=1e-9)
        assert pair.found.p_value == pytest.approx(expected.pvalue, rel=1e-6)
        p_values.append(expected.pvalue)
    smallest = int(np.argmin(p_values))
    assert found.pairs[smallest].p_holm == pytest.approx(min(1.0, 3 * p_values[smallest]), rel=1e-6)


def test_the_whole_run_is_all_the_steps_of_both(runs: dict[str, RunFigures]) -> None:
    pair = compare([runs["first"]], whole=True, against="ff").pairs[0]
    assert (pair.a.estimator, pair.b.estimator, pair.first, pair.last) == ("aoe", "ff", 1, 10)
    assert pair.found.mean_a == pytest.approx(lane_means(runs["first"], "aoe", "trace_P", 1, 10).mean(), rel=1e-12)


def test_the_same_scenario_differs_nowhere(runs: dict[str, RunFigures]) -> None:
    found = compare([runs["first"], runs["again"]])
    assert [(p.a, p.b) for p in found.pairs] == [
        (Item("first", name), Item("again", name)) for name in ("aoe", "kfio", "ff")
    ]
    assert all(pair.found.interval == (0.0, 0.0) and pair.found.p_value == 1.0 for pair in found.pairs)
    assert found.notes == ()


def test_lanes_meet_the_same_noise_on_another_link_and_are_paired(runs: dict[str, RunFigures]) -> None:
    """Pairing is by lane: with the lanes of one run in another order the mean stays, and the interval does not."""
    first, lossy = runs["first"], runs["lossy"]
    found = compare([first, lossy], figure="squared_error")
    a, b = (lane_means(of, "kfio", "squared_error", 13, 16) for of in (first, lossy))
    expected = stats.ttest_rel(a, b)
    kfio = found.pairs[1].found
    assert kfio.interval == pytest.approx(expected.confidence_interval(0.95), rel=1e-9)
    assert len(found.notes) == 1
    assert found.notes[0].startswith("first, lossy: the noise is the same; what differs: links.observation.loss")
    order = np.random.default_rng(1).permutation(LANES)
    figures = {name: {key: v[:, order] for key, v in of.items()} for name, of in lossy.lanes.figures.items()}
    mixed = compare([first, replace(lossy, lanes=LaneFigures(lossy.lanes.ends, figures))], figure="squared_error")
    assert mixed.pairs[1].found.difference == pytest.approx(kfio.difference, rel=1e-9)
    assert kfio.stderr is not None
    assert mixed.pairs[1].found.stderr is not None
    assert mixed.pairs[1].found.stderr == pytest.approx(stats.sem(a - b[order]), rel=1e-9)
    assert mixed.pairs[1].found.stderr > 1.1 * kfio.stderr


def test_other_noise_is_refused_or_unpaired(runs: dict[str, RunFigures]) -> None:
    first, seed = runs["first"], runs["seed"]
    with pytest.raises(UsageError) as caught:
        compare([first, seed])
    given_seed = first.scenario.seed
    expected = f"first, seed: not the same lanes: seed ({given_seed}, 77) differs; allowed: the same, or --unpaired"
    assert str(caught.value) == expected
    found = compare([first, seed], unpaired=True, every=True)
    across = [p for p in found.pairs if p.a.run != p.b.run]
    assert {p.found.method for p in across} == {"Welch"}
    assert {p.found.method for p in found.pairs if p.a.run == p.b.run} == {"paired t"}
    assert len(found.pairs) == 15
    pair = next(p for p in across if p.a.estimator == p.b.estimator == "aoe")
    a, b = (lane_means(of, "aoe", "trace_P", 13, 16) for of in (first, seed))
    expected_interval = stats.ttest_ind(a, b, equal_var=False).confidence_interval(0.95)
    assert pair.found.interval == pytest.approx(expected_interval, rel=1e-9)
    assert pair.course.stderr is None


def test_estimators_without_a_namesake_are_compared_across(runs: dict[str, RunFigures]) -> None:
    def only(of: RunFigures, *names: str) -> RunFigures:
        return replace(of, lanes=LaneFigures(of.lanes.ends, {name: of.lanes.figures[name] for name in names}))

    found = compare([only(runs["first"], "aoe", "ff"), only(runs["again"], "kfio")])
    assert [(p.a.estimator, p.b.estimator) for p in found.pairs] == [("aoe", "kfio"), ("ff", "kfio")]
    with pytest.raises(UsageError, match="nothing to compare with"):
        compare([only(runs["first"], "aoe")])


def test_against_one_or_all_of_a_name(runs: dict[str, RunFigures]) -> None:
    two = [runs["first"], runs["again"]]
    assert {p.b for p in compare(two, against="again/aoe").pairs} == {Item("again", "aoe")}
    assert len(compare(two, against="again/aoe").pairs) == 5
    assert len(compare(two, against="aoe").pairs) == 9
    with pytest.raises(UsageError) as caught:
        compare(two, against="again/aoa")
    assert str(caught.value).endswith("did you mean 'again/aoe'?")
    assert "\n" not in str(caught.value)
    with pytest.raises(UsageError, match="allowed: trace_P, squared_error, nees; did you mean 'trace_P'"):
        compare(two, figure="traceP")


def test_a_figure_of_the_whole_run(runs: dict[str, RunFigures]) -> None:
    rng = np.random.default_rng(5)
    costs = rng.gamma(3.0, size=(2, STEPS, LANES))

    def priced(of: RunFigures, cost: np.ndarray) -> RunFigures:
        return replace(of, lanes=replace(of.lanes, whole={"cost": cost}))

    one, other = priced(runs["first"], costs[0]), priced(runs["lossy"], costs[1])
    found = compare([one, other], figure="cost", whole=True)
    (pair,) = found.pairs
    assert (found.name(pair.a), found.name(pair.b), pair.first, pair.last) == ("first", "lossy", 1, STEPS)
    expected = stats.ttest_rel(costs[0].mean(axis=0), costs[1].mean(axis=0)).confidence_interval(0.95)
    assert pair.found.interval == pytest.approx(expected, rel=1e-9)
    assert compare([one, other], figure="cost", against="lossy").pairs[0].b == Item("lossy", None)
    assert "<td>first</td>" in comparison_html(found)
    with pytest.raises(UsageError, match="nothing to compare with"):
        compare([one], figure="cost")
    with pytest.raises(UsageError, match="--figure cost: again has none; allowed: a figure of all the runs"):
        compare([one, runs["again"]], figure="cost")
    with pytest.raises(UsageError, match=r"allowed: trace_P, squared_error, nees$"):
        compare([runs["first"]], figure="cost")


def test_windows_of_several_steps_are_merged_to_those_both_have(runs: dict[str, RunFigures]) -> None:
    first, again = runs["first"], runs["again"]

    def coarse(of: RunFigures, ends: list[int]) -> RunFigures:
        begins = [0, *ends[:-1]]
        figures = {
            name: {
                key: np.array([v[b:e].mean(axis=0) for b, e in zip(begins, ends, strict=True) if e <= len(v)])
                for key, v in figures.items()
            }
            for name, figures in of.lanes.figures.items()
        }
        return replace(of, lanes=LaneFigures(np.array(ends), figures))

    pair = compare([coarse(first, [2, 5, 10, 12, 14, 16]), coarse(again, [5, 10, 14, 16])], every=True).pairs
    found = next(p for p in pair if p.a == Item("first", "aoe") and p.b == Item("again", "kfio"))
    assert found.course.ends.tolist() == [5, 10, 14, 16]
    assert (found.first, found.last) == (15, 16)
    exact = lane_means(first, "aoe", "trace_P", 15, 16) - lane_means(again, "kfio", "trace_P", 15, 16)
    assert found.found.difference == pytest.approx(exact.mean(), rel=1e-9)
    steps = first.lanes.figures["aoe"]["trace_P"] - again.lanes.figures["kfio"]["trace_P"]
    np.testing.assert_allclose(found.course.mean, [steps[i:j].mean() for i, j in ((0, 5), (5, 10), (10, 14), (14, 16))])
    with pytest.raises(UsageError, match="no step that both ran to its end"):
        compare([coarse(first, [3, 16]), coarse(again, [5, 16])], figure="nees", against="first/ff")


def test_one_lane_is_compared_along_time(runs: dict[str, RunFigures]) -> None:
    found = compare([runs["one"]], whole=True)
    assert {pair.found.method for pair in found.pairs} == {"batch means"}
    assert any("16 steps are too few for an interval" in note for note in found.notes)
    with pytest.raises(UsageError, match="--unpaired: a run has one lane"):
        compare([runs["one"], runs["first"]], unpaired=True)


def test_what_a_run_says_against_intervals_is_told(runs: dict[str, RunFigures]) -> None:
    first = runs["first"]
    spoilt = replace(
        first,
        summary=first.summary.model_copy(
            update={
                "status": "interrupted",
                "completed_steps": 12,
                "checks": (
                    Check(name="finite variance", ok=False, text="no finite variance"),
                    Check(name="rounding", ok=False, text="rounding blurs"),
                ),
            }
        ),
    )
    traces, squares, nees = (compare([spoilt], figure=name) for name in ("trace_P", "squared_error", "nees"))
    assert traces.notes[:2] == ("interrupted after 12 of 16 steps", "no finite variance")
    assert all(pair.found.bootstrap is not None for pair in traces.pairs)
    assert {"no finite variance", "rounding blurs"} <= set(squares.notes)
    assert "no finite variance" not in nees.notes
    assert "rounding blurs" in nees.notes


def test_lanes_without_a_figure_are_left_out_and_told(runs: dict[str, RunFigures]) -> None:
    first = runs["first"]
    figures = {name: {key: v.copy() for key, v in of.items()} for name, of in first.lanes.figures.items()}
    figures["aoe"]["trace_P"][STEPS - 1, :3] = np.nan
    found = compare([replace(first, lanes=LaneFigures(first.lanes.ends, figures))])
    assert (found.pairs[0].found.number, found.pairs[0].found.left_out) == (LANES - 3, 3)
    assert found.notes == ("aoe − kfio: lanes without a finite figure, left out: 3",)
    assert np.isfinite(found.pairs[0].course.mean).all()


def test_the_page_and_its_numbers(runs: dict[str, RunFigures]) -> None:
    found = compare([runs["first"], runs["lossy"]])
    page = comparison_html(found)
    assert len(re.findall(r"<tr><td>", page)) == 3
    assert "first/aoe" in page
    assert not re.search(r'(src|href)="(?!data:|#)', page)
    rows = list(csv.DictReader(io.StringIO(differences_csv(found))))
    assert len(rows) == 2 * STEPS + 10
    d = runs["first"].lanes.figures["aoe"]["trace_P"][4] - runs["lossy"].lanes.figures["aoe"]["trace_P"][4]
    assert (rows[4]["a"], rows[4]["first"], rows[4]["last"]) == ("first/aoe", "5", "5")
    assert float(rows[4]["difference"]) == pytest.approx(d.mean(), rel=1e-9)
    assert float(rows[4]["stderr"]) == pytest.approx(stats.sem(d), rel=1e-9)


def test_a_page_of_one_lane_and_one_of_many_pairs(runs: dict[str, RunFigures], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("testbed.orchestrator.report.figures.differences.PANELS_MAX", 3)
    monkeypatch.setattr("testbed.analysis.differences.bca", lambda values: None)
    assert "figure" in comparison_html(compare([runs["one"]]))
    many = compare([runs["first"], runs["again"], runs["lossy"]], every=True)
    assert len(many.pairs) == 36
    assert "The first 3 pairs are drawn" in comparison_html(many)


def test_runs_of_equal_folders_are_told_apart_by_their_paths(folders: dict[str, Path], tmp_path: Path) -> None:
    for parent in ("x", "y"):
        shutil.copytree(folders["first"], tmp_path / parent / "run")
    assert [of.label for of in load_runs([tmp_path / "x" / "run", tmp_path / "y" / "run"])] == ["x/run", "y/run"]
    with pytest.raises(UsageError, match="given twice"):
        load_runs([tmp_path / "x" / "run", tmp_path / "y" / ".." / "x" / "run"])


@pytest.mark.parametrize(
    ("spoil", "expected"),
    [
        (lambda folder: shutil.rmtree(folder), "no such folder; allowed: the folder of a run"),
        (lambda folder: (folder / "summary.json").unlink(), "no summary.json in it; allowed: the folder of a run"),
        (lambda folder: (folder / "summary.json").write_text("{}"), "not a summary"),
        (lambda folder: (folder / "lanes.npz").unlink(), "lanes.npz: no such file; runs of older versions have none"),
        (lambda folder: (folder / "lanes.npz").write_text("x"), "not the figures of the lanes of a run"),
        (lambda folder: (folder / "scenario.toml").unlink(), "scenario.toml: no such file"),
        (lambda folder: _other_summary(folder), "lanes.npz and summary.json are not of the same run"),
    ],
)
def test_what_is_no_run_is_refused_in_one_line(
    spoil: Any, expected: str, folders: dict[str, Path], tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    shutil.copytree(folders["first"], folder)
    spoil(folder)
    with pytest.raises(UsageError) as caught:
        load_run(folder)
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


def _other_summary(folder: Path) -> None:
    tables = json.loads((folder / "summary.json").read_text())
    tables["lanes"] = 7
    (folder / "summary.json").write_text(json.dumps(tables))
