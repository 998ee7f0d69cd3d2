"""Estimators under control losses with a hidden state: by enumeration, by definition, and where these are chains."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given

from estimator.agreement import assert_same
from estimator.reference import gaussian, hidden
from estimator.reference.cases import (
    ACKS,
    FOUR,
    HIDDEN,
    Channel,
    Floats,
    Trial,
    check,
    random_system,
    random_trial,
    trials,
)
from estimator.reference.drive import losses_of, model_of, run
from testbed.channel.law import law_of
from testbed.errors import UsageError
from testbed.estimator.registry import create

HOLDING = [("aoe", {}), ("gpb", {"order": 0}), ("gpb", {"order": 2}), ("gpb1", {}), ("gpb2", {}), ("imm", {})]
KINDS = (HIDDEN, FOUR)


def _trial(seed: int, acks: str, steps: int = 6, lanes: int = 2, n: int = 2, losses: str = HIDDEN) -> Trial:
    rng = np.random.default_rng([seed, ACKS.index(acks), 53])
    return random_trial(rng, random_system(rng, n, 1, 1, losses), steps, lanes, acks)


def _by_lane(trial: Trial, estimates: Callable[[int], list[gaussian.Estimate]]) -> tuple[Floats, Floats]:
    outs = [estimates(lane) for lane in range(trial.lanes)]
    x_hat, P = (np.array([[step[i] for step in out] for out in outs]).swapaxes(0, 1) for i in (0, 1))
    return x_hat, P


def _enumerated(trial: Trial) -> tuple[Floats, Floats]:
    """The posterior over all histories of ν, each with its prior over all paths of the channel's state."""

    def lane_of(lane: int) -> list[gaussian.Estimate]:
        u, y, arrived = trial.u[:, lane], trial.y[:, lane], trial.arrived[:, lane]
        ks = range(1, trial.steps + 1)
        return [gaussian.oe(trial.system, u[:k], y[:k], arrived[:k], trial.known(k, lane)) for k in ks]

    return _by_lane(trial, lane_of)


def _defined(trial: Trial, kind: str, order: int = 0) -> tuple[Floats, Floats]:
    def lane_of(lane: int) -> list[gaussian.Estimate]:
        given_ = trial.system, trial.u[:, lane], trial.y[:, lane], trial.arrived[:, lane]
        if kind == "imm":
            return hidden.imm(*given_, trial.known_in_time(trial.steps, lane))
        known = [trial.known(k, lane) for k in range(1, trial.steps + 1)]
        return hidden.gpb(given_[0], order, *given_[1:], known)

    return _by_lane(trial, lane_of)


@pytest.mark.parametrize("acks", ACKS)
@pytest.mark.parametrize("losses", KINDS)
@pytest.mark.parametrize("seed", range(3))
def test_gpb_of_order_k_and_oe_are_the_exact_posterior(seed: int, losses: str, acks: str) -> None:
    trial = _trial(seed, acks, steps=5, n=1 + seed % 2, losses=losses)
    exact = _enumerated(trial)
    assert_same(run("gpb", trial, {"order": 5}), exact, 1e-9)
    assert_same(run("oe-exact", trial), exact, 1e-9)
    assert_same(run("oe", trial), exact, 1e-8)


@check(15)
@given(trials(chains=KINDS, acks=("none", "subset"), steps=(1, 4), lanes=(1, 2)))
def test_gpb_of_order_d_is_exact_up_to_step_d_and_one(trial: Trial) -> None:
    assert_same(run("gpb", trial, {"order": trial.steps - 1}), _enumerated(trial), 1e-9)


@check(40)
@given(trials(chains=KINDS, steps=(1, 8)))
def test_aoe_is_moment_matching_of_two_hypotheses(trial: Trial) -> None:
    """With the posterior of the hidden state; gpb of order 0 is the same."""
    reference = _defined(trial, "gpb", 0)
    assert_same(run("aoe", trial), reference, 1e-9)
    assert_same(run("gpb1", trial), reference, 1e-9)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("acks", ["none", "late"])
@pytest.mark.parametrize("losses", KINDS)
@pytest.mark.parametrize("seed", range(3))
def test_gpb_is_moment_matching_of_what_differs_in_older_bits(seed: int, losses: str, acks: str, order: int) -> None:
    trial = _trial(seed, acks, steps=8, losses=losses)
    assert_same(run("gpb", trial, {"order": order}), _defined(trial, "gpb", order), 1e-9)


@check(30)
@given(trials(chains=KINDS, acks=("none", "subset"), steps=(1, 8), lanes=(1, 3)))
def test_imm_has_a_mode_for_each_state_and_fate(trial: Trial) -> None:
    assert_same(run("imm", trial), _defined(trial, "imm"), 1e-9)


