"""The certificate of oe: the distance to the exact posterior, by enumeration, never passes the stated bound."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimator.reference import gaussian
from estimator.reference.cases import ACKS, ARRIVALS, HIDDEN, Floats, Trial, check, random_system, random_trial
from estimator.reference.drive import acks_at, model_of, run
from testbed.channel.loss import Chain
from testbed.estimator.model import Ack, Estimator, Model
from testbed.estimator.packets import read_packets, replay
from testbed.estimator.registry import create

CHAINS = ("bernoulli", "markov", HIDDEN)
ROUNDING = 1e-11
EARLY = {"max_histories": 4, "tolerance": 1e-9}
"""Goes to the lattice at the third packet that is not acknowledged."""


def errors(x_hat: Floats, P: Floats, exact: tuple[Floats, Floats]) -> tuple[float, float]:
    """Of x̂ in units of sqrt(tr P), and of tr P relative to it."""
    trace = float(np.trace(P))
    return float(np.linalg.norm(x_hat - exact[0])) / np.sqrt(trace), abs(float(np.trace(P - exact[1]))) / trace


def assert_certified(trial: Trial, options: dict[str, float], largest: float) -> int:
    """That errors keep to the bounds, and bounds to ``largest``; how many bounds are of an estimate on the lattice."""
    est = create("oe", model_of(trial.system), lanes=trial.lanes, options=options)
    on_lattice = 0
    for k in range(1, trial.steps + 1):
        out = est.step(trial.u[k - 1], trial.y[k - 1], trial.arrived[k - 1], acks_at(trial, k))
        assert out.error_bound is not None
        assert out.error_bound_P is not None
        for lane in range(trial.lanes):
            u, y, arrived = trial.u[:k, lane], trial.y[:k, lane], trial.arrived[:k, lane]
            exact = gaussian.oe(trial.system, u, y, arrived, trial.known(k, lane))
            of_mean, of_trace = errors(out.x_hat[lane], out.P[lane], exact)
            assert of_mean <= out.error_bound[lane] + ROUNDING
            assert of_trace <= out.error_bound_P[lane] + ROUNDING
            assert out.error_bound[lane] <= largest
            on_lattice += bool(out.error_bound[lane] > 0.0)
    assert est.counters.get("late_acks", 0) == 0
    return on_lattice


@pytest.mark.parametrize("n", [1, 2, 3])
@pytest.mark.parametrize("chain", CHAINS)
@pytest.mark.parametrize("acks", ["none", "late", "subset"])
def test_the_error_keeps_to_the_bound_by_the_definition(n: int, chain: str, acks: str) -> None:
    rng = np.random.default_rng([n, CHAINS.index(chain), ACKS.index(acks)])
    trial = random_trial(rng, random_system(rng, n, 1, 1, chain), 9 if acks == "none" else 10, 2, acks)
    trial = replace(trial, u=trial.u / n)  # in three dimensions the work limit is near
    options = EARLY if n < 3 else {"max_histories": 4, "tolerance": 1e-6}
    assert assert_certified(trial, options, options["tolerance"]) > 0


@check(20)
@given(st.integers(0, 2**32 - 1), st.sampled_from(ACKS), st.sampled_from(ARRIVALS), st.sampled_from(CHAINS))
def test_a_loose_tolerance_is_certified_too(seed: int, acks: str, arrivals: str, chain: str) -> None:
    """Bounds that are far above rounding, so that an error in them would show."""
    rng = np.random.default_rng(seed)
    system = random_system(rng, int(rng.integers(1, 3)), int(rng.integers(1, 3)), 1, chain)
    assert_certified(random_trial(rng, system, 8, 2, acks, arrivals), {"max_histories": 2, "tolerance": 0.05}, np.inf)


def random_model(rng: np.random.Generator) -> Model:
    n, p, q = (int(rng.integers(1, top)) for top in (4, 3, 3))
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


def check_one_system(seed: int, steps: int) -> float:
    """The largest bound of x̂ along a run with ACKs of which some come, in time or not."""
    rng = np.random.default_rng(seed)
    model = random_model(rng)
    exact = create("oe-exact", model, lanes=1, options={"max_histories": 2**steps})
    tolerance = float(10.0 ** rng.uniform(-9.0, -2.0))
    fast = create("oe", model, lanes=1, options={"max_histories": 16, "tolerance": tolerance, "max_lag": steps})
    x, delivered, bound = rng.multivariate_normal(model.x0_mean, model.P0), True, 0.0
    coming: list[tuple[int, int, bool]] = []
    for k in range(1, steps + 1):
        u = rng.normal(size=(1, model.q)) * 2.0
        chain = model.control
        arrives = chain.start if k == 1 else 1.0 - chain.failure if delivered else chain.recovery
        delivered = bool(rng.random() < arrives)
        assert model.B is not None
        x = model.A @ x + delivered * (model.B @ u[0]) + rng.multivariate_normal(np.zeros(model.n), model.Q)
        y = (model.C @ x + rng.multivariate_normal(np.zeros(model.p), model.R))[None]
        arrived = np.array([rng.random() < 0.7])
        if rng.random() < 0.25:
            coming.append((k + int(rng.integers(0, 8)), k - 1, delivered))
        acks = tuple(Ack(j, np.array([int(nu)]), np.array([True])) for at, j, nu in coming if at == k)
        a, b = fast.step(u, y, arrived, acks), exact.step(u, y, arrived, acks)
        assert a.error_bound is not None
        assert a.error_bound_P is not None
        of_mean, of_trace = errors(a.x_hat[0], a.P[0], (b.x_hat[0], b.P[0]))
        assert of_mean <= a.error_bound[0] + ROUNDING, (seed, k)
        assert of_trace <= a.error_bound_P[0] + ROUNDING, (seed, k)
        bound = max(bound, float(a.error_bound[0]) / tolerance)
    assert not fast.counters
    return bound


@pytest.mark.parametrize("seed", range(40))
def test_the_error_never_passes_the_bound(seed: int) -> None:
    assert check_one_system(seed, 10) <= 1.0


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_the_error_never_passes_the_bound_over_a_thousand_systems() -> None:
    bounds = [check_one_system(seed, 14) for seed in range(1000, 2000)]
    assert np.mean(np.array(bounds) <= 1.0) > 0.95


def paper_model(chain: Chain | None = None) -> Model:
    """F's example (theory.md section 5, F-T1)."""
    return Model(
        A=np.array([[0.9, 0.1], [-0.1, 0.8]]),
        B=np.array([[-1.0], [1.0]]),
        C=np.array([[0.0, 1.0]]),
        Q=np.diag([1.0, 2.0]),
        R=np.eye(1),
        x0_mean=np.zeros(2),
        P0=np.eye(2),
        control=chain or Chain.bernoulli(0.8),
    )


