"""LQG gains and costs from the definition: stack the run, enumerate the losses, minimise over all affine policies."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise, product

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from testbed.channel.loss import Chain
from testbed.control.lqg import Weights, expected_cost, horizon_gains, stationary_gain
from testbed.errors import UsageError
from testbed.estimator.model import Model

Floats = NDArray[np.float64]
STEPS = 3
LOSSES = {
    "none": Chain.lossless(),
    "bernoulli": Chain.bernoulli(0.7),
    "markov": Chain.markov(0.6, 0.2),
    "markov from a loss": Chain.markov(0.5, 0.3, 0.1),
}


def model(control: Chain, A: object = ((1.2, 0.3), (-0.1, 0.9)), B: object = ((1.0,), (0.4,)), **own: object) -> Model:
    a, b = np.array(A), np.array(B)
    n = len(a)
    return Model(
        A=a,
        B=b,
        C=np.array([[1.0, -0.5]]) if n == 2 else np.eye(n),
        Q=np.array([[0.5, 0.1], [0.1, 0.3]]) if n == 2 else np.eye(n),
        R=np.array([[0.4]]) if n == 2 else np.eye(n),
        x0_mean=np.array([1.0, -2.0]) if n == 2 else np.zeros(n),
        P0=np.array([[0.7, 0.2], [0.2, 0.9]]) if n == 2 else np.eye(n),
        control=control,
    )


def weights(n: int = 2, q: int = 1) -> Weights:
    state = np.diag(np.arange(1.0, n + 1.0)) + 0.2
    return Weights(state, 0.8 * np.eye(q) + 0.1, 3.0 * state[::-1, ::-1])


def paths(chain: Chain, steps: int) -> Iterator[tuple[float, tuple[int, ...]]]:
    """Every history of ν with its probability."""
    for path in product((0, 1), repeat=steps):
        chance = chain.start if path[0] else 1.0 - chain.start
        for before, nu in pairwise(path):
            one = 1.0 - chain.failure if before else chain.recovery
            chance *= one if nu else 1.0 - one
        if chance:
            yield chance, path


class Stacked:
    """A run as linear maps of g = (1, x_0 − x̄_0, w_0 …, v_1 …), whose second moments are known.

    y with the effect of u taken away is what the controller knows when it knows every ν: its policies are affine in it,
    one for each history of ν.
    """

    def __init__(self, m: Model, steps: int) -> None:
        n, p = m.n, m.p
        self.m, self.steps = m, steps
        size = 1 + n + steps * (n + p)
        moment = np.zeros((size, size))
        moment[0, 0] = 1.0
        moment[1 : 1 + n, 1 : 1 + n] = m.P0
        w_at, v_at = 1 + n, 1 + n + steps * n
        self.free = [np.zeros((n, size))]
        self.free[0][:, 0], self.free[0][:, 1 : 1 + n] = m.x0_mean, np.eye(n)
        self.known = [np.eye(1, size)]
        for k in range(steps):
            w, v = slice(w_at + k * n, w_at + (k + 1) * n), slice(v_at + k * p, v_at + (k + 1) * p)
            moment[w, w], moment[v, v] = m.Q, m.R
            state = m.A @ self.free[-1]
            state[:, w] += np.eye(n)
            seen = m.C @ state
            seen[:, v] += np.eye(p)
            self.free.append(state)
            self.known.append(np.vstack([self.known[-1], seen]))
        self.half = np.linalg.cholesky(moment + 1e-300 * np.eye(size))
        self.moment = moment

    def covariance(self, k: int) -> Floats:
        """Cov(x_k | y_1 … y_k), by conditioning."""
        x, z = self.free[k], self.known[k]
        joint = x @ self.moment @ z.T
        return np.asarray(x @ self.moment @ x.T - joint @ np.linalg.solve(z @ self.moment @ z.T, joint.T))

    def residuals(self, own: Weights, policy: Callable[[int, tuple[int, ...]], Floats]) -> Floats:
        """What squares and sums to the expected cost; policy: (k, ν_0 … ν_{k−1}) → the map from what is known to u."""
        m, parts = self.m, []
        assert m.B is not None
        for chance, path in paths(m.control, self.steps):
            forced = np.zeros_like(self.free[0])
            for k in range(self.steps):
                u = path[k] * policy(k, path[:k]) @ self.known[k]
                forced = m.A @ forced + m.B @ u
                weight = own.terminal if k + 1 == self.steps else own.state
                for root, part in ((weight, self.free[k + 1] + forced), (own.input, u)):
                    parts.append(np.sqrt(chance) * np.linalg.cholesky(root).T @ part @ self.half)
        return np.concatenate([part.ravel() for part in parts])

    def least_cost(self, own: Weights) -> tuple[float, Floats]:
        """The least expected cost of any policy, and what it does at k = 0 as a function of nothing."""
        q = self.m.q
        places: dict[tuple[int, ...], tuple[int, int]] = {}
        count = 0
        for k in range(self.steps):
            for history in product((0, 1), repeat=k):
                places[history] = (count, len(self.known[k]))
                count += q * len(self.known[k])

        def policy(theta: Floats) -> Callable[[int, tuple[int, ...]], Floats]:
            def act(_: int, history: tuple[int, ...]) -> Floats:
                begin, width = places[history]
                return np.asarray(theta[begin : begin + q * width].reshape(q, width))

            return act

        base = self.residuals(own, policy(np.zeros(count)))
        columns = [self.residuals(own, policy(unit)) - base for unit in np.eye(count)]
        theta = np.linalg.lstsq(np.array(columns).T, -base, rcond=None)[0]
        least = self.residuals(own, policy(theta))
        return float(least @ least), theta[:q]


@pytest.mark.parametrize("name", LOSSES)
def test_the_gains_minimise_the_expected_cost_over_all_policies(name: str) -> None:
    """With every ACK. The least cost is also what `expected_cost` says of the gains."""
    m, own = model(LOSSES[name]), weights()
    stacked = Stacked(m, STEPS)
    least, first = stacked.least_cost(own)
    gains = horizon_gains(m, own, STEPS)[::-1]
    np.testing.assert_allclose(-gains[0] @ m.x0_mean, first, rtol=1e-8)
    covariances = [stacked.covariance(k) for k in range(STEPS)]
    np.testing.assert_allclose(expected_cost(m, own, gains, covariances), least, rtol=1e-10)


@pytest.mark.parametrize("name", LOSSES)
def test_the_expected_cost_of_any_gains(name: str) -> None:
    """Of gains that are not optimal: by propagating the second moments of (x, x̂) along every history."""
    m, own = model(LOSSES[name]), weights()
    assert m.B is not None
    stacked = Stacked(m, STEPS)
    rng = np.random.default_rng(3)
    gains = [rng.normal(size=(1, 2)) for _ in range(STEPS)]
    covariances = [stacked.covariance(k) for k in range(STEPS)]
    total, n, outer = 0.0, m.n, np.outer(m.x0_mean, m.x0_mean)
    for chance, path in paths(m.control, STEPS):
        joint = np.block([[m.P0 + outer, outer], [outer, outer]])
        for k, nu in enumerate(path):
            prior = m.A @ covariances[k] @ m.A.T + m.Q
            K = prior @ m.C.T @ np.linalg.inv(m.C @ prior @ m.C.T + m.R)
            push = nu * m.B @ gains[k]
            total += chance * nu * np.trace(gains[k].T @ own.input @ gains[k] @ joint[n:, n:])
            moves = np.block([[m.A, -push], [K @ m.C @ m.A, m.A - push - K @ m.C @ m.A]])
            noise = np.vstack([np.eye(n), K @ m.C])
            heard = np.vstack([np.zeros((n, m.p)), K])
            joint = moves @ joint @ moves.T + noise @ m.Q @ noise.T + heard @ m.R @ heard.T
            total += chance * np.trace((own.terminal if k + 1 == STEPS else own.state) @ joint[:n, :n])
    np.testing.assert_allclose(expected_cost(m, own, gains, covariances), total, rtol=1e-10)


def test_several_inputs() -> None:
    m = model(Chain.markov(0.7, 0.4), B=((1.0, 0.2), (0.4, -1.0)))
    own = weights(q=2)
    least, first = Stacked(m, 2).least_cost(own)
    gains = horizon_gains(m, own, 2)[::-1]
    np.testing.assert_allclose(-gains[0] @ m.x0_mean, first, rtol=1e-8)
    covariances = [Stacked(m, 2).covariance(k) for k in range(2)]
    np.testing.assert_allclose(expected_cost(m, own, gains, covariances), least, rtol=1e-10)


def test_without_losses_it_is_that_of_the_algebraic_equation() -> None:
    m, own = model(Chain.lossless()), weights()
    S = solve_discrete_are(m.A, m.B, own.state, own.input)
    assert m.B is not None
    expected = np.linalg.solve(own.input + m.B.T @ S @ m.B, m.B.T @ S @ m.A)
    np.testing.assert_allclose(stationary_gain(m, own), expected, rtol=1e-12)
    nearly = model(Chain.bernoulli(1.0 - 1e-12))
    np.testing.assert_allclose(stationary_gain(nearly, own), expected, rtol=1e-9)


@pytest.mark.parametrize("arrival", [0.6, 0.8, 0.95])
def test_a_scalar_has_the_root_of_a_quadratic(arrival: float) -> None:
    """s = w + a²s − ν̄ a²b²s²/(r + b²s)."""
    a, b, w, r = 1.4, 0.7, 2.0, 0.5
    m = model(Chain.bernoulli(arrival), A=((a,),), B=((b,),))
    roots = np.roots([b * b * (1 - a * a * (1 - arrival)), r * (1 - a * a) - w * b * b, -w * r])
    s = float(roots.max())
    own = Weights(np.array([[w]]), np.array([[r]]), np.array([[w]]))
    np.testing.assert_allclose(stationary_gain(m, own), [[a * b * s / (r + b * b * s)]], rtol=1e-11)


@pytest.mark.parametrize("chain", [Chain.bernoulli(0.7), Chain.markov(0.5, 0.1)])
def test_no_other_constant_gain_costs_less_in_the_long_run(chain: Chain) -> None:
    """With x known: the stationary second moments for each last ν, as one linear system."""
    m, own = model(chain), weights()
    best = stationary_gain(m, own)

    def cost(L: Floats) -> float:
        assert m.B is not None
        moves = (m.A, m.A - m.B @ L)
        one = (chain.recovery, 1.0 - chain.failure)
        pi = chain.arrival
        size = m.n**2
        transfer = np.zeros((2 * size, 2 * size))
        for before, after in product((0, 1), repeat=2):
            chance = one[before] if after else 1.0 - one[before]
            block = chance * np.kron(moves[after], moves[after])
            transfer[after * size : (after + 1) * size, before * size : (before + 1) * size] = block
        noise = np.concatenate([(1 - pi) * m.Q.ravel(), pi * m.Q.ravel()])
        X = np.linalg.solve(np.eye(2 * size) - transfer, noise).reshape(2, m.n, m.n)
        applied = one[0] * X[0] + one[1] * X[1]
        return float(np.trace(own.state @ X.sum(axis=0)) + np.trace(L.T @ own.input @ L @ applied))

    least = cost(best)
    rng = np.random.default_rng(5)
    for size in (1e-3, 1e-2, 1e-1):
        for _ in range(5):
            assert cost(best + size * rng.normal(size=best.shape)) > least


def test_a_long_horizon_begins_with_the_stationary_gain() -> None:
    m, own = model(Chain.markov(0.6, 0.2)), weights()
    gains = horizon_gains(m, own, 100_000)
    assert len(gains) < 5_000
    np.testing.assert_allclose(gains[-1], stationary_gain(m, own), rtol=1e-9)
    assert np.abs(gains[0] - gains[-1]).max() > 1e-3


def test_the_critical_rate_of_a_scalar() -> None:
    """1 − a^{-2}: of arrival, and under Markov losses of recovery."""
    own = Weights(np.eye(1), np.eye(1), np.eye(1))
    critical = 1.0 - 1.5**-2.0
    for make in (Chain.bernoulli, lambda rate: Chain.markov(rate, 0.1)):
        stationary_gain(model(make(critical + 0.01), A=((1.5,),), B=((1.0,),)), own)
        for rate in (critical - 0.01, critical):
            with pytest.raises(UsageError, match="no gain keeps the mean square of the state bounded") as refusal:
                stationary_gain(model(make(rate), A=((1.5,),), B=((1.0,),)), own)
            assert len(str(refusal.value).splitlines()) == 1
            assert "needed: more than 1 − ρ(A)⁻² = 0.555556" in str(refusal.value)


def test_the_critical_rate_of_one_input_for_two_unstable_modes() -> None:
    """1 − Π |λ|^{-2} (Schenato et al. 2007): more than 1 − ρ^{-2}."""
    A, B = ((1.3, 0.0), (0.0, 1.2)), ((1.0,), (1.0,))
    own = Weights(np.eye(2), np.eye(1), np.eye(2))
    critical = 1.0 - (1.3 * 1.2) ** -2.0
    stationary_gain(model(Chain.bernoulli(critical + 0.005), A=A, B=B), own)
    with pytest.raises(UsageError, match="for this A and B that is not enough"):
        stationary_gain(model(Chain.bernoulli(critical - 0.005), A=A, B=B), own)


@pytest.mark.parametrize("chain", [Chain.lossless(), Chain.bernoulli(0.9)])
def test_what_no_input_reaches_is_refused(chain: Chain) -> None:
    own = Weights(np.eye(2), np.eye(1), np.eye(2))
    unreachable = model(chain, A=((1.1, 0.0), (0.0, 0.5)), B=((0.0,), (1.0,)))
    with pytest.raises(UsageError, match="not even without losses"):
        stationary_gain(unreachable, own)
    with pytest.raises(UsageError, match="too large for a number"):
        horizon_gains(unreachable, own, 5_000)


def test_a_mode_that_costs_nothing_is_stabilised_too() -> None:
    m = model(Chain.bernoulli(0.9), A=((1.2, 0.0), (0.0, 0.5)), B=((1.0,), (1.0,)))
    assert m.B is not None
    gain = stationary_gain(m, Weights(np.diag([0.0, 1.0]), np.eye(1), np.zeros((2, 2))))
    closed = m.A - m.B @ gain
    transfer = 0.1 * np.kron(m.A, m.A) + 0.9 * np.kron(closed, closed)
    assert np.abs(np.linalg.eigvals(transfer)).max() < 1.0
