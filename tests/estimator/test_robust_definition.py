"""RSEIO is the minimiser of theory.md 3.7, and its comparators are what their names say."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from testbed.channel.loss import Chain
from testbed.errors import UsageError
from testbed.estimator.errors import MissingAck
from testbed.estimator.model import Ack, Model
from testbed.estimator.registry import create

Floats = NDArray[np.float64]
STEPS, LANES = 5, 3
CASES = [
    (seed, n, g, p, parameters, mu)
    for seed, (n, g, p, parameters) in enumerate([(1, 1, 1, 1), (2, 2, 1, 1), (2, 1, 2, 2), (3, 2, 1, 2), (3, 3, 2, 2)])
    for mu in (0.05, 0.5, 0.8, 0.99)
]


def covariance(rng: np.random.Generator, size: int) -> Floats:
    root = rng.normal(size=(size, size))
    return np.asarray(root @ root.T + 0.3 * np.eye(size))


def random_model(seed: int, n: int, g: int, p: int, parameters: int, *, q: int = 0, which: str = "AGC") -> Model:
    rng = np.random.default_rng(seed)
    G, W = rng.normal(size=(n, g)), covariance(rng, g)
    shapes = {"A": (n, n), "G": (n, g), "C": (p, n)}
    derivatives = {f"d{key}": tuple(rng.normal(size=(parameters, *shapes[key]))) for key in which}
    return Model(
        A=rng.normal(size=(n, n)) + np.eye(n),
        B=rng.normal(size=(n, q)) if q else None,
        C=rng.normal(size=(p, n)),
        G=G,
        W=W,
        Q=G @ W @ G.T,
        R=covariance(rng, p),
        x0_mean=rng.normal(size=n),
        P0=covariance(rng, n),
        observation=Chain.bernoulli(0.7),
        **derivatives,
    )


def drive(kind: str, model: Model, y: Floats, arrived: Any, u: Floats | None = None, **options: Any) -> Any:
    """x̂ (K, M, n) and P (K, M, n, n); where there is an input, all of it is applied."""
    steps, lanes = arrived.shape
    made = create(kind, model, lanes=lanes, options=options)
    u = np.zeros((steps, lanes, 0)) if u is None else u
    outs = [made.step(u[k], y[k], arrived[k]) for k in range(steps)]
    return np.array([out.x_hat for out in outs]), np.array([out.P for out in outs])


def packets(seed: int, p: int, steps: int = STEPS, lanes: int = LANES) -> tuple[Floats, NDArray[np.uint8]]:
    rng = np.random.default_rng(1000 + seed)
    return rng.normal(size=(steps, lanes, p)) * 3.0, (rng.random((steps, lanes)) < 0.7).astype(np.uint8)


def whitening(covariance: Floats) -> Floats:
    """W with W' W = the inverse."""
    return np.linalg.inv(np.linalg.cholesky(covariance))


def stacked(model: Model, P: Floats, push: Floats, mu: float) -> tuple[Floats, Floats, Floats, Floats]:
    """The sum of squares as rows of (x, w): left sides and right sides, without and then with the observation's."""
    assert model.G is not None
    assert model.W is not None
    (n, g), p = model.G.shape, model.p
    fit, flat = np.sqrt(mu), np.sqrt(1.0 - mu)
    rows = [fit * np.hstack([whitening(P), np.zeros((n, g))]), fit * np.hstack([np.zeros((g, n)), whitening(model.W)])]
    sides = [np.zeros(n), np.zeros(g)]
    for k in range(max(map(len, (model.dA, model.dG, model.dC)))):
        dA = model.dA[k] if model.dA else np.zeros((n, n))
        dG = model.dG[k] if model.dG else np.zeros((n, g))
        dC = model.dC[k] if model.dC else np.zeros((p, n))
        rows += [flat * model.C @ np.hstack([dA, dG]), flat * dC @ np.hstack([model.A, model.G])]
        sides += [np.zeros(p), -flat * dC @ push]
    look = fit * whitening(model.R) @ model.C @ np.hstack([model.A, model.G])
    return np.vstack(rows), np.concatenate(sides), np.vstack([*rows, look]), fit * whitening(model.R)


def minimised(model: Model, x: Floats, P: Floats, y: Floats, push: Floats, mu: float) -> tuple[Floats, Floats]:
    """x̂⁺ by least squares, and P⁺ as the update by C, R of what the sum of squares without the observation leaves.

    The inverse of the Hessian of a sum of squares is the covariance of its minimiser; μ scales it.
    """
    n = model.n
    entry = np.hstack([model.A, model.G])  # type: ignore[list-item]
    before, side, whole, look = stacked(model, P, push, mu)
    side = side.copy()
    side[:n] = np.sqrt(mu) * whitening(P) @ x
    z = np.linalg.lstsq(whole, np.concatenate([side, look @ (y - model.C @ push)]), rcond=None)[0]
    spread = np.linalg.pinv(before)
    predicted = mu * entry @ spread @ spread.T @ entry.T
    gain = predicted @ model.C.T @ np.linalg.inv(model.C @ predicted @ model.C.T + model.R)
    return entry @ z + push, predicted - gain @ model.C @ predicted