def drawn_steps(estimator: Estimator, steps: int, seed: int = 3) -> list[tuple[Floats, float, float, float]]:
    """x̂, tr P and the bounds of each step, under inputs and observations that no ν explains well."""
    rng, out = np.random.default_rng(seed), []
    for _ in range(steps):
        estimate = estimator.step(rng.normal(size=(1, 1)), rng.normal(size=(1, 1)) * 3, np.array([True]))
        assert estimate.error_bound is not None
        assert estimate.error_bound_P is not None
        bounds = float(estimate.error_bound[0]), float(estimate.error_bound_P[0])
        out.append((estimate.x_hat[0], float(np.trace(estimate.P[0])), *bounds))
    return out


def test_forty_steps_of_the_paper_stay_within_the_tolerance() -> None:
    bounds = [bound for *_, bound, _ in drawn_steps(create("oe", paper_model(), lanes=1), 40)]
    assert bounds[11] == 0.0
    assert 0.0 < bounds[12] <= bounds[-1] < 1e-9


def assert_long_run(steps: int, tolerance: float, chain: Chain | None = None) -> None:
    coarse, fine = (
        drawn_steps(create("oe", paper_model(chain), lanes=1, options={"tolerance": t}), steps)
        for t in (tolerance, 1e-3 * tolerance)
    )
    for (x, trace, bound, bound_P), (x2, trace2, bound2, bound2_P) in zip(coarse, fine, strict=True):
        assert bound <= tolerance
        assert bound2 <= 1e-3 * tolerance
        assert np.linalg.norm(x - x2) <= 1.01 * (bound + bound2) * np.sqrt(trace) + ROUNDING
        assert abs(trace - trace2) <= 1.01 * (bound_P + bound2_P) * trace + ROUNDING


