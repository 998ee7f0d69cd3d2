"""The object for scripts: the same figures as the estimator's own steps, plain shapes, clear errors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import testbed.estimator
from estimator.reference.cases import random_system, random_trial
from estimator.reference.drive import acks_at, model_of
from testbed.channel.loss import Chain
from testbed.errors import UsageError
from testbed.estimator import Ack, Filter, Model
from testbed.estimator.errors import MissingAck
from testbed.estimator.registry import create

MODEL = Model(
    A=np.array([[0.9, 0.1], [-0.1, 0.8]]),
    B=np.array([[-1.0], [1.0]]),
    C=np.array([[0.0, 1.0]]),
    Q=np.diag([1.0, 2.0]),
    R=np.eye(1),
    x0_mean=np.array([1.0, -1.0]),
    P0=np.eye(2),
    control=Chain.bernoulli(0.8),
)
KINDS = ["aoe", "ff", "gpb", "gpb1", "gpb2", "imm", "lmmse", "oe", "oe-exact", "pf"]


@pytest.mark.parametrize("lanes", [1, 3])
@pytest.mark.parametrize("kind", [*KINDS, "kfio"])
def test_predict_and_update_are_the_estimators_own_step(kind: str, lanes: int) -> None:
    rng = np.random.default_rng(4)
    trial = random_trial(rng, random_system(rng, 2, 1, 2, "bernoulli"), 7, lanes, "all" if kind == "kfio" else "late")
    estimator = create(kind, model_of(trial.system), lanes=lanes, lane=2)
    f = Filter(kind, model_of(trial.system), lanes, first_lane=2)
    one = slice(None) if lanes > 1 else 0
    for k in range(1, 8):
        acks = acks_at(trial, k)
        out = estimator.step(trial.u[k - 1], trial.y[k - 1], trial.arrived[k - 1], acks)
        f.predict(trial.u[k - 1][one])
        if k % 2 == 0 or kind == "kfio":
            f.update(trial.y[k - 1][one], trial.arrived[k - 1], acks=acks)
        else:
            with_nan = np.where(trial.arrived[k - 1][:, None], trial.y[k - 1], np.nan)
            f.update(with_nan, trial.arrived[k - 1][one], acks=acks)
        np.testing.assert_array_equal(f.x_hat, out.x_hat[one])
        np.testing.assert_array_equal(f.P, out.P[one])
        assert (f.step, f.counters) == (k, estimator.counters)


@pytest.mark.parametrize("lanes", [1, 2])
@pytest.mark.parametrize("kind", KINDS)
def test_a_prediction_is_a_step_in_which_nothing_arrives(kind: str, lanes: int) -> None:
    """Read or not, at once or later, it changes nothing; two in a row are a lost step."""
    u, y = np.full((lanes, 1), 2.0), np.full((lanes, 1), 0.3)
    read, unread, lost = (Filter(kind, MODEL, lanes) for _ in range(3))
    for f in (read, unread, lost):
        f.predict(u)
        f.update(y)
        f.predict(u)
    predicted = read.x_hat, read.P
    lost.update(None)
    np.testing.assert_array_equal(predicted[0], lost.x_hat)
    np.testing.assert_array_equal(predicted[1], lost.P)
    for f in (lost, read, unread):
        f.predict(u)
        assert f.step == 3
        f.update(y)
        np.testing.assert_array_equal(f.x_hat, lost.x_hat)
        np.testing.assert_array_equal(f.P, lost.P)


def test_a_prediction_with_and_without_an_ack_is_that_of_the_definition() -> None:
    A, B = MODEL.A, MODEL.B
    assert B is not None
    x, P, push = MODEL.x0_mean, MODEL.P0, B @ [2.0]
    for nu, mean, variance in ((None, 0.8, 0.16), (1, 1.0, 0.0), (0, 0.0, 0.0)):
        f = Filter("aoe", MODEL)
        np.testing.assert_array_equal(f.x_hat, x)
        np.testing.assert_array_equal(f.P, P)
        f.predict([2.0], nu=nu)
        np.testing.assert_allclose(f.x_hat, A @ x + mean * push, rtol=1e-14)
        np.testing.assert_allclose(f.P, A @ P @ A.T + MODEL.Q + variance * np.outer(push, push), rtol=1e-14)


def test_an_ack_may_come_with_the_prediction_or_with_the_observation() -> None:
    early, late, own = (Filter("kfio", MODEL) for _ in range(3))
    for k, nu in enumerate((1, 0, 1)):
        early.predict([1.0], nu=nu)
        early.update([0.4])
        late.predict([1.0])
        late.update(0.4, nu=nu)
        own.predict(1.0)
        own.update(0.4, acks=(Ack(k, np.array([nu]), np.array([1])),))
        np.testing.assert_array_equal(early.x_hat, late.x_hat)
        np.testing.assert_array_equal(own.x_hat, late.x_hat)


def test_after_a_missing_ack_the_update_can_be_given_again() -> None:
    f, g = Filter("kfio", MODEL), Filter("kfio", MODEL)
    f.predict([1.0])
    with pytest.raises(MissingAck, match="ACK of control packet 0 at step 1"):
        f.update([0.4])
    f.update([0.4], nu=1)
    g.predict([1.0], nu=1)
    g.update([0.4])
    np.testing.assert_array_equal(f.x_hat, g.x_hat)


def test_a_filter_goes_on_from_its_snapshot() -> None:
    f = Filter("gpb", MODEL, 2, order=3)
    for _ in range(5):
        f.predict([[1.0], [2.0]])
        f.update([[0.1], [0.2]], [1, 0])
    g, h = Filter("gpb", MODEL, 2, order=3), Filter("aoe", MODEL, 2)
    g.restore(f.snapshot().to_bytes())
    h.restore(f.snapshot("moments"))
    for other in (g, h):
        assert other.step == 5
        np.testing.assert_array_equal(other.x_hat, f.x_hat)
        np.testing.assert_array_equal(other.P, f.P)
    for other in (f, g):
        other.predict([[1.0], [2.0]])
        other.update([[0.1], [0.2]])
    np.testing.assert_array_equal(g.P, f.P)


def test_a_filter_takes_a_class_and_a_model_without_control() -> None:
    from testbed.estimator.aoe import Aoe

    f = Filter(Aoe, replace(MODEL, B=None))
    f.predict()
    f.update([1.0])
    assert f.x_hat.shape == (2,)
    assert f.P.shape == (2, 2)


def predicted(lanes: int = 1) -> Filter:
    f = Filter("aoe", MODEL, lanes)
    f.predict(np.zeros((lanes, 1)))
    return f


def updated() -> Filter:
    f = predicted()
    f.update(None)
    return f


@pytest.mark.parametrize(
    ("act", "expected"),
    [
        (lambda: Filter("aeo", MODEL), "unknown estimator 'aeo'; allowed: "),
        (lambda: Filter("aoe", MODEL, depth=1), "estimator 'aoe': unknown option 'depth'"),
        (lambda: Filter("aoe", MODEL, 0), "lanes: got 0; allowed: 1 or more"),
        (lambda: Filter("aoe", MODEL).update([1.0]), "update: there is no step yet; allowed: predict first"),
        (lambda: updated().update([1.0]), "update: step 1 is updated already; allowed: predict first"),
        (lambda: Filter("aoe", MODEL).predict([1.0, 2.0]), "u: got shape (2,); allowed: (1,)"),
        (lambda: Filter("aoe", MODEL).predict(), "u: got shape (0,); allowed: (1,)"),
        (lambda: Filter("aoe", MODEL).predict(["a"]), "u: got ['a']; allowed: (1,) numbers"),
        (lambda: Filter("aoe", MODEL).predict([np.inf]), "u: got a value that is not finite; allowed: numbers"),
        (lambda: Filter("aoe", MODEL, 2).predict([1.0, 2.0]), "u: got shape (2,); allowed: (2, 1)"),
        (lambda: predicted().update([1.0, 2.0]), "y: got shape (2,); allowed: (1,)"),
        (lambda: predicted().update([np.nan]), "y: got a value that is not finite; allowed: numbers"),
        (lambda: predicted().update(None, 1), "arrived: got 1 without y; allowed: 0 where y is None"),
        (lambda: predicted(2).update(np.zeros((2, 1)), 1), "arrived: got shape (); allowed: (2,)"),
        (lambda: predicted(2).update(np.zeros((2, 1)), [2, 0]), "arrived: got [2, 0]; allowed: 0 and 1"),
        (lambda: predicted().update([1.0], nu=0.5), "nu: got 0.5; allowed: 0 and 1"),
        (
            lambda: predicted().update([1.0], acks=(Ack(1, np.array([1]), np.array([1])),)),
            "acks: got control packet 1 at step 1; allowed: 0 … 0",
        ),
        (lambda: predicted().snapshot(), "snapshot: step 1 is predicted only; allowed: update first"),
        (lambda: predicted().restore(b""), "snapshot of 0 bytes; allowed: "),
    ],
)
def test_what_is_wrong_is_said_in_one_line(act: Callable[[], Any], expected: str) -> None:
    with pytest.raises(UsageError) as refusal:
        act()
    assert str(refusal.value).startswith(expected)
    assert len(str(refusal.value).splitlines()) == 1


def test_the_package_offers_what_a_script_needs() -> None:
    for name in testbed.estimator.__all__:
        assert getattr(testbed.estimator, name).__name__ == name
    with pytest.raises(AttributeError, match="no attribute 'Filtre'"):
        testbed.estimator.Filtre  # noqa: B018
