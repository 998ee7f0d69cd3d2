"""The law of what is in time: against sums over all paths of the chain, and against links that run."""

from __future__ import annotations

import secrets
from itertools import pairwise, product
from math import prod
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from channel.impaired import MS, NAME, link
from testbed.channel.carriers import carriers_of
from testbed.channel.in_time import has_formula, law_in_steps, law_of_link
from testbed.channel.law import LossModel, law_of
from testbed.channel.packets import packet_bytes
from testbed.channel.steps import SteppedLink
from testbed.scenario import parse_scenario
from testbed.wire.codec import PacketEncoder
from testbed.wire.messages import Acknowledgement, Control, Observation

PERIOD, SIZE = 10 * MS, 100
LENGTH = 4
MARKOV = {"kind": "markov", "recovery": 0.5, "failure": 0.2, "start": 0.9}
GE = {"kind": "gilbert-elliott", "to_bad": 0.2, "to_good": 0.4, "loss_good": 0.1, "loss_bad": 0.8, "start_good": 0.3}
UNIFORM = {"kind": "uniform", "low": "4 ms", "high": "14 ms"}
COPIES = {"duplicate": {"chance": 0.3, "after": "3 ms"}, "corrupt": {"chance": 0.2}}
REORDER = {"chance": 0.25, "by": "5 ms"}
States = tuple[list[float], NDArray[np.float64], list[float]]
"""Initial law, moves, P(a packet that meets the state is not lost)."""

STATES: dict[str, tuple[dict[str, Any], States]] = {
    "none": ({"kind": "none"}, ([1.0], np.ones((1, 1)), [1.0])),
    "bernoulli": ({"kind": "bernoulli", "arrival": 0.7}, ([1.0], np.ones((1, 1)), [0.7])),
    "markov": (MARKOV, ([0.1, 0.9], np.array([[0.5, 0.5], [0.2, 0.8]]), [0.0, 1.0])),
    "gilbert-elliott": (GE, ([0.7, 0.3], np.array([[0.6, 0.4], [0.2, 0.8]]), [0.2, 0.9])),
}


def ms(law: Any, at: float) -> float:
    return float(law.cdf(at))


UNI, NORM = stats.uniform(4, 10), stats.truncnorm(-4, np.inf, 8, 2)
THINNED: dict[str, tuple[dict[str, Any], float]] = {
    "nothing": ({}, 1.0),
    "constant in time": ({"delay": {"kind": "constant", "by": "10 ms"}}, 1.0),
    "constant too late": ({"delay": {"kind": "constant", "by": "10000001 ns"}}, 0.0),
    "uniform": ({"delay": UNIFORM}, 0.6),
    "uniform, deadline": ({"delay": UNIFORM, "deadline": "7 ms"}, 0.3),
    "normal": ({"delay": {"kind": "normal", "mean": "8 ms", "std": "2 ms"}}, ms(NORM, 10)),
    "log-normal": (
        {"delay": {"kind": "log-normal", "median": "5 ms", "sigma": 0.7, "minimum": "2 ms"}},
        ms(stats.lognorm(0.7, 2, 5), 10),
    ),
    "table": ({"delay": {"kind": "table", "values": [1, 10, 11, 12, 5]}}, 0.6),
    "reordering": ({"delay": UNIFORM, "reorder": REORDER}, 0.75 * 0.6 + 0.25 * 0.1),
    "bit errors": ({"corrupt": COPIES["corrupt"]}, 0.8),
    # Either copy will do: the first intact and in time, or the first spoilt and the second intact and in time.
    "copies": ({"delay": UNIFORM, **COPIES}, 0.8 * 0.6 + 0.2 * 0.3 * 0.8 * 0.3),
    "all": (
        {"delay": UNIFORM, "reorder": REORDER, **COPIES},
        0.8 * (0.75 * 0.6 + 0.25 * 0.1) + 0.2 * 0.3 * 0.8 * (0.75 * 0.3 + 0.25 * 0.0),
    ),
    "all, deadline": (
        {"delay": UNIFORM, "reorder": REORDER, **COPIES, "deadline": "8500 us"},
        0.8 * 0.75 * 0.45 + 0.2 * 0.3 * 0.8 * 0.75 * 0.15,
    ),
}


