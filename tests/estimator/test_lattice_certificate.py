"""The certificate of oe-lattice against exact enumeration: the true error never passes the stated bound."""

from __future__ import annotations

import json

import numpy as np
import pytest

from testbed.channel.loss import Chain
from testbed.errors import UsageError
from testbed.estimator.model import Ack, Estimator, Model
from testbed.estimator.packets import read_packets, replay
from testbed.estimator.registry import create

ROUNDING = 1e-12


def random_model(rng: np.random.Generator) -> Model:
    n, p, q = (int(rng.integers(1, 3)) for _ in range(3))
    A = rng.normal(size=(n, n))
    A *= rng.uniform(0.3, 1.3) / np.max(np.abs(np.linalg.eigvals(A)))
    root = rng.normal(size=(n, n))
    markov = Chain.markov(rng.uniform(0.1, 0.9), rng.uniform(0.1, 0.9))
    return Model(
        A=A,
        B=rng.normal(size=(n, q)) * rng.uniform(0.2, 4.0),
        C=rng.normal(size=(p, n)),
        Q=root @ root.T + 0.1 * np.eye(n),
        R=np.diag(rng.uniform(0.2, 3.0, size=p)),
        x0_mean=rng.normal(size=n),
        P0=np.eye(n) * rng.uniform(0.1, 3.0),
        control=Chain.bernoulli(rng.uniform(0.1, 0.9)) if rng.random() < 0.5 else markov,
    )


def check_one_system(seed: int, steps: int) -> tuple[float, float]:
    """The largest error and the largest bound of x̂ along a run with partial ACKs."""
    rng = np.random.default_rng(seed)
    model = random_model(rng)
    exact = create("oe", model, lanes=1, options={"max_histories": 2**steps})
    fast = create("oe-lattice", model, lanes=1, options={"components": 16})
    x, delivered = rng.multivariate_normal(model.x0_mean, model.P0), True
    worst, bound = 0.0, 0.0
    for k in range(1, steps + 1):
        u = rng.normal(size=(1, model.q)) * 2.0
        delivered = bool(rng.random() < float(model.control.arrival_given(delivered if k > 1 else None)))
        assert model.B is not None
        x = model.A @ x + delivered * (model.B @ u[0]) + rng.multivariate_normal(np.zeros(model.n), model.Q)
        y = (model.C @ x + rng.multivariate_normal(np.zeros(model.p), model.R))[None]
        arrived = np.array([rng.random() < 0.7])
        known = np.array([rng.random() < 0.2])
        acks = (Ack(k - 1, np.array([int(delivered)]), known),)
        a, b = fast.step(u, y, arrived, acks), exact.step(u, y, arrived, acks)
        assert a.error_bound is not None
        assert a.error_bound_P is not None
        trace = float(np.trace(b.P[0]))
        error = float(np.linalg.norm(a.x_hat - b.x_hat)) / np.sqrt(float(np.trace(a.P[0])))
        error_P = abs(float(np.trace(a.P[0])) - trace) / float(np.trace(a.P[0]))
        assert error <= a.error_bound[0] + ROUNDING, (seed, k)
        assert error_P <= a.error_bound_P[0] + ROUNDING, (seed, k)
        worst, bound = max(worst, error), max(bound, float(a.error_bound[0]))
    return worst, bound


@pytest.mark.parametrize("seed", range(60))
def test_the_error_never_passes_the_bound(seed: int) -> None:
    _, bound = check_one_system(seed, 10)
    assert bound < 1e-6


@pytest.mark.slow
def test_the_error_never_passes_the_bound_over_a_thousand_systems() -> None:
    for seed in range(1000, 2000):
        check_one_system(seed, 12)


def paper_model() -> Model:
    """F's example (theory.md section 5, F-T1)."""
    return Model(
        A=np.array([[0.9, 0.1], [-0.1, 0.8]]),
        B=np.array([[-1.0], [1.0]]),
        C=np.array([[0.0, 1.0]]),
        Q=np.diag([1.0, 2.0]),
        R=np.eye(1),
        x0_mean=np.zeros(2),
        P0=np.eye(2),
        control=Chain.bernoulli(0.8),
    )


def forty_steps(estimator: Estimator) -> np.ndarray:
    rng, bounds = np.random.default_rng(3), []
    for _ in range(40):
        estimate = estimator.step(rng.normal(size=(1, 1)), rng.normal(size=(1, 1)) * 3, np.array([True]))
        assert estimate.error_bound is not None
        bounds.append(estimate.error_bound[0])
    return np.array(bounds)


def test_forty_steps_of_the_paper_stay_within_the_tolerance() -> None:
    bounds = forty_steps(create("oe-lattice", paper_model(), lanes=1, options={"components": 4096}))
    assert bounds[-1] < 1e-9
    assert np.all(np.diff(bounds) >= -1e-15)


def test_a_coarser_tolerance_gives_a_larger_bound() -> None:
    fine, coarse = (
        forty_steps(create("oe-lattice", paper_model(), lanes=1, options={"tolerance": t}))[-1] for t in (1e-9, 1e-4)
    )
    assert fine < coarse < 1e-3


def test_lanes_do_not_see_each_other() -> None:
    rng = np.random.default_rng(1)
    whole = create("oe-lattice", paper_model(), lanes=3, options={"components": 32})
    single = [create("oe-lattice", paper_model(), lanes=1, options={"components": 32}) for _ in range(3)]
    for _ in range(12):
        u, y, arrived = rng.normal(size=(3, 1)), rng.normal(size=(3, 1)), rng.random(3) < 0.7
        out = whole.step(u, y, arrived)
        parts = [one.step(u[i : i + 1], y[i : i + 1], arrived[i : i + 1]) for i, one in enumerate(single)]
        np.testing.assert_array_equal(out.x_hat, np.concatenate([part.x_hat for part in parts]))
        np.testing.assert_array_equal(out.P, np.concatenate([part.P for part in parts]))


def test_replay_prints_the_bound() -> None:
    model = paper_model()
    lines = [json.dumps({"k": k, "u": [1.0], "y": [0.5]}) for k in range(1, 16)]
    estimator = create("oe-lattice", model, lanes=1, options={"components": 64})
    out = [json.loads(line) for line in replay(estimator, model, read_packets(lines, model), use_acks=True)]
    assert 0.0 < out[-1]["error_bound"] < 1e-9
    assert 0.0 < out[-1]["error_bound_P"] < 1e-9


def test_what_it_does_not_hold_for_is_refused() -> None:
    three = Model(
        A=np.eye(3), C=np.eye(3), Q=np.eye(3), R=np.eye(3), x0_mean=np.zeros(3), P0=np.eye(3), B=np.ones((3, 1))
    )
    with pytest.raises(UsageError, match="one or two states, not 3"):
        create("oe-lattice", three, lanes=1)
