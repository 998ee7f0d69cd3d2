import itertools
import math

import numpy as np
import pytest

from orchestrator.fabricated_summary import SCENARIO_TOML, fabricate, link
from testbed.analysis.bursts import run_law
from testbed.channel.chains import chain_of
from testbed.channel.service import loss_process
from testbed.orchestrator.report.link_model import expected_links
from testbed.scenario import parse_scenario


def expected(loss: str, steps: int = 6, lanes: int = 4, mode: str = ""):
    links = {"observation": link(np.random.default_rng(1), 0.5, 0.3, steps, lanes)}
    toml = f"[links.observation]\n{mode}\n" + (f"loss = {loss}" if loss else "")
    return expected_links(fabricate(steps=steps, lanes=lanes, links=links), toml).get("observation")


def enumerate_loss(recovery, failure, start, steps):
    """Mean and standard deviation of the share of losses in one lane, over all paths of the chain."""
    moments = np.zeros(2)
    for path in itertools.product((0, 1), repeat=steps):
        probability = start if path[0] else 1 - start
        for before, after in itertools.pairwise(path):
            to_one = 1 - failure if before else recovery
            probability *= to_one if after else 1 - to_one
        lost = 1 - sum(path) / steps
        moments += probability * np.array([lost, lost**2])
    return moments[0], math.sqrt(moments[1] - moments[0] ** 2)


@pytest.mark.parametrize(("recovery", "failure"), [(0.5, 0.3), (0.9, 0.8), (0.1, 0.05), (1.0, 1.0)])
def test_markov_loss_rate_against_all_paths(recovery, failure):
    model = expected(f'{{ kind = "markov", recovery = {recovery}, failure = {failure} }}')
    mean, deviation = enumerate_loss(recovery, failure, recovery / (recovery + failure), 6)
    assert model.loss_rate == pytest.approx(mean)
    assert model.loss_rate_deviation == pytest.approx(deviation / math.sqrt(4))
    assert model.mean_burst == pytest.approx(1 / recovery)


def test_markov_that_does_not_start_stationary():
    model = expected('{ kind = "markov", recovery = 0.2, failure = 0.1, start = 0.0 }')
    assert model.loss_rate == pytest.approx(enumerate_loss(0.2, 0.1, 0.0, 6)[0])


def enumerate_hidden(to_bad, to_good, loss_good, loss_bad, start_good, steps):
    """Mean and standard deviation of the share of losses in one lane, over all paths of states and fates."""
    moments = np.zeros(2)
    for path in itertools.product((0, 1), repeat=steps):
        chance = start_good if path[0] else 1 - start_good
        for before, after in itertools.pairwise(path):
            good = 1 - to_bad if before else to_good
            chance *= good if after else 1 - good
        lost = np.where(np.array(path) == 1, loss_good, loss_bad)
        mean = lost.mean()
        moments += chance * np.array([mean, mean**2 + (lost * (1 - lost)).sum() / steps**2])
    return moments[0], math.sqrt(moments[1] - moments[0] ** 2)


@pytest.mark.parametrize(("to_bad", "to_good"), [(0.1, 0.3), (0.9, 0.8)])
def test_gilbert_elliott_loss_rate_against_all_paths(to_bad, to_good):
    table = f'{{ kind = "gilbert-elliott", to_bad = {to_bad}, to_good = {to_good}, loss_good = 0.1, loss_bad = 0.6'
    model = expected(table + " }")
    mean, deviation = enumerate_hidden(to_bad, to_good, 0.1, 0.6, to_good / (to_bad + to_good), 6)
    assert model.loss_rate == pytest.approx(mean)
    assert model.loss_rate_deviation == pytest.approx(deviation / math.sqrt(4))
    assert expected(table + ", start_good = 1.0 }").loss_rate == pytest.approx(
        enumerate_hidden(to_bad, to_good, 0.1, 0.6, 1.0, 6)[0]
    )


def test_bernoulli_loss_rate_against_all_paths():
    model = expected('{ kind = "bernoulli", arrival = 0.7 }')
    mean, deviation = enumerate_loss(0.7, 0.3, 0.7, 6)
    assert model.loss_rate == pytest.approx(mean)
    assert model.loss_rate_deviation == pytest.approx(deviation / 2)
    assert model.mean_burst == pytest.approx(sum(j * 0.7 * 0.3 ** (j - 1) for j in range(1, 200)))


def test_links_without_loss():
    for model in (expected(""), expected('{ kind = "none" }'), expected("", mode='mode = "perfect"')):
        assert (model.loss_rate, model.loss_rate_deviation, model.mean_burst) == (0.0, 0.0, None)


def test_losses_that_never_end_have_no_mean_burst():
    model = expected('{ kind = "markov", recovery = 0.0, failure = 0.1, start = 1.0 }')
    assert model.loss_rate == pytest.approx(enumerate_loss(0.0, 0.1, 1.0, 6)[0])
    assert (model.mean_burst, model.mean_burst_deviation) == (None, None)


def test_a_model_that_is_not_known_is_left_out():
    assert expected('{ kind = "trace", file = "a.csv" }') is None


def test_spread_of_the_mean_burst_of_many_runs():
    rng = np.random.default_rng(5)
    runs = [link(rng, 0.5, 0.3, 400, 8) for _ in range(300)]
    summary = fabricate(steps=400, lanes=8, links={"observation": runs[0]}, estimators={}, bounds=None)
    model = expected_links(summary, SCENARIO_TOML)["observation"]
    assert np.mean([run.mean_burst for run in runs]) == pytest.approx(model.mean_burst, rel=0.01)
    assert np.std([run.mean_burst for run in runs]) == pytest.approx(model.mean_burst_deviation, rel=0.15)
    assert np.std([run.loss_rate for run in runs]) == pytest.approx(model.loss_rate_deviation, rel=0.15)


def test_spread_of_the_mean_burst_behind_a_hidden_state():
    """Bursts are correlated through the state; 1200 lanes at once, each with its own mean."""
    loss = {"kind": "gilbert-elliott", "to_bad": 0.01, "to_good": 0.02, "loss_good": 0.1, "loss_bad": 0.7}
    system = {"A": [[1.0]], "C": [[1.0]], "Q": [[1.0]], "R": [[1.0]]}
    scenario = parse_scenario({"system": system, "lanes": 1200, "links": {"observation": {"loss": loss}}})
    process = loss_process(scenario, "observation", 0, 1200)
    arrived = np.array([process.next(k) for k in range(3000)])
    begins = (arrived[:-1] & ~arrived[1:]).sum(axis=0)
    means = (~arrived).sum(axis=0) / begins
    law = run_law(chain_of(scenario.links.observation.loss), False)
    assert np.mean(means) == pytest.approx(law.mean, rel=0.03)
    assert np.std(means) == pytest.approx(math.sqrt(law.variance_of_mean / begins.mean()), rel=0.1)
