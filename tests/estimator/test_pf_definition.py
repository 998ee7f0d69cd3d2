"""PF: with many particles the moments of the exact posterior; the same bits however lanes are split."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.reference.cases import CHAINS, Trial, random_system, random_trial
from estimator.reference.compare import smallest_eigenvalue
from estimator.reference.drive import acks_at, model_of, run
from testbed.estimator.registry import create
from testbed.numerics.streams import LaneStream

SPLITS = [(1, 2, 1), (3, 1), (1,) * 4]


def _trial(seed: int, acks: str, chain: str = "markov", lanes: int = 4) -> Trial:
    rng = np.random.default_rng([seed, 41])
    return random_trial(rng, random_system(rng, 2, 1, 1, chain), 6, lanes, acks)


def _steps(trial: Trial, first: int, lanes: int, seed: int) -> list[np.ndarray]:
    part = trial.of_lanes(slice(first, first + lanes))
    est = create("pf", model_of(trial.system), lanes=lanes, options={"particles": 50, "seed": seed}, lane=first)
    out = []
    for k in range(1, trial.steps + 1):
        estimate = est.step(part.u[k - 1], part.y[k - 1], part.arrived[k - 1], acks_at(part, k))
        out.append(np.concatenate([estimate.x_hat, estimate.P.reshape(lanes, -1)], axis=1))
    return out


@pytest.mark.parametrize("acks", ["none", "late"])
def test_a_split_of_the_lanes_changes_no_bit(acks: str) -> None:
    trial = _trial(1, acks)
    whole = _steps(trial, 0, 4, 3)
    for split in SPLITS:
        parts = [_steps(trial, int(end) - size, size, 3) for size, end in zip(split, np.cumsum(split), strict=True)]
        for k, rows in enumerate(whole):
            np.testing.assert_array_equal(np.concatenate([part[k] for part in parts]), rows)


def test_lanes_and_seeds_draw_apart() -> None:
    trial = _trial(2, "none", lanes=1)
    assert not np.allclose(_steps(trial, 0, 1, 3)[0], _steps(trial, 0, 1, 4)[0])
    same = trial.of_lanes(np.zeros(2, dtype=np.int64))
    rows = _steps(same, 0, 2, 3)[0]
    assert not np.allclose(rows[0], rows[1])


@pytest.mark.parametrize(("acks", "other"), [("all", "kfio"), ("none", "oe"), ("subset", "oe")])
@pytest.mark.parametrize("chain", CHAINS)
def test_many_particles_have_the_moments_of_the_posterior(chain: str, acks: str, other: str) -> None:
    trial = _trial(5, acks, chain, lanes=2)
    x_hat, P = run("pf", trial, {"particles": 100_000})
    exact_x, exact_P = run(other, trial)
    spread = np.sqrt(np.trace(exact_P, axis1=2, axis2=3))
    assert (np.linalg.norm(x_hat - exact_x, axis=2) < 0.05 * spread).all()
    assert (np.abs(P - exact_P).max(axis=(2, 3)) < 0.06 * spread**2).all()


def test_covariances_are_symmetric_and_positive() -> None:
    for seed in range(5):
        _, covariances = run("pf", _trial(seed, "late"), {"particles": 20})
        for P in covariances.reshape(-1, 2, 2):
            assert (P == P.T).all()
            assert smallest_eigenvalue(P) > -1e-12


def test_a_late_ack_is_counted() -> None:
    trial = _trial(9, "none", lanes=1)
    trial.ack_step[:, 0] = [1, 4, 3, 0, 0, 0]
    est = create("pf", model_of(trial.system), lanes=1)
    for k in range(1, trial.steps + 1):
        est.step(trial.u[k - 1], trial.y[k - 1], trial.arrived[k - 1], acks_at(trial, k))
    assert est.counters == {"late_acks": 1}


def test_draws_have_their_laws() -> None:
    stream = LaneStream(1, "a", "b")
    normals, uniforms = stream.normals(3, 4, 100_001), stream.uniforms(3, 5, 100_000)
    assert len(normals) == 100_001
    assert abs(normals.mean()) < 0.015
    assert abs(normals.var() - 1.0) < 0.02
    assert abs(uniforms.mean() - 0.5) < 0.005
    assert uniforms.min() >= 0.0
    assert uniforms.max() < 1.0
    assert not np.array_equal(stream.uniforms(3, 5, 4), stream.uniforms(4, 5, 4))
    np.testing.assert_array_equal(stream.uniforms(3, 5, 4), uniforms[:4])
