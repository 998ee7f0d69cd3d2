"""Every loss model at a million packets: stationary rate, transitions, bursts and gaps by χ² against its definition.

The definition is that of theory.md 1: a packet is lost with the probability of the state that it meets, then the state
moves. From it follows the probability of any word of fates, and so the exact expectation of every count below. Counts
within a lane depend on each other as the model wants it; lanes are independent. So the χ² of a vector of counts takes
its covariance from the lanes (Hotelling's T²), and holds for every model, hidden states or not.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from testbed.channel.pipeline import Pipeline
from testbed.channel.service import loss_process
from testbed.scenario import parse_scenario

Bits = NDArray[np.bool_]
Floats = NDArray[np.float64]

SYSTEM = {"A": [[1.0]], "C": [[1.0]], "Q": [[1.0]], "R": [[1.0]]}
SEED, LANES, STEPS = 7, 1000, 1000
LEVEL = 1e-6
EXPECTED_MIN = 100.0
CELLS_MAX = 14


@dataclass(frozen=True)
class Model:
    """What the scenario says, and what that means: moves of the state (m, m), and P(lost | state) (m,)."""

    loss: dict[str, Any]
    moves: list[list[float]]
    lost: list[float]

    def word(self, *parts: tuple[bool, int]) -> float:
        """P(fates), given as runs (arrived, length), in the stationary law."""
        moves, lost = np.array(self.moves), np.array(self.lost)
        order = len(lost)
        at = np.linalg.lstsq(np.vstack([moves.T - np.eye(order), np.ones(order)]), np.eye(order + 1)[-1], rcond=None)[0]
        for arrived, length in parts:
            chance = 1.0 - lost if arrived else lost
            for _ in range(length):
                at = (at * chance) @ moves
        return float(at.sum())


def two(recovery: float, failure: float) -> list[list[float]]:
    """State 0 bad, 1 good."""
    return [[1.0 - recovery, recovery], [failure, 1.0 - failure]]


def gilbert_elliott(to_bad: float, to_good: float, loss_good: float, loss_bad: float) -> Model:
    names = {"to_bad": to_bad, "to_good": to_good, "loss_good": loss_good, "loss_bad": loss_bad}
    return Model({"kind": "gilbert-elliott", **names}, two(to_good, to_bad), [loss_bad, loss_good])


def four_state(to_burst: float, to_good: float, to_pause: float, from_pause: float, to_isolated: float) -> Model:
    """States good, pause within a burst, burst, isolated."""
    names = {"to_burst": to_burst, "to_good": to_good, "to_pause": to_pause, "from_pause": from_pause}
    moves = [
        [1.0 - to_burst - to_isolated, 0.0, to_burst, to_isolated],
        [0.0, 1.0 - from_pause, from_pause, 0.0],
        [to_good, to_pause, 1.0 - to_good - to_pause, 0.0],
        [1.0, 0.0, 0.0, 0.0],
    ]
    return Model({"kind": "four-state", **names, "to_isolated": to_isolated}, moves, [0.0, 0.0, 1.0, 1.0])


MODELS = {
    "bernoulli 0.05": Model({"kind": "bernoulli", "loss": 0.05}, [[1.0]], [0.05]),
    "bernoulli 0.8": Model({"kind": "bernoulli", "arrival": 0.2}, [[1.0]], [0.8]),
    "markov, long bursts": Model({"kind": "markov", "recovery": 0.25, "failure": 0.02}, two(0.25, 0.02), [1.0, 0.0]),
    "markov, alternating": Model({"kind": "markov", "recovery": 0.9, "failure": 0.8}, two(0.9, 0.8), [1.0, 0.0]),
    "markov, by burst": Model({"kind": "markov", "loss": 0.1, "mean_burst": 4.0}, two(0.25, 1 / 36), [1.0, 0.0]),
    "gilbert-elliott": gilbert_elliott(0.02, 0.2, 0.01, 0.6),
    "gilbert-elliott, slow": gilbert_elliott(0.01, 0.03, 0.05, 0.5),
    "four-state": four_state(0.02, 0.3, 0.2, 0.5, 0.01),
    "gilbert-elliott, alternating": gilbert_elliott(0.9, 0.8, 0.1, 0.7),
}
"""To add a model is to add a line."""


def fates(loss: dict[str, Any], *, lanes: int = LANES, steps: int = STEPS) -> Bits:
    """Arrival bits (steps, lanes) of a link of a scenario, as in a run."""
    links = {"observation": {"loss": loss}}
    scenario = parse_scenario({"seed": SEED, "lanes": lanes, "system": SYSTEM, "links": links})
    process = loss_process(scenario, "observation", 0, lanes)
    return np.array([process.next(number) for number in range(steps)])


@pytest.fixture(scope="module", params=MODELS, ids=str)
def drawn(request: pytest.FixtureRequest) -> tuple[Model, Bits]:
    model = MODELS[request.param]
    return model, fates(model.loss)


def p_value(counts: Floats, expected: Floats) -> float:
    """Of Hotelling's T² of counts (lanes, cells) with these expectations a lane (cells,)."""
    lanes, cells = counts.shape
    deviation = counts.mean(axis=0) - expected
    covariance = np.atleast_2d(np.cov(counts, rowvar=False))
    squared = lanes * deviation @ np.linalg.solve(covariance, deviation)
    return float(stats.f.sf(squared * (lanes - cells) / (cells * (lanes - 1)), cells, lanes - cells))


