"""500 random timelines of faults, from 500 seeds: books, estimates, figures and replays are as they should be."""

from __future__ import annotations

from pathlib import Path

import pytest

from faults.trial import trial

ALL, SOME, A_TEST = 500, 20, 10


def check(seeds: range, folder: Path) -> None:
    failed = [
        f"PYTHONPATH=src:tests python -m faults {made.seed}  # {made.problems[0]}"
        for made in (trial(seed, folder) for seed in seeds)
        if made.problems
    ]
    assert not failed, "\n".join(["seeds that fail; replay them with:", *failed])


@pytest.mark.parametrize("first", range(0, SOME, A_TEST))
def test_faults_change_nothing_but_what_they_explain(first: int, tmp_path: Path) -> None:
    check(range(first, first + A_TEST), tmp_path)


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("first", range(SOME, ALL, A_TEST))
def test_nor_do_those_of_further_seeds(first: int, tmp_path: Path) -> None:
    check(range(first, min(ALL, first + A_TEST)), tmp_path)
