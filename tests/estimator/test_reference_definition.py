"""The references themselves: against textbook recursions and against densities on a grid."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.reference import gaussian
from estimator.reference.aoe import aoe
from estimator.reference.cases import ACKS, CHAINS, Floats, System, Trial, random_system, random_trial
from estimator.reference.compare import covariance_error, mean_error
from estimator.reference.ff import ff

SEEDS = range(6)


def _trial(seed: int, chain: str = "markov", acks: str = "none", steps: int = 6) -> Trial:
    rng = np.random.default_rng([seed, 11])
    system = random_system(rng, int(rng.integers(1, 4)), int(rng.integers(1, 3)), int(rng.integers(1, 3)), chain)
    return random_trial(rng, system, steps, lanes=2, acks=acks)


def _phi(P: Floats, system: System, arrived: bool) -> tuple[Floats, Floats]:
    """Measurement update of a covariance (theory: Riccati pieces) and its gain."""
    gain = P @ system.C.T @ np.linalg.inv(system.C @ P @ system.C.T + system.R) * float(arrived)
    return P - gain @ system.C @ P, gain


def _joseph(P: Floats, gain: Floats, system: System) -> Floats:
    rest = np.eye(system.n) - gain @ system.C
    return rest @ P @ rest.T + gain @ system.R @ gain.T


@pytest.mark.parametrize("seed", SEEDS)
def test_conditioning_the_stack_is_the_kalman_filter(seed: int) -> None:
    trial = _trial(seed)
    system = trial.system
    for lane in range(trial.lanes):
        x, P = system.x0_mean, system.P0
        for k in range(1, trial.steps + 1):
            arrived = trial.arrived[:k, lane]
            x = system.A @ x + trial.nu[k - 1, lane] * system.B @ trial.u[k - 1, lane]
            P, gain = _phi(system.A @ P @ system.A.T + system.Q, system, bool(arrived[-1]))
            x = x + gain @ (trial.y[k - 1, lane] - system.C @ x)
            mean, cov = gaussian.kfio(system, trial.u[:k, lane], trial.y[:k, lane], arrived, trial.nu[:k, lane])
            assert mean_error(x, mean, cov) < 1e-10
            assert covariance_error(P, cov) < 1e-10
            assert covariance_error(gaussian.lower_bound(system, arrived), cov) < 1e-14


@pytest.mark.parametrize("seed", SEEDS)
def test_upper_bound_is_its_recursion(seed: int) -> None:
    trial = _trial(seed)
    system = trial.system
    U = 3.0 * system.B @ system.B.T
    S = system.P0
    for k in range(1, trial.steps + 1):
        arrived = trial.arrived[:k, 0]
        S, _ = _phi(system.A @ S @ system.A.T + system.Q + U / 4, system, bool(arrived[-1]))
        assert covariance_error(S, gaussian.upper_bound(system, arrived, U)) < 1e-10


@pytest.mark.parametrize("acks", ["none", "subset"])
@pytest.mark.parametrize("seed", SEEDS)
def test_ff_error_covariance_is_its_recursion(seed: int, acks: str) -> None:
    trial = _trial(seed, chain="bernoulli", acks=acks)
    system, rate = trial.system, trial.system.recovery
    for lane in range(trial.lanes):
        x, P, PA = system.x0_mean, system.P0, system.P0
        for k in range(1, trial.steps + 1):
            arrived = trial.arrived[:k, lane]
            known = trial.known_in_time(k, lane)
            push = system.B @ trial.u[k - 1, lane]
            chance = known.get(k - 1, rate)
            x = system.A @ x + chance * push
            P = system.A @ P @ system.A.T + chance * (1 - chance) * np.outer(push, push) + system.Q
            PA, gain = _phi(system.A @ PA @ system.A.T + system.Q, system, bool(arrived[-1]))
            x = x + gain @ (trial.y[k - 1, lane] - system.C @ x)
            P = _joseph(P, gain, system)
            mean, cov = ff(system, trial.u[:k, lane], trial.y[:k, lane], arrived, known)
            assert mean_error(x, mean, cov) < 1e-10
            assert covariance_error(P, cov) < 1e-10


def _grid_posterior(trial: Trial, k: int, known: dict[int, int]) -> tuple[float, float]:
    """Mean and variance of a scalar x_k by Bayes' rule for the density of (x, last ν) on a grid."""
    system = trial.system
    a, b, c, q, r = (float(M[0, 0]) for M in (system.A, system.B, system.C, system.Q, system.R))
    reach = 12.0 * np.sqrt(system.P0[0, 0] + k * q) * max(1.0, abs(a)) ** k + abs(b) * np.abs(trial.u).sum() + 10
    grid = np.linspace(-reach, reach, 1601)
    step = grid[1] - grid[0]

    def normal(error: Floats, variance: float) -> Floats:
        return np.asarray(np.exp(-0.5 * error**2 / variance) / np.sqrt(2 * np.pi * variance), dtype=np.float64)

    start = normal(grid - system.x0_mean[0], float(system.P0[0, 0]))
    density: dict[int | None, Floats] = {None: start}
    for j in range(k):
        moved: dict[int | None, Floats] = {}
        for nu in (0, 1):
            if known.get(j, nu) != nu:
                continue
            before = sum(
                (chance if nu else 1 - chance) * part
                for part, chance in ((part, system.arrival(last)) for last, part in density.items())
            )
            spread = normal(grid[:, None] - a * grid[None, :] - nu * b * trial.u[j, 0, 0], q)
            moved[nu] = spread @ np.asarray(before) * step
            if trial.arrived[j, 0]:
                moved[nu] *= normal(trial.y[j, 0, 0] - c * grid, r)
        density = moved
    total = sum(density.values())
    total = np.asarray(total) / np.sum(total)
    mean = float(total @ grid)
    return mean, float(total @ (grid - mean) ** 2)