def summed(states: States, moves: NDArray[np.float64], in_time: float, fates: tuple[int, ...]) -> float:
    """P(fates): over all paths of the states."""
    first, _, arrival = states
    total = 0.0
    for path in product(range(len(first)), repeat=len(fates)):
        chance = first[path[0]] * prod(moves[a, b] for a, b in pairwise(path))
        for state, fate in zip(path, fates, strict=True):
            good = arrival[state] * in_time
            chance *= good if fate else 1 - good
        total += chance
    return total


def of_law(losses: LossModel, fates: tuple[int, ...], stationary: bool = False) -> float:
    """P(fates) of the law that estimators hold."""
    law = law_of(losses)
    weights = law.initial
    if stationary:
        weights = weights @ np.linalg.matrix_power(law.transition, 4096)
    for i, fate in enumerate(fates):
        weights = (weights if i == 0 else weights @ law.transition) * (law.arrived == bool(fate))
    return float(weights.sum())


ALL = list(product((0, 1), repeat=LENGTH))


@pytest.mark.parametrize("thinned", THINNED)
@pytest.mark.parametrize("chain", STATES)
def test_what_comes_too_late_is_lost(chain: str, thinned: str) -> None:
    (loss, states), (keys, in_time) = STATES[chain], THINNED[thinned]
    given = link(loss=loss, **keys)
    assert has_formula(given)
    law = law_in_steps(given, PERIOD, SIZE)
    for fates in ALL:
        assert of_law(law, fates) == pytest.approx(summed(states, states[1], in_time, fates), rel=1e-9, abs=1e-13)


@pytest.mark.parametrize(("slot", "shares"), [
    ("10 ms", {1: 1.0}),
    ("5 ms", {2: 1.0}),
    ("2 ms", {5: 1.0}),
    ("4 ms", {2: 0.5, 3: 0.5}),
    ("15 ms", {0: 1 / 3, 1: 2 / 3}),
    ("40 ms", {0: 0.75, 1: 0.25}),
])  # fmt: skip
@pytest.mark.parametrize("chain", ["markov", "gilbert-elliott"])
def test_slots_move_the_chain_as_often_as_they_begin(chain: str, slot: str, shares: dict[int, float]) -> None:
    loss, states = STATES[chain]
    moves = sum(share * np.linalg.matrix_power(states[1], count) for count, share in shares.items())
    for keys, in_time in ({}, 1.0), ({"delay": UNIFORM}, 0.6):
        law = law_in_steps(link(loss=loss, clock="time", slot=slot, **keys), PERIOD, SIZE)
        for fates in ALL:
            expected = summed(states, np.asarray(moves), in_time, fates)
            assert of_law(law, fates) == pytest.approx(expected, rel=1e-9, abs=1e-13)


def test_the_law_assumed_is_the_law() -> None:
    given = link(loss=GE, delay=UNIFORM, rate={"bits_per_second": 1e5}, assumed=MARKOV)
    _, states = STATES["markov"]
    for fates in ALL:
        expected = summed(states, states[1], 1.0, fates)
        assert of_law(law_in_steps(given, PERIOD, SIZE), fates) == pytest.approx(expected, rel=1e-12)


def frequencies(keys: dict[str, Any], lanes: int, packets: int) -> NDArray[np.float64]:
    """How often each row of three fates is seen, (lanes, 8): lanes are independent, and so are their frequencies."""
    given = link(**keys)
    carriers = carriers_of(given, 12, NAME, 0, lanes)
    stepped = SteppedLink(carriers, SIZE, PERIOD, given.deadline_ns(PERIOD))
    fates = np.array([stepped.send(number).in_time for number in range(packets)], dtype=int)
    rows = 4 * fates[:-2] + 2 * fates[1:-1] + fates[2:]
    return np.array([np.bincount(lane, minlength=8) for lane in rows.T]) / len(rows)


