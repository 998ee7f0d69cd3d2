"""What the kit runs estimators on follows the model that it gives them."""

from __future__ import annotations

import numpy as np
import pytest

from testbed.channel.law import LossModel
from testbed.conformance.cases import BERNOULLI, HIDDEN, MARKOV, one, simulated, three, two


@pytest.mark.parametrize("losses", [BERNOULLI, MARKOV, HIDDEN])
def test_simulated_losses_and_noises_have_their_laws(losses: LossModel) -> None:
    for model in (one(losses), two(losses), three(losses)):
        case = simulated("", model, steps=12, lanes=4000, seed=1)
        weights, rates = model.law.initial, []
        for _ in range(12):
            rates.append(weights[model.law.arrived].sum())
            weights = weights @ model.law.transition
        np.testing.assert_allclose(case.nu.mean(axis=1), rates, atol=0.04)
        both = (case.nu[0] * case.nu[1]).mean()
        states = model.law.initial * model.law.arrived
        assert both == pytest.approx(states @ model.law.transition @ model.law.arrived, abs=0.04)
        before = np.concatenate([np.full((1, 4000, model.n), np.nan), case.x[:-1]])
        assert model.B is not None
        w = (case.x - before @ model.A.T - case.nu[..., None] * (case.u @ model.B.T))[1:].reshape(-1, model.n)
        v = (case.y - case.x @ model.C.T)[case.arrived]
        np.testing.assert_allclose(np.cov(w.T), np.squeeze(model.Q), atol=0.05)
        np.testing.assert_allclose(np.cov(v.T), np.squeeze(model.R), atol=0.05)
        assert not case.y[~case.arrived].any()


def test_moved_cases_are_the_same_in_other_coordinates() -> None:
    case = simulated("", three(MARKOV), steps=5, lanes=2, seed=3)
    T = np.array([[1.0, 0.5, 0.0], [0.2, 2.0, 0.1], [0.0, 0.3, 1.5]])
    moved = case.moved(T)
    m = moved.model
    assert m.B is not None
    np.testing.assert_allclose(moved.x @ m.C.T, case.x @ case.model.C.T)
    step = moved.x[0] @ m.A.T + case.nu[1][:, None] * (case.u[1] @ m.B.T)
    assert case.model.B is not None
    expected = case.x[0] @ case.model.A.T + case.nu[1][:, None] * (case.u[1] @ case.model.B.T)
    np.testing.assert_allclose(step, expected @ T.T)
    np.testing.assert_allclose(m.Q, T @ case.model.Q @ T.T)
    np.testing.assert_allclose(m.P0, T @ case.model.P0 @ T.T)
    np.testing.assert_allclose(m.x0_mean, T @ case.model.x0_mean)


def test_acks_come_with_their_delays() -> None:
    case = simulated("", one(MARKOV), steps=5, lanes=2, seed=3)
    assert [ack.j for ack in case.acks(4, (0, 3))] == [3, 0]
    assert [ack.j for ack in case.acks(3, (0, 3))] == [2]
    np.testing.assert_array_equal(case.acks(4, (3,))[0].nu, case.nu[0])