@pytest.mark.parametrize("acks", ACKS)
@pytest.mark.parametrize("chain", CHAINS)
def test_oe_is_bayes_rule_on_a_grid(chain: str, acks: str) -> None:
    rng = np.random.default_rng([ACKS.index(acks), CHAINS.index(chain), 5])
    system = random_system(rng, 1, 1, 1, chain)
    system.P0[:] = 1.3
    trial = random_trial(rng, system, 3, lanes=1, acks=acks)
    for k in (1, 2, 3):
        known = trial.known(k, 0)
        mean, cov = gaussian.oe(system, trial.u[:k, 0], trial.y[:k, 0], trial.arrived[:k, 0], known)
        grid_mean, variance = _grid_posterior(trial, k, known)
        assert mean_error(np.array([grid_mean]), mean, cov) < 1e-9
        assert covariance_error(np.array([[variance]]), cov) < 1e-9


@pytest.mark.parametrize("seed", SEEDS)
def test_oe_error_is_its_covariance_in_simulation(seed: int) -> None:
    """Over draws of everything, E[(x_k - x̂_k)'(x_k - x̂_k)] = E[tr P_k]: here by importance over exact histories."""
    rng = np.random.default_rng([seed, 13])
    system = random_system(rng, 2, 1, 1)
    draws, k = 400, 4
    arrived = np.ones(k, dtype=bool)
    excess = np.zeros(draws)
    for i in range(draws):
        x = rng.multivariate_normal(system.x0_mean, system.P0)
        u, y, last = np.full((k, 1), 2.0), np.zeros((k, 1)), None
        for j in range(k):
            last = int(rng.random() < system.arrival(last))
            x = system.A @ x + last * system.B @ u[j] + rng.multivariate_normal(np.zeros(2), system.Q)
            y[j] = system.C @ x + rng.normal(scale=np.sqrt(system.R[0, 0]))
        mean, cov = gaussian.oe(system, u, y, arrived, {})
        excess[i] = (x - mean) @ (x - mean) - np.trace(cov)
    assert abs(excess.mean()) < 4 * excess.std() / np.sqrt(draws)


@pytest.mark.parametrize("seed", SEEDS)
def test_aoe_first_step_is_oe_and_all_acks_is_kfio(seed: int) -> None:
    trial = _trial(seed)
    system = trial.system
    for lane in range(trial.lanes):
        u, y, arrived, nu = trial.u[:, lane], trial.y[:, lane], trial.arrived[:, lane], trial.nu[:, lane]
        first = aoe(system, u[:1], y[:1], arrived[:1], {})[0]
        mean, cov = gaussian.oe(system, u[:1], y[:1], arrived[:1], {})
        assert mean_error(first[0], mean, cov) < 1e-12
        assert covariance_error(first[1], cov) < 1e-12
        for k, estimate in enumerate(aoe(system, u, y, arrived, dict(enumerate(nu.tolist()))), start=1):
            mean, cov = gaussian.kfio(system, u[:k], y[:k], arrived[:k], nu[:k])
            assert mean_error(estimate[0], mean, cov) < 1e-10
            assert covariance_error(estimate[1], cov) < 1e-10
            exact = gaussian.oe(system, u[:k], y[:k], arrived[:k], dict(enumerate(nu[:k].tolist())))
            assert mean_error(exact[0], mean, cov) < 1e-12
            assert covariance_error(exact[1], cov) < 1e-12
