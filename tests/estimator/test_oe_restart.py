"""oe goes on from its own state, and from moments alone, as if it had never stopped."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.reference import gaussian
from estimator.reference.cases import CHAINS, Floats, Trial, random_system, random_trial
from estimator.reference.compare import covariance_error, mean_error
from estimator.reference.drive import acks_at, model_of
from testbed.estimator.model import Estimate
from testbed.estimator.oe import Oe
from testbed.estimator.oe_exact import OeExact


def one_step(est: OeExact, trial: Trial, k: int) -> Estimate:
    return est.step(trial.u[k - 1], trial.y[k - 1], trial.arrived[k - 1], acks_at(trial, k))


def as_stored(state: dict[str, Floats]) -> dict[str, Floats]:
    """The same values, of which no estimator holds a part any more."""
    return {name: np.array(values) for name, values in state.items()}


@pytest.mark.parametrize("chain", CHAINS)
@pytest.mark.parametrize("exact", [True, False])
@pytest.mark.parametrize("stop", [0, 3, 7, 11])
def test_goes_on_from_its_state(chain: str, exact: bool, stop: int) -> None:
    """The 3 lanes leave enumeration at different steps, and late ACKs send some of them back across the stop."""
    rng = np.random.default_rng([CHAINS.index(chain), 5])
    trial = random_trial(rng, random_system(rng, 2, 1, 1, chain), 14, 3, "late")
    model = model_of(trial.system)
    make = (lambda: OeExact(model, 3)) if exact else (lambda: Oe(model, 3, max_histories=4, max_lag=6))
    whole, first, second = make(), make(), make()
    for k in range(1, stop + 1):
        one_step(whole, trial, k)
        one_step(first, trial, k)
    second.set_state(as_stored(first.state()))
    for k in range(stop + 1, trial.steps + 1):
        a, b = one_step(whole, trial, k), one_step(second, trial, k)
        np.testing.assert_array_equal(a.x_hat, b.x_hat)
        np.testing.assert_array_equal(a.P, b.P)
        if not exact:
            np.testing.assert_array_equal(a.error_bound, b.error_bound)
    assert whole.counters.get("late_acks", 0) == first.counters.get("late_acks", 0) + second.counters.get(
        "late_acks", 0
    )


def test_the_state_is_bounded() -> None:
    rng = np.random.default_rng(6)
    trial = random_trial(rng, random_system(rng, 1, 1, 1, "markov"), 120, 1, arrivals="all")
    est = Oe(model_of(trial.system), 1, max_histories=16, max_lag=8)
    sizes = []
    for k in range(1, trial.steps + 1):
        one_step(est, trial, k)
        sizes.append(sum(values.nbytes for values in est.state().values()))
    assert max(sizes[60:]) < 1.5 * max(sizes[30:60])


@pytest.mark.parametrize("chain", CHAINS)
def test_begins_with_moments_at_a_step(chain: str) -> None:
    """As the definition does from step 0 with the law that the link then has reached, without memory of ACKs before."""
    rng = np.random.default_rng([CHAINS.index(chain), 8])
    trial = random_trial(rng, random_system(rng, 2, 1, 1, chain), 6, 2)
    system, start = trial.system, 5
    est = OeExact(model_of(system), 2)
    x_hat, P = np.stack([system.x0_mean] * 2), np.stack([system.P0] * 2)
    est.start_from(start, x_hat, P)
    late_start = system.start
    for _ in range(start):
        late_start = late_start * system.arrival(1) + (1.0 - late_start) * system.arrival(0)
    moved = type(system)(**{**vars(system), "start": late_start})
    for k in range(1, trial.steps + 1):
        out = est.step(trial.u[k - 1], trial.y[k - 1], trial.arrived[k - 1])
        for lane in range(2):
            mean, cov = gaussian.oe(moved, trial.u[:k, lane], trial.y[:k, lane], trial.arrived[:k, lane], {})
            assert mean_error(out.x_hat[lane], mean, cov) < 1e-9
            assert covariance_error(out.P[lane], cov) < 1e-9


def test_acks_beyond_the_lag_are_counted() -> None:
    rng = np.random.default_rng(7)
    trial = random_trial(rng, random_system(rng, 1, 1, 1), 40, 1, arrivals="all")
    est = Oe(model_of(trial.system), 1, max_histories=4, max_lag=8)
    for k in range(1, 31):
        one_step(est, trial, k)
    trial.ack_step[2, 0], trial.ack_step[24, 0] = 31, 31
    one_step(est, trial, 31)
    assert est.counters == {"late_acks": 1}
