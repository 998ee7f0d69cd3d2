"""Late information: at each step the estimate is that of a run in which all that has come by then came in time."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimator.reference.cases import Trial, check, random_system, random_trial
from estimator.reference.drive import model_of
from testbed.cli.main import run_command
from testbed.errors import UsageError
from testbed.estimator.handover import give, start
from testbed.estimator.model import Ack, Estimate
from testbed.estimator.packets import PacketLine, read_packets, replay
from testbed.estimator.refilter import LateObservation, Refilter
from testbed.estimator.registry import create

STEPS, LANES = 14, 3
OPTIONS: dict[str, dict[str, Any]] = {"pf": {"particles": 30}}
KINDS = ("aoe", "gpb2", "imm", "kfio", "lmmse", "pf", "rseio")
HELD = ("aoe", "gpb2", "imm", "kfio", "lmmse", "ff", "pf")
NEEDS_ACKS = ("kfio", "rseio")


class Delays:
    """A trial, and when each observation and each ACK comes: step + delay, by lane; a loss never comes."""

    def __init__(self, kind: str, seed: int, longest: int, hold: bool = False) -> None:
        rng = np.random.default_rng(seed)
        system = random_system(rng, 2, 1, 1, "bernoulli" if kind in ("ff", "lmmse") else "markov")
        system = replace(system, hold=hold)
        self.trial: Trial = random_trial(rng, system, STEPS, LANES, "all")
        self.model, self.kind, self.longest = model_of(system), kind, longest
        self.comes = np.arange(1, STEPS + 1)[:, None] + rng.integers(0, longest + 1, (STEPS, LANES))
        late = 0 if kind in NEEDS_ACKS else longest + 1
        self.heard = np.arange(1, STEPS + 1)[:, None] + rng.integers(0, late + 1, (STEPS, LANES))

    def fresh(self) -> Any:
        return create(self.kind, self.model, lanes=LANES, options=OPTIONS.get(self.kind), lane=2)

    def gamma(self, k: int) -> Any:
        return np.asarray(self.trial.arrived[k - 1], dtype=bool)

    def nu(self, j: int) -> Any:
        return np.asarray(self.trial.nu[j])

    def in_order(self, now: int, depth: int) -> Estimate:
        """A run up to step ``now`` in which what has come by now, and not too late for the memory, came in time."""
        estimator = self.fresh()
        for k in range(1, now + 1):
            arrived = self.gamma(k) & (self.comes[k - 1] <= min(now, k + depth))
            heard = self.heard[k - 1] <= min(now, k + depth)
            acks = (Ack(k - 1, self.nu(k - 1), heard),)
            estimate: Estimate = estimator.step(self.trial.u[k - 1], self.trial.y[k - 1], arrived, acks)
        return estimate

    def as_it_comes(self, depth: int, handed: tuple[int, ...] = ()) -> tuple[list[Estimate], Refilter]:
        """handed: steps after which another one goes on from the bytes that this one gives."""
        refilter, out = Refilter(self.fresh(), depth), []
        latest = Estimate(*self.model.prior(LANES), LANES)
        for k in range(1, STEPS + 1):
            if k - 1 in handed:
                data = give(refilter, "full", step=k - 1, estimate=out[-1] if out else latest)
                refilter = Refilter(self.fresh(), depth)
                start(refilter, "full", data, model=self.model, lanes=LANES, step=k - 1)
            late = [
                LateObservation(j, self.trial.y[j - 1], self.gamma(j) & (self.comes[j - 1] == k)) for j in range(1, k)
            ]
            acks = tuple(Ack(j, self.nu(j), self.heard[j] == k) for j in range(k))
            arrived = self.gamma(k) & (self.comes[k - 1] == k)
            out.append(refilter.step(self.trial.u[k - 1], self.trial.y[k - 1], arrived, acks, late))
        return out, refilter


@pytest.mark.parametrize(("kind", "hold"), [*((kind, False) for kind in KINDS), *((kind, True) for kind in HELD)])
@pytest.mark.parametrize(("longest", "depth"), [(1, 4), (4, 4), (3, 8)])
def test_late_is_as_good_as_in_time(kind: str, hold: bool, longest: int, depth: int) -> None:
    delays = Delays(kind, seed=longest, longest=longest, hold=hold)
    if kind == "aoe":
        delays.heard = np.minimum(delays.heard, np.arange(1, STEPS + 1)[:, None] + depth)
    found, refilter = delays.as_it_comes(depth)
    for k, estimate in enumerate(found, start=1):
        expected = delays.in_order(k, depth)
        np.testing.assert_array_equal(estimate.x_hat, expected.x_hat, err_msg=f"step {k}")
        np.testing.assert_array_equal(estimate.P, expected.P, err_msg=f"step {k}")
    came = sum(
        int((delays.gamma(k) & (delays.comes[k - 1] <= STEPS) & (delays.comes[k - 1] > k)).sum())
        for k in range(1, STEPS + 1)
    )
    assert refilter.counters["late_observations"] == came
    assert "old_observations" not in refilter.counters


@check(25)
@given(st.integers(0, 2**32 - 1), st.integers(1, 6))
def test_what_is_older_than_the_memory_is_counted(seed: int, depth: int) -> None:
    delays = Delays("kfio", seed, longest=7)
    found, refilter = delays.as_it_comes(depth)
    expected = delays.in_order(STEPS, depth)
    np.testing.assert_array_equal(found[-1].x_hat, expected.x_hat)
    lateness = delays.comes - np.arange(1, STEPS + 1)[:, None]
    came = np.array([delays.gamma(k) for k in range(1, STEPS + 1)]) & (delays.comes <= STEPS)
    assert refilter.counters.get("old_observations", 0) == int((came & (lateness > depth)).sum())
    assert refilter.counters.get("late_observations", 0) == int((came & (lateness > 0) & (lateness <= depth)).sum())


def test_the_memory_is_bounded() -> None:
    delays = Delays("kfio", 3, longest=0)
    refilter = Refilter(delays.fresh(), 4)
    u, y = np.zeros((LANES, 1)), np.zeros((LANES, 1))
    for k in range(200):
        refilter.step(u, y, np.ones(LANES, bool), (Ack(k, np.ones(LANES, int), np.ones(LANES, bool)),))
        assert len(refilter._inputs) <= 8
        assert len(refilter._checkpoints) <= 3


def test_a_repeated_observation_is_counted_and_changes_nothing() -> None:
    delays = Delays("aoe", 5, longest=0)
    once, twice = Refilter(delays.fresh(), 4), Refilter(delays.fresh(), 4)
    for k in range(1, 6):
        given = delays.trial.u[k - 1], delays.trial.y[k - 1], np.ones(LANES, bool), ()
        again = [LateObservation(k - 1, delays.trial.y[k - 1], np.ones(LANES, bool))] if k > 1 else []
        np.testing.assert_array_equal(once.step(*given).x_hat, twice.step(*given, again).x_hat)
    assert twice.counters == {"repeated_observations": 4 * LANES}


def test_without_a_memory_late_observations_are_counted() -> None:
    delays = Delays("aoe", 5, longest=3)
    found, refilter = delays.as_it_comes(0)
    assert len(found) == STEPS
    assert refilter.counters["old_observations"] > 0


def test_what_cannot_go_back_is_refused() -> None:
    class Stateless:
        def __init__(self) -> None:
            self.counters: dict[str, int] = {}

        def step(self, *_: Any) -> None: ...

    with pytest.raises(UsageError, match="gives no state"):
        Refilter(Stateless(), 3)  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="got -1"):
        Refilter(Stateless(), -1)  # type: ignore[arg-type]


def test_replay_takes_late_observations() -> None:
    delays = Delays("aoe", 8, longest=0)
    y = delays.trial.y[:, 0].tolist()
    u = delays.trial.u[:, 0].tolist()
    in_time = [{"k": k, "u": u[k - 1], "y": y[k - 1]} for k in range(1, 7)]
    late = [dict(line) for line in in_time]
    late[2]["y"], late[4]["late"] = None, [[3, y[2]]]

    def final(lines: list[dict[str, Any]], depth: int) -> Any:
        made = create("aoe", delays.model, lanes=1)
        estimator = Refilter(made, depth) if depth else made
        packets = read_packets(map(json.dumps, lines), delays.model)
        return json.loads(list(replay(estimator, delays.model, packets, use_acks=False))[-1])

    assert final(late, 4) == final(in_time, 0)
    assert final(late, 0) != final(in_time, 0)


@pytest.mark.parametrize(
    ("late", "text"),
    [
        ([[3, [1.0]]], "late: got the observation of step 3 at step 3; allowed: 1 … 2"),
        ([[1, []]], "late: got 0 numbers"),
    ],
)
def test_wrong_late_lines_are_refused(late: Any, text: str) -> None:
    delays = Delays("aoe", 8, longest=0)
    lines = [{"k": k, "u": [0.0], "y": [0.0]} for k in (1, 2)] + [{"k": 3, "u": [0.0], "y": None, "late": late}]
    with pytest.raises(UsageError, match=text):
        list(read_packets(map(json.dumps, lines), delays.model))


def test_the_command_uses_what_is_late(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scenario, packets = tmp_path / "s.toml", tmp_path / "p.jsonl"
    scenario.write_text("[system]\nA = [[1.1]]\nC = [[1.0]]\nQ = [[1.0]]\nR = [[1.0]]\n[[estimators]]\nname = 'kf'\n")
    lines = [PacketLine(k=1, y=[2.0]), PacketLine(k=2), PacketLine(k=3, y=[1.0], late=[(2, [3.0])])]
    packets.write_text("".join(line.model_dump_json() + "\n" for line in lines))
    arguments = ["replay", str(scenario), str(packets), "--estimator", "kfio"]
    assert run_command([*arguments, "--buffer", "2"]) == 0
    used = capsys.readouterr()
    assert "late_observations 1" in used.err
    assert run_command(arguments) == 0
    unused = capsys.readouterr()
    assert "old_observations 1" in unused.err
    assert json.loads(used.out.splitlines()[-1])["P"] < json.loads(unused.out.splitlines()[-1])["P"]


@pytest.mark.parametrize("kind", [*KINDS, "ff", "oe"])
@pytest.mark.parametrize("depth", [0, 3, 8])
def test_a_full_hand_over_takes_the_memory_with_it(kind: str, depth: int) -> None:
    delays = Delays(kind, seed=5, longest=4)
    whole, one = delays.as_it_comes(depth)
    for handed in (tuple(range(STEPS)), (4,), (0, 9)):
        again, other = delays.as_it_comes(depth, handed)
        assert one.counters == other.counters
        for before, after in zip(whole, again, strict=True):
            np.testing.assert_array_equal(before.x_hat, after.x_hat)
            np.testing.assert_array_equal(before.P, after.P)
    assert one.counters.get("refiltered", 0) > 0 or not depth


def test_a_start_from_moments_remembers_nothing_before() -> None:
    delays = Delays("aoe", seed=3, longest=0)
    out, old = delays.as_it_comes(4)
    data = give(old, "moments", step=STEPS, estimate=out[-1])
    new = Refilter(delays.fresh(), 4)
    start(new, "moments", data, model=delays.model, lanes=LANES, step=STEPS)
    late = [LateObservation(STEPS, delays.trial.y[-1], np.array([True, False, True]))]
    nothing, u = np.zeros(LANES, dtype=bool), delays.trial.u[0]
    found = new.step(u, delays.trial.y[0], nothing, (), late)
    alone = delays.fresh()
    alone.start_from(STEPS, out[-1].x_hat, out[-1].P)
    np.testing.assert_array_equal(found.P, alone.step(u, delays.trial.y[0], nothing).P)
    assert new.counters["old_observations"] == 2


@pytest.mark.parametrize(
    "spoil",
    [
        lambda memory: memory.pop("u"),
        lambda memory: memory.update(steps=memory["steps"] + 1),
        lambda memory: memory.update(ack_steps=memory["ack_steps"] + 100),
        lambda memory: memory.update(checkpoints=memory["checkpoints"] + 50),
        lambda memory: memory.update(arrived=memory["arrived"][:1]),
    ],
)
def test_a_memory_that_does_not_fit_is_refused(spoil: Any) -> None:
    delays = Delays("aoe", seed=3, longest=4)
    _, old = delays.as_it_comes(4)
    memory = old.memory()
    spoil(memory)
    with pytest.raises(UsageError, match="memory of late packets: "):
        Refilter(delays.fresh(), 4).remember(STEPS, memory)


def test_a_hand_over_in_another_form_is_refused() -> None:
    delays = Delays("aoe", seed=3, longest=4)
    out, old = delays.as_it_comes(4)
    data = give(old, "moments", step=STEPS, estimate=out[-1])
    with pytest.raises(UsageError, match="snapshot: in the moments form; expected full"):
        start(Refilter(delays.fresh(), 4), "full", data, model=delays.model, lanes=LANES, step=STEPS)
