"""Restart and hand-over where the losses have a hidden state: Gilbert–Elliott control losses."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from estimator.reference.cases import HIDDEN, Trial, random_system, random_trial
from estimator.reference.drive import acks_at, model_of
from testbed.errors import UsageError
from testbed.estimator.model import Estimate
from testbed.estimator.registry import create
from testbed.estimator.snapshot import Snapshot, restore, take

STEPS = 9
KINDS: list[tuple[str, dict[str, Any]]] = [
    ("aoe", {}),
    ("gpb", {"order": 0}),
    ("gpb", {"order": 3}),
    ("gpb1", {}),
    ("gpb2", {}),
    ("imm", {}),
    ("pf", {"particles": 40}),
    ("oe", {}),
    ("oe", {"max_histories": 4}),
    ("oe-exact", {}),
]


def trial_of(acks: str, lanes: int, seed: int) -> Trial:
    rng = np.random.default_rng(seed)
    return random_trial(rng, random_system(rng, 2, 1, 1, HIDDEN), STEPS, lanes, acks)


@pytest.mark.parametrize("lanes", [1, 4])
@pytest.mark.parametrize(("kind", "options"), KINDS)
def test_a_run_goes_on_to_the_same_bits(kind: str, options: dict[str, Any], lanes: int) -> None:
    for number, acks in enumerate(("none", "all", "subset", "late")):
        trial = trial_of(acks, lanes, number)
        model = model_of(trial.system)
        estimator, estimate = create(kind, model, lanes=lanes, options=options), Estimate(*model.prior(lanes), lanes)
        restored = []
        for k in range(STEPS + 1):
            if k:
                given = trial.u[k - 1], trial.y[k - 1], trial.arrived[k - 1], acks_at(trial, k)
                estimate = estimator.step(*given)
                for other in restored:
                    again = other.step(*given)
                    np.testing.assert_array_equal(again.x_hat, estimate.x_hat)
                    np.testing.assert_array_equal(again.P, estimate.P)
            if k in (0, 1, 2, 6):
                data = take(estimator, "full", step=k, estimate=estimate).to_bytes()
                restored.append(create(kind, model, lanes=lanes, options=options))
                restore(Snapshot.from_bytes(data), restored[-1], lanes=lanes, n=2, step=k)


@pytest.mark.parametrize(("kind", "options"), KINDS)
def test_from_moments_the_next_fate_has_the_law_of_its_packet(kind: str, options: dict[str, Any]) -> None:
    """Without an observation the mean is A x̂ + P(ν_k = 1) B u, P by the law of the chain after k packets."""
    trial = trial_of("none", 1, 5)
    model, step = model_of(trial.system), 4
    options = {"particles": 200_000} if kind == "pf" else options
    estimator = create(kind, model, lanes=1, options=options)
    x_hat, P = np.array([[1.0, -2.0]]), np.eye(2)[None]
    estimator.start_from(step, x_hat, P)  # type: ignore[attr-defined]
    out = estimator.step(trial.u[step], trial.y[step], np.zeros(1, dtype=np.bool_), ())
    law = model.law
    arrival = (law.initial @ np.linalg.matrix_power(law.transition, step))[law.arrived].sum()
    push = trial.u[step][0] @ trial.system.B.T
    expected = x_hat[0] @ trial.system.A.T + arrival * push
    np.testing.assert_allclose(out.x_hat[0], expected, atol=0.05 if kind == "pf" else 1e-10)


def test_particles_in_no_state_are_refused() -> None:
    trial = trial_of("none", 1, 1)
    estimator = create("pf", model_of(trial.system), lanes=1, options={"particles": 5})
    estimator.step(trial.u[0], trial.y[0], trial.arrived[0], ())
    state = estimator.state()  # type: ignore[attr-defined]
    state["states"][0, 0] = 9
    with pytest.raises(UsageError, match="'states' holds what is not one"):
        estimator.set_state(state)  # type: ignore[attr-defined]
