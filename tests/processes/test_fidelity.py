"""The benchmark of fidelity: its law of messages against an enumeration, and one short run from end to end."""

from __future__ import annotations

import json
import subprocess
import sys
from itertools import pairwise, product
from math import sqrt
from pathlib import Path

import numpy as np
import pytest
from benchmarks.fidelity_cells import Seen, tcp_cells, udp_cells
from benchmarks.fidelity_model import law_of_messages

from testbed.channel.kernel.marks import leftovers

ROOT = Path(__file__).parents[2]
TO_BAD, TO_GOOD, LOSS = 0.2, 0.4, (0.1, 0.7)


@pytest.mark.parametrize(("packets", "messages"), [(1, 4), (2, 3), (3, 2)])
def test_loss_of_messages_is_that_of_all_fates_of_their_packets(packets: int, messages: int) -> None:
    """Every path of the state, and given it independent fates: so each message has its chance, given the path."""
    stay = {(0, 0): 1 - TO_BAD, (0, 1): TO_BAD, (1, 0): TO_GOOD, (1, 1): 1 - TO_GOOD}
    good = TO_GOOD / (TO_BAD + TO_GOOD)
    first = square = 0.0
    for path in product((0, 1), repeat=packets * messages):
        chance = good if path[0] == 0 else 1 - good
        for pair in pairwise(path):
            chance *= stay[pair]
        parts = [path[i * packets : (i + 1) * packets] for i in range(messages)]
        lost = [1.0 - float(np.prod([1.0 - LOSS[state] for state in part])) for part in parts]
        mean = sum(lost) / messages
        variance = sum(p * (1 - p) for p in lost) / messages**2
        first += chance * mean
        square += chance * (variance + mean**2)
    link = {
        "loss": {
            "kind": "gilbert-elliott",
            "to_bad": TO_BAD,
            "to_good": TO_GOOD,
            "loss_good": LOSS[0],
            "loss_bad": LOSS[1],
        }
    }
    assert law_of_messages(link, packets, messages) == pytest.approx((first, sqrt(square - first**2)), rel=1e-12)


def test_losses_that_are_independent_have_the_binomial_law() -> None:
    lost = 1 - 0.95**7
    expected = (lost, sqrt(lost * (1 - lost) / 1000))
    found = law_of_messages({"loss": {"kind": "bernoulli", "loss": 0.05}}, 7, 1000)
    assert found == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(
    ("arrived", "outages"), [([0, 1, 2, 3], 0), ([1, 2, 3], 1), ([0, 3], 1), ([1], 2), ([], 1), ([3, 0, 2], 1)]
)
def test_an_outage_is_a_run_of_messages_that_did_not_arrive(arrived: list[int], outages: int) -> None:
    numbers = np.array(arrived, dtype=np.int64)
    at_ms = (10 * numbers + 1).astype(np.float64)
    assert Seen(4, 10.0, numbers, at_ms).outages == outages


def test_cells_have_names_of_their_own() -> None:
    cells = [*tcp_cells(), *udp_cells()]
    assert len({cell.name for cell in cells}) == len(cells)


@pytest.mark.slow
@pytest.mark.root
@pytest.mark.processes
def test_a_cell_from_end_to_end(tmp_path: Path) -> None:
    file, seconds = tmp_path / "found.json", 3
    command = [sys.executable, "-m", "benchmarks", "fidelity", "--seconds", str(seconds), "--json", str(file)]
    command += ["--cells", "tcp 1 ms 1 %", "udp bernoulli 5 %"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=110)
    assert done.returncode == 0, done.stderr
    found = json.loads(file.read_text())["benchmarks"]["fidelity"]
    assert [(row["one way, ms"], row["loss, %"]) for row in found["rows"]] == [(1, 0), (1, 1)]
    for row in found["rows"]:
        assert row["lost, %"][0] == row["outages"][0] == 0
        assert 1 <= row["zenoh, ms"][0] <= row["zenoh, ms"][1] <= row["zenoh, ms"][2]
        assert len(row["model/zenoh"]) == 3
    (udp,) = found["tables"]["messages lost over udp"]
    assert udp["messages"] == 100 * seconds
    assert udp["packets each"] == 1
    assert 0 < udp["zenoh, %"] < 50
    assert leftovers() == []


def test_an_unknown_cell_is_refused() -> None:
    command = [sys.executable, "-m", "benchmarks", "fidelity", "--cells", "tcp 7 ms*"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert "no cell 'tcp 7 ms*'; there are: tcp 1 ms 0 %" in done.stderr