def off(found: Floats, wanted: Floats) -> float:
    return float(np.abs(found - wanted).max() / max(1.0, np.abs(wanted).max()))


@pytest.mark.parametrize("which", ["AGC", "A", "C", "AG"])
@pytest.mark.parametrize(("seed", "n", "g", "p", "parameters", "mu"), CASES)
def test_rseio_is_the_minimiser(seed: int, n: int, g: int, p: int, parameters: int, mu: float, which: str) -> None:
    """Each step from the estimate of the step before; x̂ alone where nothing arrived."""
    model = random_model(seed, n, g, p, parameters, which=which)
    y, arrived = packets(seed, p)
    xs, Ps = drive("rseio", model, y, arrived, mu=mu)
    for lane in range(LANES):
        x, P = model.x0_mean, model.P0
        for k in range(STEPS):
            if arrived[k, lane]:
                x_next, P_next = minimised(model, x, P, y[k, lane], np.zeros(n), mu)
            else:
                x_next, P_next = model.A @ x, model.A @ P @ model.A.T + model.Q
            assert off(xs[k, lane], x_next) < 1e-10
            assert off(Ps[k, lane], P_next) < 1e-10
            x, P = xs[k, lane], Ps[k, lane]


@pytest.mark.parametrize(("seed", "n", "g", "p", "parameters", "mu"), CASES)
def test_with_a_known_input_the_minimised_function_has_it_too(
    seed: int, n: int, g: int, p: int, parameters: int, mu: float
) -> None:
    model = random_model(seed, n, g, p, parameters, q=2)
    assert model.B is not None
    u = np.random.default_rng(seed).normal(size=(1, 1, 2))
    y = np.ones((1, 1, p))
    xs, Ps = drive("rseio", model, y, np.ones((1, 1), dtype=np.uint8), u, mu=mu)
    x, P = minimised(model, model.x0_mean, model.P0, y[0, 0], model.B @ u[0, 0], mu)
    assert off(xs[0, 0], x) < 1e-10
    assert off(Ps[0, 0], P) < 1e-10


@pytest.mark.parametrize(("seed", "n", "g", "p", "parameters", "mu"), CASES)
def test_rseio_is_theorem_1_as_corrected(seed: int, n: int, g: int, p: int, parameters: int, mu: float) -> None:
    """The equations of theory.md 3.7 in their own form."""
    model = random_model(seed, n, g, p, parameters)
    y = np.random.default_rng(seed).normal(size=(1, 1, p))
    xs, Ps = drive("rseio", model, y, np.ones((1, 1), dtype=np.uint8), mu=mu)
    A, C, G, W, P, inv = model.A, model.C, model.G, model.W, model.P0, np.linalg.inv
    assert G is not None
    assert W is not None
    S = np.vstack([m for k in range(parameters) for m in (C @ model.dA[k], model.dC[k] @ A)])
    T = np.vstack([m for k in range(parameters) for m in (C @ model.dG[k], model.dC[k] @ G)])
    weight = (1.0 - mu) / mu
    P_hat = inv(inv(P) + weight * S.T @ S)
    Q_hat = inv(inv(W) + weight * T.T @ inv(np.eye(len(S)) + weight * S @ P @ S.T) @ T)
    G_hat = G - weight * A @ P_hat @ S.T @ T
    A_hat = (A - weight * G_hat @ Q_hat @ T.T @ S) @ (np.eye(n) - weight * P_hat @ S.T @ S)
    P_next = inv(inv(A @ P_hat @ A.T + G_hat @ Q_hat @ G_hat.T) + C.T @ inv(model.R) @ C)
    x = A_hat @ model.x0_mean
    assert off(xs[0, 0], x + P_next @ C.T @ inv(model.R) @ (y[0, 0] - C @ x)) < 1e-9
    assert off(Ps[0, 0], P_next) < 1e-9


@pytest.mark.parametrize("changes", [{}, {"dA": (), "dG": (), "dC": ()}])
def test_without_weight_or_without_model_error_rseio_is_kfio(changes: dict[str, Any]) -> None:
    model = replace(random_model(7, 3, 2, 2, 2), **changes)
    y, arrived = packets(7, 2, steps=20)
    options = {"mu": 0.3} if changes else {"mu": 1.0}
    for found, wanted in zip(
        drive("rseio", model, y, arrived, **options), drive("kfio", model, y, arrived), strict=True
    ):
        assert off(found, wanted) < 1e-12


def test_a_certain_state_and_no_process_noise_are_no_obstacle() -> None:
    """P_0 = 0 and W = 0: nothing that has to be inverted is definite, and the prediction is sure."""
    model = replace(random_model(3, 2, 2, 1, 1), P0=np.zeros((2, 2)), W=np.zeros((2, 2)), Q=np.zeros((2, 2)))
    y, arrived = packets(3, 1)
    xs, Ps = drive("rseio", model, y, np.ones_like(arrived))
    np.testing.assert_allclose(xs[0], np.tile(model.A @ model.x0_mean, (LANES, 1)), rtol=1e-12)
    assert not Ps.any()


