"""Estimators for an actuator that holds: against enumeration of all histories with the input that each of them applies.

The reference says what is applied by looking for the newest arrival of a history, and conditions the stacked Gaussian.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given

from estimator.agreement import Run, assert_same
from estimator.reference import gaussian, held
from estimator.reference.cases import ACKS, HIDDEN, Trial, check, random_system, random_trial, systems, trials
from estimator.reference.compare import smallest_eigenvalue
from estimator.reference.drive import acks_at, losses_of, model_of, run
from estimator.reference.ff import ff
from estimator.reference.histories import weighted_histories
from estimator.reference.lmmse import lmmse
from testbed.channel.loss import Chain
from testbed.errors import UsageError
from testbed.estimator import Filter
from testbed.estimator.bounds import Bounds, held_factor
from testbed.estimator.errors import MissingAck, TooManyHistories
from testbed.estimator.hold import applied_inputs
from testbed.estimator.kfio_block import filter_block
from testbed.estimator.model import Ack, Estimate, Model
from testbed.estimator.packets import read_packets, replay
from testbed.estimator.registry import create

CHAINS = ("bernoulli", "markov", HIDDEN)
FAMILY = [("aoe", {}), ("gpb", {"order": 0}), ("gpb", {"order": 2}), ("gpb1", {}), ("gpb2", {}), ("imm", {})]
ALL = [*FAMILY, ("oe-exact", {}), ("oe", {}), ("kfio", {}), ("kf", {}), ("rseio", {}), ("pf", {"particles": 40})]
LINEAR = ["lmmse", "ff"]
TOLERANCE = 1e-9


def holding(trial: Trial) -> Trial:
    """The same losses, inputs and observations, with an actuator that holds."""
    return replace(trial, system=replace(trial.system, hold=True))


def drawn(seed: int, chain: str, acks: str, steps: int = 6, lanes: int = 3, n: int = 2, q: int = 1) -> Trial:
    """One whose observations come from a plant that holds."""
    rng = np.random.default_rng([seed, CHAINS.index(chain), ACKS.index(acks), n])
    system = replace(random_system(rng, n, 1, q, chain), hold=True)
    return random_trial(rng, system, steps, lanes, acks)


def by_lane(trial: Trial, estimates: Callable[[int], list[gaussian.Estimate]]) -> Run:
    outs = [estimates(lane) for lane in range(trial.lanes)]
    x_hat, P = (np.array([[step[i] for step in out] for out in outs]).swapaxes(0, 1) for i in (0, 1))
    return x_hat, P


def defined(trial: Trial, reference: Callable[..., gaussian.Estimate], in_time: bool = False) -> Run:
    """A reference for one step, at every step."""

    def lane_of(lane: int) -> list[gaussian.Estimate]:
        known = trial.known_in_time if in_time else trial.known
        return [
            reference(trial.system, trial.u[:k, lane], trial.y[:k, lane], trial.arrived[:k, lane], known(k, lane))
            for k in range(1, trial.steps + 1)
        ]

    return by_lane(trial, lane_of)


def merged(trial: Trial, order: int | None) -> Run:
    """GPB of that order, or IMM."""

    def lane_of(lane: int) -> list[gaussian.Estimate]:
        given_ = trial.system, trial.u[:, lane], trial.y[:, lane], trial.arrived[:, lane]
        if order is None:
            return held.imm(*given_, trial.known_in_time(trial.steps, lane))
        known = [trial.known(k, lane) for k in range(1, trial.steps + 1)]
        return held.gpb(given_[0], order, *given_[1:], known)

    return by_lane(trial, lane_of)


@check(30)
@given(trials(chains=CHAINS, steps=(1, 5), lanes=(1, 3)))
def test_oe_is_the_mixture_over_histories(trial: Trial) -> None:
    trial = holding(trial)
    reference = defined(trial, gaussian.oe)
    assert_same(run("oe-exact", trial), reference, TOLERANCE)
    assert_same(run("oe", trial), reference, TOLERANCE)


@check(30)
@given(trials(chains=CHAINS, steps=(1, 5), lanes=(1, 3)))
def test_gpb_of_order_k_is_the_mixture_over_histories(trial: Trial) -> None:
    trial = holding(trial)
    assert_same(run("gpb", trial, {"order": trial.steps}), defined(trial, gaussian.oe), TOLERANCE)


@pytest.mark.parametrize("acks", ACKS)
@pytest.mark.parametrize("chain", CHAINS)
def test_at_eight_steps_of_a_plant_that_holds(chain: str, acks: str) -> None:
    trial = drawn(1, chain, acks, steps=8, lanes=2, q=2)
    reference = defined(trial, gaussian.oe)
    assert_same(run("oe-exact", trial), reference, TOLERANCE)
    assert_same(run("gpb", trial, {"order": 8}), reference, TOLERANCE)


@check(20)
@given(trials(chains=CHAINS, acks=("none", "subset"), steps=(1, 5), lanes=(1, 2)))
def test_gpb_of_order_d_is_exact_up_to_step_d_and_one(trial: Trial) -> None:
    trial = holding(trial)
    assert_same(run("gpb", trial, {"order": trial.steps - 1}), run("oe-exact", trial), TOLERANCE)


@pytest.mark.parametrize("acks", ["none", "subset", "late"])
@pytest.mark.parametrize("chain", ["bernoulli", "markov"])
@pytest.mark.parametrize("seed", range(3))
def test_the_family_merges_the_moments_of_state_and_input(seed: int, chain: str, acks: str) -> None:
    trial = drawn(seed, chain, acks, steps=8, lanes=2, n=1 + seed % 2, q=1 + seed % 2)
    none = merged(trial, 0)
    for kind in ("aoe", "gpb1"):
        assert_same(run(kind, trial), none, TOLERANCE)
    for order in (1, 2):
        assert_same(run("gpb", trial, {"order": order}), merged(trial, order), TOLERANCE)
    assert_same(run("gpb2", trial), merged(trial, 1), TOLERANCE)
    assert_same(run("imm", trial), merged(trial, None), TOLERANCE)
    if chain == "bernoulli":
        assert_same(run("imm", trial), none, TOLERANCE)


@pytest.mark.parametrize("acks", ACKS)
@pytest.mark.parametrize("seed", range(3))
def test_aoe_is_gpb_of_order_zero_where_losses_have_a_hidden_state(seed: int, acks: str) -> None:
    trial = drawn(seed, HIDDEN, acks, steps=8)
    trial = replace(trial, ack_step=np.where(trial.ack_step == np.arange(1, 9)[:, None], trial.ack_step, 0))
    assert_same(run("aoe", trial), run("gpb1", trial), TOLERANCE)


@check(30)
@given(trials(chains=("bernoulli",), steps=(1, 5), lanes=(1, 3)))
def test_lmmse_is_the_regression_on_all_that_was_received(trial: Trial) -> None:
    trial = holding(trial)
    assert_same(run("lmmse", trial), defined(trial, lmmse, in_time=True), TOLERANCE)


@check(30)
@given(trials(chains=("bernoulli",), steps=(1, 5), lanes=(1, 3)))
def test_the_covariance_of_ff_is_that_of_its_error(trial: Trial) -> None:
    trial = holding(trial)
    assert_same(run("ff", trial), defined(trial, ff, in_time=True), TOLERANCE)


@pytest.mark.parametrize("kind", LINEAR)
@pytest.mark.parametrize("acks", ["none", "subset"])
def test_linear_filters_at_eight_steps_of_a_plant_that_holds(kind: str, acks: str) -> None:
    trial = drawn(2, "bernoulli", acks, steps=8, lanes=2, q=2)
    assert_same(run(kind, trial), defined(trial, {"lmmse": lmmse, "ff": ff}[kind], in_time=True), TOLERANCE)


@check(15)
@given(trials(chains=("bernoulli",), acks=("all",), steps=(1, 8)))
def test_with_every_ack_it_is_the_kalman_filter_on_what_was_applied(trial: Trial) -> None:
    trial = holding(trial)
    applied = np.stack([trial.system.applied(trial.u[:, i], trial.nu[None, :, i])[0] for i in range(trial.lanes)], 1)
    plain = replace(trial.system, hold=False, recovery=1.0, failure=0.0, start=1.0)
    known = replace(trial, system=plain, u=applied, nu=np.ones_like(trial.nu))
    reference = run("kfio", known)
    for kind in ("kfio", "kf"):
        assert_same(run(kind, trial), reference, 1e-12)
    for kind, options in (*FAMILY, *((kind, {}) for kind in LINEAR), ("oe-exact", {})):
        assert_same(run(kind, trial, options), reference, TOLERANCE)
    for kind in ("rseio", "rse", "rsemm"):
        assert_same(run(kind, trial), run(kind, known), 1e-12)


@pytest.mark.parametrize("chain", CHAINS)
@pytest.mark.parametrize("acks", ["none", "subset"])
def test_many_particles_have_the_moments_of_the_posterior(chain: str, acks: str) -> None:
    trial = drawn(5, chain, acks, lanes=1)
    x_hat, P = run("pf", trial, {"particles": 60_000})
    exact_x, exact_P = defined(trial, gaussian.oe, in_time=True)
    spread = np.sqrt(np.trace(exact_P, axis1=2, axis2=3))
    assert (np.linalg.norm(x_hat - exact_x, axis=2) < 0.08 * spread).all()  # four times 1/sqrt(effective particles)
    assert (np.abs(P - exact_P).max(axis=(2, 3)) < 0.06 * spread**2).all()


@pytest.mark.parametrize(("kind", "options"), [*ALL, *((kind, {}) for kind in LINEAR)])
def test_where_nothing_is_lost_hold_is_zero_to_the_bit(kind: str, options: dict[str, int]) -> None:
    trial = drawn(3, "bernoulli", "none")
    lossless = replace(trial.system, recovery=1.0, failure=0.0, start=1.0)
    holds, zero = (run(kind, replace(trial, system=replace(lossless, hold=hold)), options) for hold in (True, False))
    for one, other in zip(holds, zero, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(("kind", "options"), [*ALL[:-1], *((kind, {}) for kind in LINEAR)])
def test_a_constant_input_held_from_its_first_arrival_is_one_that_is_never_lost(
    kind: str, options: dict[str, int]
) -> None:
    """With its first ACK alone, for those that need no more: u and what is held are the same."""
    trial = drawn(4, "bernoulli", "none", steps=8)
    trial.u[:] = trial.u[0]
    trial.nu[0], trial.ack_step[0] = 1, 1
    lossless = replace(trial.system, hold=False, recovery=1.0, failure=0.0, start=1.0)
    reference = run("rseio" if kind == "rseio" else "kfio", replace(trial, system=lossless))
    assert_same(run(kind, trial, options), reference, TOLERANCE)


@pytest.mark.parametrize(("kind", "options"), [*ALL, *((kind, {}) for kind in LINEAR)])
def test_a_split_of_the_lanes_changes_no_bit(kind: str, options: dict[str, int]) -> None:
    needs = kind in ("kfio", "kf", "rseio")
    trial = drawn(6, "bernoulli", "all" if needs else "late", lanes=3, q=2)
    whole = run(kind, trial, options)
    for lane in range(3 if kind != "pf" else 1):
        part = run(kind, trial.of_lanes(slice(lane, lane + 1)), options)
        for one, all_lanes in zip(part, whole, strict=True):
            np.testing.assert_array_equal(one[:, 0], all_lanes[:, lane])


@pytest.mark.parametrize("kind", ["aoe", "gpb2", "lmmse", "ff"])
def test_compiled_for_many_lanes_it_has_the_same_bits(kind: str) -> None:
    trial = drawn(7, "bernoulli", "all" if kind == "kfio" else "subset", steps=4, lanes=1100, n=1)
    whole, some = run(kind, trial), run(kind, trial.of_lanes(slice(0, 40)))
    for many, few in zip(whole, some, strict=True):
        np.testing.assert_array_equal(many[:, :40], few)


@check(20)
@given(trials(chains=CHAINS, steps=(3, 8), lanes=(1, 3)))
def test_what_a_hypothesis_knows_of_the_input_is_exact(trial: Trial) -> None:
    """GPB 2 after a step has one bit more than it keeps: those whose newest packet arrived hold u without error."""
    trial = holding(trial)
    n, lanes = trial.system.n, trial.lanes
    estimator = create("gpb", model_of(trial.system), lanes=lanes, options={"order": 2})
    for k in range(trial.steps):
        estimator.step(trial.u[k], trial.y[k], trial.arrived[k])
        state: dict[str, Any] = estimator.state()  # type: ignore[attr-defined]
        half = state["score"].size // 2
        assert (state["P"][n:, :, half:] == 0.0).all()
        for i in range(trial.system.q):
            sent = np.tile(trial.u[k, :, i], half // lanes)
            np.testing.assert_allclose(state["x"][n + i, half:], sent, rtol=1e-14)


@check(12)
@given(trials(chains=CHAINS, acks=("none", "subset"), steps=(8, 14), lanes=(2, 2)))
def test_p_is_a_covariance_not_below_that_with_every_ack(trial: Trial) -> None:
    trial = holding(trial)
    bounds = Bounds(model_of(trial.system), None, trial.lanes)
    lower = np.array([bounds.step(arrived)[0] for arrived in trial.arrived])
    for kind, options in FAMILY:
        _, P = run(kind, trial, options)
        for k in range(trial.steps):
            for lane in range(trial.lanes):
                assert smallest_eigenvalue(P[k, lane]) > -1e-9
                scale = np.abs(P[k, lane]).max()
                assert np.linalg.eigvalsh(P[k, lane] - lower[k, lane]).min() > -1e-9 * scale


@check(30)
@given(systems(chains=("bernoulli",)))
def test_the_factor_covers_the_covariance_of_what_is_applied(system: Any) -> None:
    """diag(D, …, D) times it is not below the covariance of (a_0, …, a_5) over all histories, D ≥ each Var(a_k)."""
    system = replace(system, hold=True)
    u = np.random.default_rng(system.n).uniform(-1.0, 3.0, size=(6, system.q))
    histories, priors = weighted_histories(system, 6, {})
    applied = system.applied(u, histories).reshape(len(histories), -1)
    away = applied - priors @ applied
    covariance = (away * priors[:, None]).T @ away
    width = np.maximum(u.max(axis=0), 0.0) - np.minimum(u.min(axis=0), 0.0)
    factor = held_factor(losses_of(system))
    assert factor is not None
    cover = 0.25 * factor * float(width @ width) * np.eye(len(covariance))
    assert np.linalg.eigvalsh(cover - covariance).min() >= -1e-12


@check(30)
@given(trials(chains=("bernoulli",), acks=("none",), steps=(4, 10), lanes=(2, 2)))
def test_the_upper_bound_is_not_below_the_best_linear_filter(trial: Trial) -> None:
    """Whose P is exact (see above), and not below E[P] of OE."""
    trial = holding(trial)
    trial.u[:] = trial.u[:, :1]
    system, u = trial.system, trial.u[:, 0]
    width = np.maximum(u.max(axis=0), 0.0) - np.minimum(u.min(axis=0), 0.0)
    bounds = Bounds(model_of(system), float(width @ width) * system.B @ system.B.T, trial.lanes)
    for P, arrived in zip(run("lmmse", trial)[1], trial.arrived, strict=True):
        upper = bounds.step(arrived)[1]
        assert upper is not None
        for one, bound in zip(P, upper, strict=True):
            assert np.linalg.eigvalsh(bound - one).min() >= -1e-9 * np.abs(bound).max()


@pytest.mark.parametrize("control", [Chain.markov(0.4, 0.3), Chain.bernoulli(0.0)])
def test_no_upper_bound_where_none_is_known(control: Chain) -> None:
    model = replace(model_of(drawn(1, "markov", "none").system), control=control)
    assert Bounds(model, np.eye(2), 1).step(np.array([True]))[1] is None


def test_kfio_needs_an_ack_where_what_is_held_is_not_u() -> None:
    trial = drawn(1, "bernoulli", "none", lanes=1)
    estimator = create("kfio", model_of(trial.system), lanes=1)
    none, ack = np.zeros((1, 1)), (Ack(1, np.array([1]), np.array([1])),)
    blank, u = (np.zeros((1, 1)), np.array([False])), np.ones((1, 1))
    estimator.step(none, *blank)  # zero is held, and zero is sent
    estimator.step(u, *blank, ack)
    estimator.step(u, *blank)
    with pytest.raises(MissingAck, match="needs the ACK of control packet 3 at step 4"):
        estimator.step(none, *blank)


class Plain:
    """An estimator that knows nothing of actuators."""

    def __init__(self, model: Model, lanes: int) -> None:
        self.counters: dict[str, int] = {}
        self._prior = Estimate(*model.prior(lanes), lanes)

    def step(self, *_: Any) -> Estimate:
        return self._prior


def test_an_estimator_that_is_not_made_for_it_is_refused() -> None:
    model = model_of(drawn(1, "bernoulli", "none").system)
    with pytest.raises(UsageError, match=r"Plain' is for an actuator that applies zero on a loss.*gpb, oe-exact"):
        Filter(Plain, model)
    Filter(Plain, replace(model, on_loss="zero"))
    Filter(Plain, replace(model, control=Chain.lossless()))
    Filter(Plain, replace(model, B=None))


@pytest.mark.parametrize(("kind", "options"), [*ALL, *((kind, {}) for kind in LINEAR)])
def test_moments_do_not_say_what_is_held(kind: str, options: dict[str, int]) -> None:
    """They are refused but for step 0; a full snapshot goes on to the same bits."""
    trial = drawn(8, "bernoulli", "all", lanes=1)
    one, other = (Filter(kind, model_of(trial.system), **options) for _ in range(2))
    other.restore(one.snapshot("moments"))
    for k in range(3):
        one.predict(trial.u[k, 0], nu=trial.nu[k, 0])
        one.update(trial.y[k, 0])
    with pytest.raises(UsageError, match="do not say which input was applied last"):
        other.restore(one.snapshot("moments"))
    other.restore(one.snapshot().to_bytes())
    for each in (one, other):
        each.predict(trial.u[3, 0], nu=trial.nu[3, 0])
        each.update(trial.y[3, 0])
    np.testing.assert_array_equal(one.x_hat, other.x_hat)
    np.testing.assert_array_equal(one.P, other.P)


def test_oe_refuses_what_it_cannot_enumerate() -> None:
    trial = drawn(1, "bernoulli", "none", lanes=1)
    filter_ = Filter("oe", model_of(trial.system), max_histories=4)
    for _ in range(2):
        filter_.predict(np.ones(1))
        filter_.update(None)
    filter_.predict(np.ones(1))
    with pytest.raises(TooManyHistories, match=r"oe would need 8 histories at step 3; .*or use gpb"):
        filter_.update(None)


@pytest.mark.parametrize(
    ("kind", "acks"), [("gpb", "late"), ("oe-exact", "late"), ("lmmse", "subset"), ("kfio", "all")]
)
def test_a_replay_has_the_estimates_of_the_steps(kind: str, acks: str) -> None:
    trial = drawn(10, "bernoulli", acks, lanes=1)
    model, lines = model_of(trial.system), []
    for k in range(1, trial.steps + 1):
        heard = [[ack.j, int(ack.nu[0])] for ack in acks_at(trial, k)]
        y = trial.y[k - 1, 0].tolist() if trial.arrived[k - 1, 0] else None
        lines.append(json.dumps({"k": k, "u": trial.u[k - 1, 0].tolist(), "y": y, "acks": heard}))
    out = replay(create(kind, model, lanes=1), model, read_packets(lines, model), use_acks=True)
    x_hat, P = run(kind, trial)
    for k, text in enumerate(out):
        line = json.loads(text)
        assert (line["x_hat"], line["P"]) == (x_hat[k, 0].tolist(), P[k, 0].tolist())


def test_blocks_are_for_applied_inputs() -> None:
    trial = drawn(9, "bernoulli", "all", lanes=2)
    model = model_of(trial.system)
    y, u = trial.y.swapaxes(1, 2), trial.u.swapaxes(1, 2)
    with pytest.raises(UsageError, match=r"applied_inputs"):
        filter_block(model, y, trial.arrived, u, trial.nu)
    lossless = replace(model, control=Chain.lossless())
    block = filter_block(lossless, y, trial.arrived, applied_inputs(u, trial.nu))
    assert_same((block.x_hat.transpose(0, 2, 1), block.P.transpose(0, 3, 1, 2)), run("kfio", trial), 1e-12)
    first = applied_inputs(u[:3], trial.nu[:3])
    rest = applied_inputs(u[3:], trial.nu[3:], first[-1])
    np.testing.assert_array_equal(np.concatenate([first, rest]), applied_inputs(u, trial.nu))