def test_the_bound_of_a_long_run_stays_below_the_tolerance() -> None:
    assert_long_run(150, 1e-4)


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("chain", [None, Chain.markov(0.6, 0.2)])
def test_the_bound_of_a_thousand_steps_stays_below_the_tolerance(chain: Chain | None) -> None:
    assert_long_run(1000, 1e-6, chain)


def test_an_outlier_leaves_the_bound_of_use() -> None:
    """What an observation of some thirty standard deviations makes matter, the lane goes back for."""
    model, rng = paper_model(), np.random.default_rng(4)
    fast, exact = (
        create(kind, model, lanes=1, options={"max_histories": 2**h}) for kind, h in (("oe", 6), ("oe-exact", 17))
    )
    for k in range(1, 18):
        y = np.array([[75.0]]) if k == 15 else rng.normal(size=(1, 1)) * 3.0
        u = rng.normal(size=(1, 1))
        a, b = (est.step(u, y, np.array([True])) for est in (fast, exact))
        assert a.error_bound is not None
        assert a.error_bound[0] <= 1e-9
        assert errors(a.x_hat[0], a.P[0], (b.x_hat[0], b.P[0]))[0] <= a.error_bound[0] + ROUNDING


def test_what_the_work_limit_does_not_allow_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("testbed.estimator.lattice.NODES_MAX", 500)
    out = drawn_steps(create("oe", paper_model(), lanes=1), 14)
    assert out[-1][2] > 1e-6
    assert np.isfinite([trace for _, trace, *_ in out]).all()


def test_lanes_do_not_see_each_other() -> None:
    rng = np.random.default_rng(1)
    options = {"max_histories": 32}
    whole = create("oe", paper_model(), lanes=3, options=options)
    single = [create("oe", paper_model(), lanes=1, options=options) for _ in range(3)]
    for _ in range(12):
        u, y, arrived = rng.normal(size=(3, 1)), rng.normal(size=(3, 1)), rng.random(3) < 0.7
        out = whole.step(u, y, arrived)
        parts = [one.step(u[i : i + 1], y[i : i + 1], arrived[i : i + 1]) for i, one in enumerate(single)]
        np.testing.assert_array_equal(out.x_hat, np.concatenate([part.x_hat for part in parts]))
        np.testing.assert_array_equal(out.P, np.concatenate([part.P for part in parts]))


def test_replay_prints_the_bound() -> None:
    model = paper_model()
    lines = [json.dumps({"k": k, "u": [1.0], "y": [0.5]}) for k in range(1, 16)]
    estimator = create("oe", model, lanes=1, options={"max_histories": 64})
    out = [json.loads(line) for line in replay(estimator, model, read_packets(lines, model), use_acks=True)]
    assert out[0]["error_bound"] == 0.0
    assert 0.0 < out[-1]["error_bound"] < 1e-9
    assert 0.0 < out[-1]["error_bound_P"] < 1e-9


@pytest.mark.parametrize("chain", CHAINS)
def test_compiled_or_not_the_estimates_agree(chain: str, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(9)
    trial = random_trial(rng, random_system(rng, 2, 1, 1, chain), 12, 1)
    compiled = run("oe", trial, EARLY)
    monkeypatch.setenv("TESTBED_KERNELS", "off")
    plain = run("oe", trial, EARLY)
    np.testing.assert_allclose(compiled[0], plain[0], rtol=0.0, atol=1e-12 * np.sqrt(np.abs(plain[1]).max()))
    np.testing.assert_allclose(compiled[1], plain[1], rtol=1e-12, atol=1e-12 * np.abs(plain[1]).max())
