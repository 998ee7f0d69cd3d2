"""Restart and hand-over: a run that goes on from a snapshot is the run without one."""

from __future__ import annotations

from dataclasses import replace
from hashlib import blake2b
from itertools import product
from typing import Any, ClassVar

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimator.reference.cases import Floats, Trial, check, random_system, random_trial
from estimator.reference.drive import acks_at, model_of
from testbed.errors import UsageError
from testbed.estimator.model import Ack, Estimate, Estimator
from testbed.estimator.registry import create
from testbed.estimator.snapshot import MAX_BYTES, Snapshot, restore, take

KINDS = [
    "aoe",
    "ff",
    "gpb",
    "gpb1",
    "gpb2",
    "imm",
    "kf",
    "kfio",
    "lmmse",
    "oe",
    "oe-exact",
    "pf",
    "rse",
    "rseio",
    "rsemm",
]
NEEDS_ACKS = ("kf", "kfio", "rse", "rseio", "rsemm")
INDEPENDENT = ("ff", "lmmse")
STEPS = 9
OPTIONS: dict[str, dict[str, Any]] = {"pf": {"particles": 40}, "gpb": {"order": 3}}


def trial_of(kind: str, lanes: int, acks: str, seed: int = 1, n: int = 2) -> Trial:
    rng = np.random.default_rng(seed)
    system = random_system(rng, n, 1, 1, "bernoulli" if kind in INDEPENDENT else "markov")
    return random_trial(rng, system, STEPS, lanes, "all" if kind in NEEDS_ACKS else acks)


def made(kind: str, trial: Trial) -> Estimator:
    return create(kind, model_of(trial.system), lanes=trial.lanes, options=OPTIONS.get(kind), lane=5)


def advance(estimator: Estimator, trial: Trial, k: int) -> Estimate:
    return estimator.step(trial.u[k - 1], trial.y[k - 1], trial.arrived[k - 1], acks_at(trial, k))


def prior(trial: Trial) -> Estimate:
    return Estimate(*model_of(trial.system).prior(trial.lanes), trial.lanes)


def after(kind: str, trial: Trial, steps: int) -> tuple[Estimator, Estimate]:
    estimator, estimate = made(kind, trial), prior(trial)
    for k in range(1, steps + 1):
        estimate = advance(estimator, trial, k)
    return estimator, estimate


def snapshot_of(kind: str, trial: Trial, steps: int) -> Snapshot:
    estimator, estimate = after(kind, trial, steps)
    return take(estimator, "full", step=steps, estimate=estimate)


@pytest.mark.parametrize("lanes", [1, 4])
@pytest.mark.parametrize("kind", KINDS)
def test_a_run_goes_on_from_a_full_snapshot_to_the_same_bits(kind: str, lanes: int) -> None:
    for number, acks in enumerate(("none", "all", "subset", "late")):
        trial = trial_of(kind, lanes, acks, seed=number)
        estimator, estimate = made(kind, trial), prior(trial)
        restored: list[Estimator] = []
        for k in range(STEPS + 1):
            if k:
                estimate = advance(estimator, trial, k)
                for other in restored:
                    again = advance(other, trial, k)
                    np.testing.assert_array_equal(again.x_hat, estimate.x_hat)
                    np.testing.assert_array_equal(again.P, estimate.P)
                    assert other.counters == estimator.counters
            if k in (0, 1, 2, 6):
                data = take(estimator, "full", step=k, estimate=estimate).to_bytes()
                restored.append(made(kind, trial))
                restore(Snapshot.from_bytes(data), restored[-1], lanes=lanes, n=trial.system.n, step=k)


def test_a_state_is_a_copy() -> None:
    for kind, lanes in product(KINDS, (1, 3)):
        trial = trial_of(kind, lanes, "none", n=1)
        estimator, _ = after(kind, trial, 4)
        twin, _ = after(kind, trial, 4)
        given_away = estimator.state()  # type: ignore[attr-defined]
        estimator.set_state(given_away)  # type: ignore[attr-defined]
        for array in given_away.values():
            array[...] = 0
        np.testing.assert_array_equal(advance(estimator, trial, 5).P, advance(twin, trial, 5).P)