def test_rse_is_rseio_and_kf_is_kfio_where_every_packet_arrives() -> None:
    model = random_model(5, 2, 2, 1, 2)
    y, _ = packets(5, 1)
    arrived = np.ones((STEPS, LANES), dtype=np.uint8)
    for one, other in (("rse", "rseio"), ("kf", "kfio")):
        for found, wanted in zip(drive(one, model, y, arrived), drive(other, model, y, arrived), strict=True):
            np.testing.assert_array_equal(found, wanted)


def test_rsemm_is_rse_with_the_mean_of_gamma_in_the_measurement() -> None:
    model = random_model(6, 2, 2, 1, 2)
    y, arrived = packets(6, 1)
    faded = replace(model, C=0.7 * model.C, dC=tuple(0.7 * d for d in model.dC))
    for found, wanted in zip(drive("rsemm", model, y, arrived), drive("rse", faded, y, arrived), strict=True):
        np.testing.assert_array_equal(found, wanted)


def test_the_pseudo_covariance_forgets_where_it_began() -> None:
    """R's second figure: from P_0 = 0.1, 1, 10 and 100 times I, with the same losses, P is the same at step 500."""
    model = Model(
        A=np.array([[0.9802, 0.0196], [0.0, 0.9802]]),
        C=np.array([[1.0, -1.0]]),
        Q=np.array([[1.9608, 0.0195], [0.0195, 1.9605]]),
        R=np.eye(1),
        x0_mean=np.array([1.0, 0.0]),
        P0=np.eye(2),
        dA=(np.array([[0.0, 0.099], [0.0, 0.0]]),),
    )
    arrived = (np.random.default_rng(1).random((500, 50)) < 0.8).astype(np.uint8)
    y = np.zeros((500, 50, 1))
    ends = [drive("rseio", replace(model, P0=p * np.eye(2)), y, arrived)[1][-1] for p in (0.1, 1.0, 10.0, 100.0)]
    assert np.std(ends[0][:, 0, 0]) > 0.1  # it goes on moving with the losses
    for P in ends[1:]:
        np.testing.assert_allclose(P, ends[0], rtol=1e-9)


@pytest.mark.parametrize("kind", ["kf", "rse", "rseio", "rsemm"])
@pytest.mark.parametrize("q", [0, 2])
def test_a_split_of_the_lanes_changes_no_bit(kind: str, q: int) -> None:
    model = random_model(8, 3, 2, 2, 2, q=q)
    y, arrived = packets(8, 2, steps=8, lanes=7)
    u = np.random.default_rng(8).normal(size=(8, 7, q))
    whole = drive(kind, model, y, arrived, u)
    for split in ((1, 2, 4), (4, 3), (1,) * 7):
        ends = np.cumsum(split)
        parts = [
            drive(kind, model, y[:, end - size : end], arrived[:, end - size : end], u[:, end - size : end])
            for size, end in zip(split, ends, strict=True)
        ]
        for i in range(2):
            np.testing.assert_array_equal(np.concatenate([part[i] for part in parts], axis=1), whole[i])


@pytest.mark.parametrize("lanes", [1024])
def test_compiled_loops_give_the_same_bits(lanes: int, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("numba")
    y, arrived = packets(9, 1, steps=3, lanes=lanes)
    compiled = drive("rseio", random_model(9, 2, 2, 1, 1), y, arrived)
    monkeypatch.setenv("TESTBED_KERNELS", "off")
    plain = drive("rseio", random_model(9, 2, 2, 1, 1), y, arrived)
    for found, wanted in zip(compiled, plain, strict=True):
        np.testing.assert_array_equal(found, wanted)


@pytest.mark.parametrize("kind", ["rse", "rseio", "rsemm"])
@pytest.mark.parametrize("mu", [0.0, -0.1, 1.1])
def test_mu_is_more_than_0_and_at_most_1(kind: str, mu: float) -> None:
    with pytest.raises(UsageError, match="mu: got"):
        create(kind, random_model(1, 1, 1, 1, 1), lanes=1, options={"mu": mu})


@pytest.mark.parametrize("kind", ["kf", "rse", "rseio", "rsemm"])
def test_a_control_that_may_be_lost_must_be_known(kind: str) -> None:
    model = replace(random_model(2, 2, 2, 1, 1, q=1), control=Chain.bernoulli(0.5))
    made = create(kind, model, lanes=1)
    one, y = np.ones((1, 1)), np.zeros((1, 1))
    made.step(one, y, np.ones(1), (Ack(0, np.zeros(1), np.ones(1)),))
    with pytest.raises(MissingAck, match=f"^{kind} needs the ACK"):
        made.step(one, y, np.ones(1))