def transitions_p_value(model: Model, bits: Bits) -> float:
    pairs = [(False, False), (False, True), (True, False)]
    counts = np.array([np.sum((bits[:-1] == a) & (bits[1:] == b), axis=0) for a, b in pairs]).T
    return p_value(counts, np.array([(len(bits) - 1) * model.word((a, 1), (b, 1)) for a, b in pairs]))


def runs_p_value(model: Model, bits: Bits, fate: bool) -> float:
    """Of how many runs of a fate begin and last longer than certain lengths, up to where few are expected."""
    longer = [0]
    whole = model.word((not fate, 1), (fate, 1))
    for length in range(1, len(bits) // 2):
        share = model.word((not fate, 1), (fate, length + 1)) / whole
        last = model.word((not fate, 1), (fate, longer[-1] + 1)) / whole
        if share * whole * bits.size < EXPECTED_MIN:
            break
        if last - share >= 1.0 / CELLS_MAX or (share < 1.0 / CELLS_MAX and last > 2.0 * share):
            longer.append(length)
    starts = len(bits) - longer[-1] - 1
    ahead = np.zeros((len(bits) + 1, bits.shape[1]), dtype=np.int64)  # packets of this fate from here on
    for k in reversed(range(len(bits))):
        ahead[k] = np.where(bits[k] == fate, ahead[k + 1] + 1, 0)
    begins = np.where(bits[:starts] != fate, ahead[1 : starts + 1], 0)
    counts = np.array([np.sum(begins > length, axis=0) for length in longer]).T
    return p_value(counts, np.array([starts * model.word((not fate, 1), (fate, n + 1)) for n in longer]))


def test_stationary_rate(drawn: tuple[Model, Bits]) -> None:
    model, bits = drawn
    assert p_value(np.sum(~bits, axis=0)[:, None], np.array([len(bits) * model.word((False, 1))])) > LEVEL


def test_transitions(drawn: tuple[Model, Bits]) -> None:
    assert transitions_p_value(*drawn) > LEVEL


@pytest.mark.parametrize("fate", [False, True], ids=["bursts", "gaps"])
def test_runs(drawn: tuple[Model, Bits], fate: bool) -> None:
    assert runs_p_value(*drawn, fate) > LEVEL


def test_no_loss_loses_nothing() -> None:
    assert fates({"kind": "none"}).all()


@pytest.mark.parametrize("name", [name for name, model in MODELS.items() if len(model.lost) > 1])
def test_a_wrong_model_is_seen(name: str) -> None:
    """At this number of packets the tests above notice a state that is left a fifth too rarely."""
    model = MODELS[name]
    bits = fates(model.loss)
    for state in range(len(model.moves)):
        off = np.array(model.moves)
        off[state] *= 0.8
        off[state, state] += 0.2
        wrong = Model(model.loss, off.tolist(), model.lost)
        found = [transitions_p_value(wrong, bits), *(runs_p_value(wrong, bits, fate) for fate in (False, True))]
        assert min(found) < LEVEL


@pytest.mark.parametrize("name", MODELS)
def test_a_pipeline_loses_the_same_packets(name: str) -> None:
    """One lane by itself, packet by packet, as over real sockets: what is shown above holds for it too."""
    loss = MODELS[name].loss
    bits = fates(loss, lanes=20, steps=300)
    links = parse_scenario({"system": SYSTEM, "links": {"observation": {"loss": loss}}}).links
    for lane in (0, 7, 19):
        pipeline = Pipeline(links.observation, SEED, "link.observation", lane)
        assert [bool(pipeline.send(64, k)) for k in range(300)] == bits[:, lane].tolist()
