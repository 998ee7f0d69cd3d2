"""The figures of each lane: they are those of the recording, however lanes were split, and the file says so."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from orchestrator.runs import recorded, run, scenario
from testbed.errors import UsageError
from testbed.orchestrator.lane_windows import LANE_WINDOWS_MAX, LaneWindows, first_settled, window_ends
from testbed.orchestrator.lanes_file import NAME, LaneFigures, read_lanes, write_lanes
from testbed.orchestrator.report.derived import settled

LANES, STEPS = 6, 20


def of_recording(out: Path, name: str, lanes: int = LANES) -> dict[str, np.ndarray]:
    """(steps, lanes) of each figure, from what was recorded."""
    x_hat, P = (recorded(out, lanes, STEPS)[f"estimate/{name}"][key] for key in ("x_hat", "P"))
    e = recorded(out, lanes, STEPS)["truth"]["x"] - x_hat
    with np.errstate(all="ignore"):
        inverse = np.array(
            [[np.full((2, 2), np.nan) if np.isnan(p).any() else np.linalg.inv(p) for p in row] for row in P]
        )
    return {
        "trace_P": np.trace(P, axis1=2, axis2=3),
        "squared_error": (e**2).sum(axis=2),
        "nees": np.einsum("kmi,kmij,kmj->km", e, inverse, e),
    }


@pytest.mark.parametrize("changes", [{}, {"transport": {"lanes_per_packet": 1}}, {"lanes": 1}])
def test_figures_are_those_of_the_recording(changes: dict[str, Any], tmp_path: Path) -> None:
    given_scenario = scenario(record="all", **changes)
    run(given_scenario, tmp_path)
    lanes = read_lanes(tmp_path / NAME)
    assert lanes.ends.tolist() == list(range(1, STEPS + 1))
    assert list(lanes.figures) == [spec.name for spec in given_scenario.estimators]
    for spec in given_scenario.estimators:
        for figure, values in of_recording(tmp_path, spec.name, given_scenario.lanes).items():
            found = lanes.figures[spec.name][figure]
            assert found.shape == (spec.until or STEPS, given_scenario.lanes)
            np.testing.assert_allclose(found, values[: len(found)], rtol=1e-9)


def test_windows_are_means_and_the_file_does_not_depend_on_how_lanes_are_split(tmp_path: Path) -> None:
    run(scenario(record="none"), tmp_path / "steps")
    with patch("testbed.orchestrator.lane_windows.LANE_WINDOWS_MAX", 4 * LANES):
        run(scenario(record="none"), tmp_path / "windows")
        run(scenario(record="none", transport={"lanes_per_packet": 4}), tmp_path / "split", schedule=3)
    each, coarse = read_lanes(tmp_path / "steps" / NAME), read_lanes(tmp_path / "windows" / NAME)
    # one in five, 16–20, the last quarter of 20, and the ends and last quarters of the estimators until 7 and 9
    assert coarse.ends.tolist() == [5, 6, 7, 9, 10, 15, 20]
    for name, of in coarse.figures.items():
        for figure, values in of.items():
            begin = 0
            for end, row in zip(coarse.ends, values, strict=False):
                np.testing.assert_allclose(row, each.figures[name][figure][begin:end].mean(axis=0), rtol=1e-12)
                begin = end
    assert [len(coarse.figures[name]["nees"]) for name in ("aoe", "oe", "oe-acks")] == [7, 3, 4]
    assert (tmp_path / "split" / NAME).read_bytes() == (tmp_path / "windows" / NAME).read_bytes()


def test_the_last_quarter_is_that_of_the_table(tmp_path: Path) -> None:
    with patch("testbed.orchestrator.lane_windows.LANE_WINDOWS_MAX", 2 * LANES):
        summary = run(scenario(record="none"), tmp_path)
    lanes = read_lanes(tmp_path / NAME)
    for name, figures in summary.estimators.items():
        tail = settled(figures, summary.completed_steps)
        assert tail is not None
        begins = [1, *(lanes.ends + 1)]
        inside = [i for i, end in enumerate(lanes.ends) if begins[i] >= tail.first and end <= tail.last]
        weights = [lanes.ends[i] - begins[i] + 1 for i in inside]
        assert sum(weights) == tail.last - tail.first + 1
        mean = np.average(lanes.figures[name]["trace_P"][inside].mean(axis=1), weights=weights)
        assert mean == pytest.approx(tail.trace_P, rel=1e-12)


@given(st.integers(1, 10_000), st.integers(1, 200_000), st.lists(st.integers(1, 10_000), max_size=4))
def test_windows_cover_every_step_in_bounded_memory(steps: int, lanes: int, lasts: list[int]) -> None:
    lasts = [min(last, steps) for last in lasts]
    ends = window_ends(steps, lanes, lasts)
    assert list(ends) == sorted(set(ends))
    assert ends[0] >= 1
    assert ends[-1] == steps
    assert all(last in ends and first_settled(last) - 1 in (0, *ends) for last in lasts)
    assert len(ends) <= max(1, LANE_WINDOWS_MAX // lanes) + 2 * len(set(lasts))


def test_a_step_without_a_figure_leaves_its_window_without_one() -> None:
    windows = LaneWindows((2, 4), figures=1, lanes=3)
    for step, row in enumerate(([1.0, 2.0, 3.0], [math.nan, 2.0, 5.0], [1.0, 1.0, 1.0], [3.0, 1.0, math.inf]), start=1):
        windows.add(step, 0, np.array([row]))
    np.testing.assert_array_equal(windows.means(4)[:, 0], [[math.nan, 2.0, 4.0], [2.0, 1.0, math.inf]])
    np.testing.assert_array_equal(windows.means(3)[:, 0], [[math.nan, 2.0, 4.0]])


def test_a_file_reads_back_as_it_was(tmp_path: Path) -> None:
    values = np.arange(12.0).reshape(3, 4)
    estimators = {"a-b": {"trace_P": values, "nees": values[:2]}}
    write_lanes(tmp_path / NAME, LaneFigures(np.array([1, 2, 5]), estimators, {"cost": 2.0 * values}))
    found = read_lanes(tmp_path / NAME)
    assert found.ends.tolist() == [1, 2, 5]
    np.testing.assert_array_equal(found.figures["a-b"]["trace_P"], values)
    np.testing.assert_array_equal(found.figures["a-b"]["nees"], values[:2])
    np.testing.assert_array_equal(found.whole["cost"], 2.0 * values)
    assert (list(found.figures), list(found.whole)) == (["a-b"], ["cost"])
    assert [path.name for path in tmp_path.iterdir()] == [NAME]


def _saved(path: Path, **arrays: Any) -> None:
    np.savez(path, **{"version": np.array(1), "ends": np.array([1, 2]), **arrays})


@pytest.mark.parametrize(
    ("spoil", "expected"),
    [
        (lambda path: None, "no such file; runs of older versions have none"),
        (lambda path: path.mkdir(), "is a directory"),
        (lambda path: path.write_bytes(b""), "not the figures of the lanes"),
        (lambda path: path.write_bytes(b"PK\x03\x04garbage"), "not the figures of the lanes"),
        (lambda path: np.save(path.open("wb"), np.ones(3)), "not the figures of the lanes"),
        (lambda path: _saved(path, version=np.array(7)), "version 7; allowed: 1"),
        (lambda path: _saved(path, **{"a/nees": np.ones(3)}), "not the figures of the lanes"),
        (lambda path: _saved(path, **{"a/nees": np.ones((3, 2))}), "not the figures of the lanes"),
        (lambda path: _saved(path, **{"a/nees": np.array([[object()]])}), "not the figures of the lanes"),
        (lambda path: _saved(path, **{"a/x": np.ones((2, 2)), "b/x": np.ones((2, 3))}), "not the figures of the lanes"),
    ],
)
def test_another_file_is_refused_in_one_line(spoil: Any, expected: str, tmp_path: Path) -> None:
    path = tmp_path / NAME
    spoil(path)
    with pytest.raises(UsageError, match=expected) as caught:
        read_lanes(path)
    assert "\n" not in str(caught.value)