@check(20)
@given(trials(chains=KINDS, acks=("all",), steps=(1, 10)))
def test_with_every_ack_all_are_kfio(trial: Trial) -> None:
    for kind, options in HOLDING:
        assert_same(run(kind, trial, options), run("kfio", trial), 1e-9)


@pytest.mark.parametrize("losses", KINDS)
@pytest.mark.parametrize("acks", ["none", "subset"])
def test_many_particles_have_the_moments_of_the_posterior(acks: str, losses: str) -> None:
    trial = _trial(7, acks, steps=5, losses=losses)
    x_hat, P = run("pf", trial, {"particles": 60_000})
    exact_x, exact_P = _enumerated(trial)
    spread = np.sqrt(np.trace(exact_P, axis1=2, axis2=3))
    assert (np.linalg.norm(x_hat - exact_x, axis=2) < 0.08 * spread).all()  # four times 1/sqrt(effective particles)
    assert (np.abs(P - exact_P).max(axis=(2, 3)) < 0.06 * spread**2).all()


@pytest.mark.parametrize(("kind", "options"), [*HOLDING, ("pf", {"particles": 100})])
@pytest.mark.parametrize("acks", ["none", "late"])
def test_where_the_state_is_the_fate_it_is_the_chain(kind: str, options: dict[str, int], acks: str) -> None:
    """Exactly, by the smallest law; and in the limit, with a hidden state of its own."""
    trial = _trial(3, acks, steps=8)
    chain = replace(trial.system, recovery=0.4, failure=0.3, start=0.6, channel=None)
    reference = run(kind, replace(trial, system=chain), options)
    same = replace(trial.system, channel=Channel(0.3, 0.4, 0.0, 1.0, 0.6))
    near = replace(trial.system, channel=Channel(0.3, 0.4, 1e-15, 1.0 - 1e-15, 0.6))
    assert (len(law_of(losses_of(same)).arrived), len(law_of(losses_of(near)).arrived)) == (2, 4)
    assert_same(run(kind, replace(trial, system=same), options), reference, 1e-12)
    if kind != "pf":
        assert_same(run(kind, replace(trial, system=near), options), reference, 1e-11)


@pytest.mark.parametrize(("kind", "options"), [*HOLDING, ("lmmse", {}), ("ff", {}), ("pf", {"particles": 100})])
@pytest.mark.parametrize("acks", ["none", "late"])
def test_where_the_states_are_alike_it_is_bernoulli(kind: str, options: dict[str, int], acks: str) -> None:
    trial = _trial(4, acks, steps=8)
    chain = replace(trial.system, recovery=0.7, failure=1.0 - 0.7, start=0.7, channel=None)
    reference = run(kind, replace(trial, system=chain), options)
    alike = replace(trial.system, channel=Channel(0.3, 0.4, 0.3, 0.3, 0.6))
    assert_same(run(kind, replace(trial, system=alike), options), reference, 1e-12)
    if kind in ("aoe", "gpb", "gpb1", "gpb2"):
        near = replace(trial.system, channel=Channel(0.3, 0.4, 0.3 - 1e-14, 0.3 + 1e-14, 0.6))
        assert_same(run(kind, replace(trial, system=near), options), reference, 1e-11)


@pytest.mark.parametrize(("kind", "options"), [*HOLDING, ("pf", {"particles": 50})])
def test_a_split_of_the_lanes_changes_no_bit(kind: str, options: dict[str, int]) -> None:
    trial = _trial(5, "late", lanes=4)
    whole = run(kind, trial, options)
    for lane in range(4 if kind != "pf" else 1):
        part = run(kind, trial.of_lanes(slice(lane, lane + 1)), options)
        for one, all_lanes in zip(part, whole, strict=True):
            np.testing.assert_array_equal(one[:, 0], all_lanes[:, lane])


@pytest.mark.parametrize("kind", ["ff", "lmmse"])
def test_filters_for_independent_losses_refuse(kind: str) -> None:
    with pytest.raises(UsageError, match=r"holds for i\.i\.d\. control losses only"):
        create(kind, model_of(_trial(1, "none").system), lanes=1)


@check(40)
@given(trials(chains=(HIDDEN,), steps=(6, 6), lanes=(1, 1)))
def test_the_covariance_factor_covers_the_covariance_of_the_losses(trial: Trial) -> None:
    """Row sums of |Cov(ν_i, ν_j)| over all histories are at most ¼ of it: Gershgorin's theorem does the rest."""
    system = trial.system
    histories = np.array(np.meshgrid(*[[0, 1]] * 6, indexing="ij")).reshape(6, -1)
    priors = np.array([system.prior(tuple(map(int, history))) for history in histories.T])
    assert priors.sum() == pytest.approx(1.0)
    away = histories - (histories @ priors)[:, None]
    covariance = (away * priors) @ away.T
    factor = losses_of(system).covariance_factor
    assert factor is not None
    assert np.abs(covariance).sum(axis=1).max() <= 0.25 * factor + 1e-12
