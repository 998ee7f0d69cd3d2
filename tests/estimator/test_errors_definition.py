"""What the estimators refuse, and what they say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimator.reference.cases import Trial, random_system, random_trial
from estimator.reference.drive import acks_at, model_of, run
from testbed.errors import TestbedError, UsageError
from testbed.estimator.errors import MissingAck, TooManyHistories
from testbed.estimator.registry import create


def _trial(acks: str = "none", lanes: int = 1, steps: int = 6, chain: str = "markov") -> Trial:
    rng = np.random.default_rng(21)
    return random_trial(rng, random_system(rng, 2, 1, 1, chain), steps, lanes, acks)


def test_kfio_without_its_ack() -> None:
    with pytest.raises(MissingAck):
        run("kfio", _trial())


def test_kfio_with_the_ack_of_one_lane_missing() -> None:
    trial = _trial("all", lanes=3)
    trial.ack_step[2, 1] = 0
    est = create("kfio", model_of(trial.system), lanes=3, options={})
    for k in (1, 2):
        est.step(trial.u[k - 1], trial.y[k - 1], trial.arrived[k - 1], acks_at(trial, k))
    with pytest.raises(MissingAck):
        est.step(trial.u[2], trial.y[2], trial.arrived[2], acks_at(trial, 3))


def test_kfio_with_a_late_ack() -> None:
    trial = _trial("all")
    trial.ack_step[1, 0] = 3
    with pytest.raises(MissingAck):
        run("kfio", trial)


def test_kfio_of_a_chain_that_loses_the_first_packet() -> None:
    """failure = 0 is not enough: the first packets may be lost before the chain recovers for good."""
    trial = _trial()
    system = replace(trial.system, recovery=0.5, failure=0.0, start=0.5)
    with pytest.raises(MissingAck):
        run("kfio", replace(trial, system=system))


@pytest.mark.parametrize("lanes", [1, 3])
def test_oe_beyond_its_histories(lanes: int) -> None:
    """2^k histories a lane at step k: eight are allowed, so step 3 is the last."""
    trial = _trial(lanes=lanes)
    est = create("oe-exact", model_of(trial.system), lanes=lanes, options={"max_histories": 8})
    for k in range(3):
        est.step(trial.u[k], trial.y[k], trial.arrived[k], ())
    with pytest.raises(TooManyHistories):
        est.step(trial.u[3], trial.y[3], trial.arrived[3], ())


def test_oe_keeps_one_history_when_every_ack_comes() -> None:
    """Two histories exist between the move and its ACK at most."""
    run("oe", _trial("all", lanes=2, steps=30), {"max_histories": 2})


def test_ff_refuses_a_markov_chain() -> None:
    with pytest.raises(UsageError):
        create("ff", model_of(_trial().system), lanes=1, options={})


@pytest.mark.parametrize("rate", [0.0, 0.1, 0.3, 0.7, 0.8, 0.9, 1 / 3, 1.0])
def test_ff_takes_every_rate(rate: float) -> None:
    system = replace(_trial().system, recovery=rate, failure=1.0 - rate, start=rate)
    create("ff", model_of(system), lanes=1, options={})


@pytest.mark.parametrize(("given", "nearest"), [("aoo", "aoe"), ("kfo", "kfio"), ("kifo", "kfio"), ("fff", "ff")])
def test_unknown_kind_names_the_nearest(given: str, nearest: str) -> None:
    with pytest.raises(UsageError, match=rf"\b{nearest}\b"):
        create(given, model_of(_trial(chain="bernoulli").system), lanes=1, options={})


def test_unknown_option_names_the_nearest() -> None:
    with pytest.raises(UsageError, match=r"\bmax_histories\b"):
        create("oe", model_of(_trial().system), lanes=1, options={"max_history": 8})


@pytest.mark.parametrize("kind", ["kfio", "aoe", "ff", "oe"])
def test_unknown_option_is_refused_by_every_kind(kind: str) -> None:
    with pytest.raises(UsageError, match="zzz"):
        create(kind, model_of(_trial(chain="bernoulli").system), lanes=1, options={"zzz": 1})


@pytest.mark.parametrize("value", ["many", 0, -1, None])
def test_option_of_the_wrong_kind_is_refused(value: object) -> None:
    with pytest.raises(UsageError, match="max_histories"):
        create("oe-exact", model_of(_trial().system), lanes=1, options={"max_histories": value})


@pytest.mark.parametrize("error", [MissingAck, TooManyHistories, UsageError])
def test_errors_are_of_the_testbed(error: type[Exception]) -> None:
    assert issubclass(error, TestbedError)