RUNNING: dict[str, dict[str, Any]] = {
    "delay": {"loss": {**MARKOV, "start": None}, "delay": UNIFORM, "deadline": "8 ms"},
    "all": {"loss": {**GE, "start_good": None}, "delay": UNIFORM, "reorder": REORDER, **COPIES},
    "slots": {"loss": {**MARKOV, "start": None}, "clock": "time", "slot": "5 ms", "corrupt": {"chance": 0.1}},
}


@pytest.mark.parametrize("name", RUNNING)
def test_a_link_that_runs_has_the_law(name: str) -> None:
    """Hotelling's T² of the means of the lanes, which allows for what neighbours have in common."""
    lanes, packets = 200, 1000 if name == "delay" else 300
    found = frequencies(RUNNING[name], lanes, packets)
    law = law_in_steps(link(**RUNNING[name]), PERIOD, SIZE)
    expected = np.array([of_law(law, fates) for fates in product((0, 1), repeat=3)])
    # Of eight frequencies that add up to 1, and of which runs of one end begin as often as they end, six are free.
    free = [0, 1, 2, 4, 5, 7]
    off = (found - expected)[:, free]
    mean, covariance = off.mean(axis=0), np.cov(off.T) / lanes
    values, vectors = np.linalg.eigh(covariance)
    kept = values > values[-1] * 1e-6
    squared = float((((vectors.T @ mean) ** 2)[kept] / values[kept]).sum())
    degrees = int(kept.sum())
    assert stats.f.sf(squared * (lanes - degrees) / (degrees * (lanes - 1)), degrees, lanes - degrees) >= 1e-6


@pytest.mark.parametrize("keys", [
    {"loss": {**MARKOV, "start": None}, "delay": {**UNIFORM, "high": "40 ms", "in_order": True}},
    {"loss": {**MARKOV, "start": None}, "rate": {"bits_per_second": 2.5e5, "queue_packets": 3}, "delay": UNIFORM},
])  # fmt: skip
def test_where_there_is_no_formula_the_pairs_are_those_of_the_link(keys: dict[str, Any]) -> None:
    """Of the chain that is fitted, the law of two neighbours; both are counted, each with its own error."""
    given = link(**keys)
    assert not has_formula(given)
    law = law_in_steps(given, PERIOD, SIZE)
    found = frequencies(keys, 40, 500).reshape(40, 4, 2).sum(axis=2)
    error = found.std(axis=0, ddof=1)
    # A sample of 20,000 packets is as 40 lanes of 500: the difference of two means.
    expected = np.array([of_law(law, pair, stationary=True) for pair in product((0, 1), repeat=2)])
    np.testing.assert_array_less(np.abs(found.mean(axis=0) - expected), 6 * error * np.sqrt(2 / 40) + 0.002)


@pytest.mark.parametrize("width", [1, 2, 10])
def test_the_law_is_that_of_packets_as_they_are_encoded(width: int) -> None:
    """A line that carries just one of them a period, and none that are longer by a byte."""
    eye = np.eye(width).tolist()
    system = {"A": eye, "B": eye, "C": eye, "Q": eye, "R": eye}
    contents: list[tuple[Any, str, str, NDArray[Any]]] = [
        (Control, "controller", "u", np.zeros((1, width))),
        (Observation, "plant", "y", np.zeros((1, width))),
        (Acknowledgement, "plant", "nu", np.zeros(1, dtype=np.uint8)),
    ]
    for model, sender, content, array in contents:
        name = model.__name__.lower()[:3] if model is Acknowledgement else model.__name__.lower()
        encoder = PacketEncoder(model, secrets.token_hex(6), sender)
        size = len(encoder.encode(0, model.FIRST_STEP, 0, 1, {content: array}))
        for bits, arrival in ((8 * size, 1.0), (8 * size - 1, 0.0)):
            rate = {"bits_per_second": bits * 100, "queue_packets": 1}
            table = {"mode": "link", "rate": rate} if name == "ack" else {"rate": rate}
            given = parse_scenario({"system": system, "links": {name: table}, "estimators": [{"name": "aoe"}]})
            assert packet_bytes(given, name) == size
            assert law_of_link(given, name).arrival == arrival
