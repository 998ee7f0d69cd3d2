"""KF: KFIO over what arrived; and KFIO that holds a packet with noise alone for a measurement."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given

from estimator.agreement import assert_same
from estimator.reference.cases import Trial, check, random_system, random_trial, trials
from estimator.reference.drive import model_of, run
from testbed.errors import TestbedError
from testbed.estimator.packets import read_packets, replay
from testbed.estimator.registry import create


@check(30)
@given(trials(acks=("all",), steps=(1, 10)))
def test_is_kfio_where_what_arrives_is_a_measurement(trial: Trial) -> None:
    assert_same(run("kf", trial), run("kfio", trial), 1e-300)


def _replayed(kind: str, trial: Trial, gammas: list[int]) -> list[dict[str, object]]:
    lines = [
        json.dumps(
            {
                "k": k,
                "u": trial.u[k - 1, 0].tolist(),
                "y": trial.y[k - 1, 0].tolist(),
                "gamma": gammas[k - 1],
                "acks": [[k - 1, int(trial.nu[k - 1, 0])]],
            }
        )
        for k in range(1, trial.steps + 1)
    ]
    model = model_of(trial.system)
    made = create(kind, model, lanes=1)
    return [json.loads(line) for line in replay(made, model, read_packets(lines, model), use_acks=True)]


def test_takes_a_packet_with_noise_alone_for_a_measurement() -> None:
    rng = np.random.default_rng(2)
    trial = random_trial(rng, random_system(rng, 2, 1, 1), 4, 1, "all", arrivals="all")
    everything, some = [1, 1, 1, 1], [1, 0, 1, 0]
    assert _replayed("kf", trial, some) == _replayed("kfio", trial, everything)
    assert _replayed("kf", trial, some) != _replayed("kfio", trial, some)


def test_a_missing_ack_is_its_own() -> None:
    rng = np.random.default_rng(2)
    trial = random_trial(rng, random_system(rng, 2, 1, 1), 2, 1)
    with pytest.raises(TestbedError, match="kf needs the ACK"):
        run("kf", trial)
