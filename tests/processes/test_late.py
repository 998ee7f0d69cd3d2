"""Late observations and ACKs over zenoh: the figures of a run in process."""

from __future__ import annotations

from pathlib import Path

import pytest

from processes.running import figures_of, finish, start

pytestmark = pytest.mark.processes
SCENARIO = """
steps = 12
lanes = 5
[system]
A = [[1.1, 0.2], [0.0, 0.7]]
B = [[1.0], [-0.5]]
C = [[1.0, 0.5]]
Q = [[0.5, 0.1], [0.1, 0.3]]
R = [[0.4]]
[input]
kind = "sine"
amplitude = 4.0
period = 7.0
[links.control]
loss = { kind = "bernoulli", arrival = 0.7 }
delay = { kind = "uniform", low = "2 ms", high = "12 ms" }
[links.observation]
loss = { kind = "markov", recovery = 0.6, failure = 0.3 }
delay = { kind = "uniform", low = "1 ms", high = "38 ms" }
corrupt = { chance = 0.1 }
duplicate = { chance = 0.3, after = "7 ms" }
[links.ack]
mode = "link"
batch = 3
delay = { kind = "log-normal", median = "8 ms", sigma = 0.7 }
[[estimators]]
name = "aoe"
[[estimators]]
name = "kfio"
acks = "perfect"
[transport]
"""


def test_figures_are_the_same_to_the_bit_over_zenoh_and_in_process(tmp_path: Path) -> None:
    found = []
    for way, (lanes, options) in {"zenoh": (2, ()), "in-process": (5, ("--in-process",))}.items():
        path = tmp_path / f"{way}.toml"
        path.write_text(f"{SCENARIO}lanes_per_packet = {lanes}\n")
        code, _, err = finish(start(path, tmp_path / way, *options))
        assert code == 0, err
        found.append(figures_of(tmp_path / way))
    assert found[0] == found[1]
    links = found[0]["links"]
    assert min(links["observation"]["late"], links["ack"]["late"], links["control"]["causes"]["late"]) > 0
