"""A chain that time moves: which slots are bad does not depend on what is sent."""

from __future__ import annotations

from itertools import groupby
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from channel.impaired import NAME, impairments
from testbed.channel.slots import Losses
from testbed.numerics.streams import Stream

SLOT = 1000
MARKOV = {"kind": "markov", "recovery": 0.25, "failure": 0.1}
GE = {"kind": "gilbert-elliott", "to_bad": 0.1, "to_good": 0.25, "loss_good": 0.0, "loss_bad": 1.0}


def losses(loss: dict[str, Any], seed: int = 1, clock: str = "time") -> Losses:
    timed = {"clock": "time", "slot": f"{SLOT} ns"} if clock == "time" else {}
    return Losses(
        impairments(loss=loss, **timed), lambda purpose: Stream(seed, NAME, purpose, width=1, lane=0, lanes=1)
    )


def fates(loss: dict[str, Any], times: list[int], seed: int = 1) -> list[bool]:
    met = losses(loss, seed)
    return [met.arrives(i, at) for i, at in enumerate(times)]


@settings(deadline=None, max_examples=40)
@given(st.sampled_from([MARKOV, GE]), st.lists(st.integers(0, 3000), min_size=1, max_size=120), st.integers(0, 5))
def test_the_path_depends_on_time_alone(loss: dict[str, Any], gaps: list[int], seed: int) -> None:
    times = [int(t) for t in np.cumsum(gaps)]
    last = times[-1] // SLOT
    path = fates(loss, [slot * SLOT for slot in range(last + 1)], seed)
    assert fates(loss, times, seed) == [path[at // SLOT] for at in times]


@pytest.mark.parametrize("loss", [MARKOV, GE])
def test_a_packet_a_slot_meets_what_it_meets_where_packets_move_the_chain(loss: dict[str, Any]) -> None:
    by_packets = losses(loss, clock="packet")
    expected = [by_packets.arrives(i, 0) for i in range(2000)]
    assert 0 < sum(expected) < 2000
    assert fates(loss, [i * SLOT + i % SLOT for i in range(2000)]) == expected


def test_within_a_state_each_packet_has_a_fate_of_its_own() -> None:
    half = GE | {"loss_good": 0.2, "loss_bad": 0.9}
    slots, each = 400, 25
    times = [slot * SLOT + 40 * i for slot in range(slots) for i in range(each)]
    good = np.array(fates(GE, times)).reshape(slots, each)
    assert (good == good[:, :1]).all()
    found = np.array(fates(half, times)).reshape(slots, each)
    for state, chance in ((False, 0.1), (True, 0.8)):
        sample = found[good[:, 0] == state]
        assert stats.binomtest(int(sample.sum()), sample.size, chance).pvalue > 1e-6
        # Independent of one another within a slot: the counts of a slot are binomial, with that variance.
        spread = ((sample.sum(axis=1) - each * chance) ** 2).sum() / (each * chance * (1 - chance))
        assert 1e-6 < stats.chi2.cdf(spread, len(sample)) < 1 - 1e-6


@pytest.mark.parametrize("loss", [MARKOV, GE])
def test_bursts_last_a_geometric_number_of_slots(loss: dict[str, Any]) -> None:
    path = fates(loss, [slot * SLOT for slot in range(60_000)])
    runs = [(fate, sum(1 for _ in run)) for fate, run in groupby(path)][1:-1]
    for fate, leave in ((False, 0.25), (True, 0.1)):
        lengths = np.array([length for own, length in runs if own is fate])
        longest = int(np.quantile(lengths, 0.98))
        counts = np.bincount(np.minimum(lengths, longest), minlength=longest + 1)[1:]
        law = stats.geom(leave)
        expected = [*law.pmf(np.arange(1, longest)), law.sf(longest - 1)]
        assert stats.chisquare(counts, np.array(expected) * len(lengths)).pvalue > 1e-6


@pytest.mark.parametrize("slot", [SLOT, SLOT // 2, 3 * SLOT])
def test_a_change_leaves_the_state_and_moves_it_once_a_slot(slot: int) -> None:
    """That the failure is impossible, and so is the recovery, afterwards: the state never changes again."""
    stays = impairments(loss=MARKOV | {"recovery": 0.0, "failure": 1e-12}, clock="time", slot=f"{slot} ns")
    flips = impairments(loss=MARKOV | {"recovery": 1.0, "failure": 1.0}, clock="time", slot=f"{slot} ns")
    begin = 12 * SLOT  # a slot begins here whatever its length
    for seed in range(20):
        frozen, turning, same = (losses(MARKOV, seed) for _ in range(3))
        for at in range(0, begin, 250):
            fate = same.arrives(at // 250, at)
            assert (frozen.arrives(at // 250, at), turning.arrives(at // 250, at)) == (fate, fate)
        frozen.change(stays)
        turning.change(flips)
        for at in range(begin, 3 * begin, 250):
            assert frozen.arrives(at // 250, at) == fate
            moves = at // slot - (begin - 250) // slot
            assert turning.arrives(at // 250, at) == (fate if moves % 2 == 0 else not fate)


def test_a_change_of_the_clock_leaves_the_state() -> None:
    by_packets = impairments(loss=MARKOV | {"recovery": 1.0, "failure": 1.0})
    by_time = impairments(loss=MARKOV | {"recovery": 1.0, "failure": 1.0}, clock="time", slot=f"{SLOT} ns")
    for seed in range(20):
        met = losses(MARKOV, seed)
        fate = [met.arrives(i, i * SLOT) for i in range(10)][-1]
        met.change(by_packets)
        for i in range(10, 20):
            fate = not fate
            assert met.arrives(i, 10 * SLOT) == fate
        met.change(by_time)
        assert [met.arrives(20 + i, 10 * SLOT + i) for i in range(SLOT // 100)] == [fate] * (SLOT // 100)
        assert met.arrives(40, 11 * SLOT) != fate


@pytest.mark.parametrize(("first", "fate"), [(0, True), (2, False)])
def test_other_states_begin_with_their_law_in_the_slot_of_the_change(first: int, fate: bool) -> None:
    start = [float(i == first) for i in range(4)]
    other = {"kind": "four-state", "to_burst": 1e-12, "to_good": 1e-12, "start": start}
    for seed in range(5):
        met = losses(GE, seed)
        for i in range(10):
            met.arrives(i, i * SLOT)
        met.change(impairments(loss=other, clock="time", slot=f"{SLOT} ns"))
        assert [met.arrives(10 + i, 9 * SLOT + 200 * i) for i in range(1, 40)] == [fate] * 39


def test_a_script_is_read_by_slots_and_may_be_changed_within_one() -> None:
    one, other = ({"kind": "scripted", "pattern": word} for word in ("110", "01"))
    met = losses(one)
    assert [met.arrives(i, i * SLOT // 2) for i in range(9)] == [True] * 4 + [False] * 2 + [True] * 3
    met.change(impairments(loss=other, clock="time", slot=f"{SLOT} ns"))
    assert [met.arrives(i, i * SLOT // 2) for i in range(9, 14)] == [False, True, True, False, False]
