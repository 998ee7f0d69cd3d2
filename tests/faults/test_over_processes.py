"""Random timelines of faults over real processes."""

from __future__ import annotations

from pathlib import Path

import pytest

from faults.over_processes import trial

pytestmark = [pytest.mark.processes, pytest.mark.timeout(300)]


def check(seed: int, folder: Path) -> None:
    made = trial(seed, folder)
    replay = f"PYTHONPATH=src:tests python -m faults {seed} --processes"
    assert not made.problems, "\n".join([*made.problems, *(made.disturbed.log if made.disturbed else ()), replay])


@pytest.mark.parametrize("seed", range(2))
def test_a_role_that_is_killed_or_hangs_changes_no_bit(seed: int, tmp_path: Path) -> None:
    check(seed, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2, 20))
def test_nor_does_one_of_further_seeds(seed: int, tmp_path: Path) -> None:
    check(seed, tmp_path)