@pytest.mark.parametrize("target", KINDS)
def test_any_kind_starts_from_the_moments_of_any(target: str) -> None:
    for source in KINDS:
        trial = trial_of(source, 2, "none", seed=3)
        if target in INDEPENDENT and source not in INDEPENDENT:
            trial = replace(trial, system=trial_of("ff", 2, "none", seed=3).system)
        taken = snapshot_of(source, trial, 5).moments()
        estimator = made(target, trial)
        restore(Snapshot.from_bytes(taken.to_bytes()), estimator, lanes=2, n=2)
        packet = Ack(5, trial.nu[5], np.ones(2, dtype=np.bool_))
        nothing = np.zeros(2, dtype=np.bool_)
        out = estimator.step(trial.u[5], trial.y[5], nothing, (packet,))
        assert estimator.counters == {}  # an ACK of packet 5 at step 6 is in time
        A, B, Q = trial.system.A, trial.system.B, trial.system.Q
        mean = taken.arrays["x_hat"] @ A.T + trial.nu[5][:, None] * (trial.u[5] @ B.T)
        covariance = A @ taken.arrays["P"] @ A.T + Q
        if target == "pf":  # samples
            assert np.isfinite(out.x_hat).all()
            assert np.isfinite(out.P).all()
            continue
        np.testing.assert_allclose(out.x_hat, mean, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(out.P, covariance, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("kind", ["kfio", "kf", "rseio", "rse"])
@pytest.mark.parametrize("lanes", [1, 3])
def test_for_a_kalman_filter_the_moments_are_everything(kind: str, lanes: int) -> None:
    trial = trial_of(kind, lanes, "all", seed=8)
    estimator, estimate = after(kind, trial, 4)
    restarted = made(kind, trial)
    restore(take(estimator, "moments", step=4, estimate=estimate), restarted, lanes=lanes, n=2)
    for k in range(5, STEPS + 1):
        expected, out = advance(estimator, trial, k), advance(restarted, trial, k)
        np.testing.assert_allclose(out.x_hat, expected.x_hat, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(out.P, expected.P, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("lanes", [1, 3])
@pytest.mark.parametrize("step", [0, 1, 2, 7])
@pytest.mark.parametrize("kind", ["aoe", "gpb", "gpb1", "gpb2", "imm", "pf", "ff", "lmmse"])
def test_from_moments_the_control_chain_has_the_law_of_its_step(kind: str, step: int, lanes: int) -> None:
    """Nothing observed: the mean of x is A x̂ + π B u, π = P(ν_step = 1) by stepping the chain from its start."""
    trial = trial_of(kind, lanes, "none", seed=11)
    system, particles = trial.system, 200_000
    options = {"particles": particles} if kind == "pf" else None
    estimator = create(kind, model_of(system), lanes=lanes, options=options)
    rng = np.random.default_rng(2)
    x_hat, root = rng.normal(size=(lanes, 2)), rng.normal(size=(lanes, 2, 2))
    P = root @ root.transpose(0, 2, 1)
    estimator.start_from(step, x_hat, P)  # type: ignore[attr-defined]
    delivered = system.start
    for _ in range(step):
        delivered = delivered * (1.0 - system.failure) + (1.0 - delivered) * system.recovery
    out = estimator.step(trial.u[0], trial.y[0], np.zeros(lanes, dtype=np.bool_))
    push = trial.u[0] @ system.B.T
    mean = x_hat @ system.A.T + delivered * push
    spread = delivered * (1.0 - delivered) * push[:, :, None] * push[:, None, :]
    covariance = system.A @ P @ system.A.T + system.Q + spread
    tolerance = 8.0 / particles**0.5 if kind == "pf" else 1e-12
    scale = np.abs(covariance).max()
    np.testing.assert_allclose(out.x_hat, mean, rtol=0.0, atol=tolerance * scale**0.5)
    np.testing.assert_allclose(out.P, covariance, rtol=0.0, atol=tolerance * scale)


def test_particles_of_a_start_are_not_those_of_the_run() -> None:
    trial = trial_of("pf", 1, "none", n=1)
    fresh, started = made("pf", trial), made("pf", trial)
    started.start_from(0, prior(trial).x_hat, prior(trial).P)  # type: ignore[attr-defined]
    assert not (fresh.state()["x"] == started.state()["x"]).any()  # type: ignore[attr-defined]


def test_bytes_hold_all_of_a_snapshot() -> None:
    taken = snapshot_of("pf", trial_of("pf", 3, "late"), 4)
    read = Snapshot.from_bytes(taken.to_bytes())
    assert (read.form, read.kind, read.version, read.step, read.lanes, read.n) == ("full", "pf", 1, 4, 3, 2)
    assert read.arrays.keys() == taken.arrays.keys()
    for name, array in taken.arrays.items():
        assert read.arrays[name].dtype == array.dtype
        np.testing.assert_array_equal(read.arrays[name], array)


def resealed(body: bytes) -> bytes:
    return body + blake2b(body, digest_size=16).digest()


def refused(data: bytes) -> bool:
    """Whether bytes are refused, as they may be in one way only; those that are taken may fit an estimator or not."""
    try:
        taken = Snapshot.from_bytes(data)
        estimator = made("gpb", trial_of("gpb", 2, "none"))
        restore(taken, estimator, lanes=2, n=2)
    except UsageError as error:
        return len(str(error).splitlines()) == 1 or pytest.fail(f"not one line: {error}")
    return False


GOOD = snapshot_of("gpb", trial_of("gpb", 2, "none"), 4).to_bytes()


@check(150)
@given(st.data())
def test_damaged_bytes_are_refused(data: st.DataObject) -> None:
    place, value = data.draw(st.integers(0, len(GOOD) - 1)), data.draw(st.integers(0, 255))
    damaged = GOOD[:place] + bytes([value]) + GOOD[place + 1 :]
    assert refused(damaged) == (damaged != GOOD)
    assert refused(GOOD[:place])
    assert refused(GOOD + GOOD[:place]) == (place > 0)


@check(400)
@given(st.data())
def test_forged_bytes_are_taken_or_refused_and_nothing_else(data: st.DataObject) -> None:
    """With a digest that matches: headers and arrays changed at will."""
    body = bytearray(GOOD[:-16])
    for _ in range(data.draw(st.integers(1, 4))):
        inside = data.draw(st.sampled_from([40, 350, len(body) - 1]))
        body[data.draw(st.integers(4, inside))] = data.draw(
            st.integers(0, 255) | st.sampled_from(b'0123456789[],{}"-e.')
        )
    refused(resealed(bytes(body)))
    refused(resealed(bytes(body) + data.draw(st.binary(max_size=40))))


@check(150)
@given(st.binary(max_size=200))
def test_garbage_is_refused(data: bytes) -> None:
    assert refused(data)
    assert refused(resealed(b"NCSS" + len(data).to_bytes(4, "little") + data))


def test_deep_and_large_headers_are_refused() -> None:
    for text in (b"[" * 60_000, b'{"arrays":[["x","<f8",[2147483648,2147483648,0]]]}', b" " * 70_000):
        assert refused(resealed(b"NCSS" + len(text).to_bytes(4, "little") + text))
    good = GOOD[8 : 8 + int.from_bytes(GOOD[4:8], "little")]
    for shape in (b"[2147483648,2147483648,2147483648,2147483648,0]", b"[2147483648,2147483648]"):
        text = good.replace(b'["P","<f8",[2,2,2]]', b'["P","<f8",' + shape + b"]")
        assert text != good
        assert refused(resealed(b"NCSS" + len(text).to_bytes(4, "little") + text))


def test_what_bytes_cannot_hold_is_said() -> None:
    trial = trial_of("kfio", 1, "all")
    taken = snapshot_of("kfio", trial, 2)
    for array, expected in (
        (np.array([np.nan]), "snapshot: 'state.z' holds a value that is not finite"),
        (np.array(["a"]), "snapshot: 'state.z' is <U1; allowed: float64, int64, uint8"),
        (np.broadcast_to(0.0, MAX_BYTES // 8), f"snapshot of {MAX_BYTES + 104} bytes; allowed: {MAX_BYTES - 65536}"),
    ):
        with pytest.raises(UsageError) as refusal:
            replace(taken, arrays={**taken.arrays, "state.z": array}).to_bytes()
        assert str(refusal.value) == expected
    with pytest.raises(UsageError, match=r"snapshot: step: Input should be greater than or equal to 0"):
        replace(taken, step=-1).to_bytes()


@pytest.mark.parametrize(
    ("changes", "into", "expected"),
    [
        ({}, "kfio", "snapshot: of 'aoe', in full; expected 'kfio', or the moments of any kind"),
        ({"version": 2}, "aoe", "snapshot: version 2 of the state of 'aoe'; expected 1, or moments"),
        ({"lanes": 3}, "aoe", "snapshot: lanes is 3; expected 2"),
        ({"n": 3}, "aoe", "snapshot: n is 3; expected 2"),
        ({"step": 7}, "aoe", "snapshot: step is 7; expected 4"),
    ],
)
def test_a_snapshot_for_another_estimator_is_refused(changes: dict[str, Any], into: str, expected: str) -> None:
    trial = trial_of("aoe", 2, "none")
    taken = replace(snapshot_of("aoe", trial, 4), **changes)
    with pytest.raises(UsageError) as refusal:
        restore(taken, made(into, trial), lanes=2, n=2, step=4)
    assert str(refusal.value) == expected


def test_a_state_of_other_options_is_refused_and_changes_nothing() -> None:
    for kind, ours, theirs in (("gpb", {"order": 1}, {"order": 4}), ("pf", {"particles": 30}, {"particles": 40})):
        trial = trial_of(kind, 2, "none")
        source = create(kind, model_of(trial.system), lanes=2, options=theirs)
        for k in range(1, 6):
            estimate = advance(source, trial, k)
        taken = take(source, "full", step=5, estimate=estimate)
        estimator, twin = (create(kind, model_of(trial.system), lanes=2, options=ours) for _ in range(2))
        with pytest.raises(UsageError, match="state: '"):
            restore(taken, estimator, lanes=2, n=2)
        np.testing.assert_array_equal(advance(estimator, trial, 1).P, advance(twin, trial, 1).P)


@pytest.mark.parametrize("kind", KINDS)
def test_a_wrong_state_is_refused_and_changes_nothing(kind: str) -> None:
    trial = trial_of(kind, 2, "none")
    estimator, _ = after(kind, trial, 3)
    twin, _ = after(kind, trial, 3)
    state = estimator.state()  # type: ignore[attr-defined]
    wrong: list[dict[str, Any]] = [{}, {**state, "zz": np.zeros(2)}, {**state, "k": np.array(-1)}]
    for name, array in state.items():
        wrong += [
            {key: value for key, value in state.items() if key != name},
            {**state, name: array[..., None]},
            {**state, name: array.astype(np.float32)},
        ]
        if array.dtype == np.float64:
            wrong.append({**state, name: np.full_like(array, np.inf)})
    for given_state in wrong:
        with pytest.raises(UsageError, match=r"^state: .*$"):
            estimator.set_state(given_state)  # type: ignore[attr-defined]
    np.testing.assert_array_equal(advance(estimator, trial, 4).x_hat, advance(twin, trial, 4).x_hat)


@pytest.mark.parametrize("kind", KINDS)
def test_moments_that_are_none_are_refused(kind: str) -> None:
    estimator = made(kind, trial_of(kind, 2, "none"))
    x_hat: Floats = np.zeros((2, 2))
    eye = np.broadcast_to(np.eye(2), (2, 2, 2)).copy()
    for step, x, P, expected in (
        (-1, x_hat, eye, "start: step -1; allowed: 0 … "),
        (1, x_hat[:1], eye, r"state: 'x_hat' is float64 \(1, 2\); expected float64 \(2, 2\)"),
        (1, x_hat, eye[:, :1], r"state: 'P' is float64 \(2, 1, 2\)"),
        (1, x_hat, -eye, "start: P has a negative eigenvalue"),
        (1, x_hat, eye + np.array([[0.0, 1.0], [0.0, 0.0]]), "start: P is not symmetric"),
        (1, x_hat, eye * np.nan, "state: 'P' holds a value that is not finite"),
    ):
        with pytest.raises(UsageError, match=expected):
            estimator.start_from(step, x, P)  # type: ignore[attr-defined]


def test_one_that_gives_no_state_is_refused() -> None:
    class Plain:
        counters: ClassVar[dict[str, int]] = {}

    trial = trial_of("kfio", 1, "all")
    with pytest.raises(UsageError, match=r"Plain' cannot be snapshotted: it lacks one of STATE_VERSION, state, "):
        take(Plain(), "full", step=0, estimate=prior(trial))  # type: ignore[arg-type]
