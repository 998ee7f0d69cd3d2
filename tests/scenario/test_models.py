"""What a scenario resolves to: defaults, shorthand forms, files."""

from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from testbed.scenario import (
    AckLink,
    BernoulliLoss,
    Clock,
    ConstantInput,
    EstimatorSpec,
    FeedbackInput,
    Link,
    MarkovLoss,
    NoLoss,
    Scenario,
    System,
    TableInput,
    Transport,
    load_scenario,
    parse_scenario,
    to_dict,
    to_toml,
)

EXAMPLE = """
name = "markov-1.2910"
steps = 100                # k = 1 … steps
lanes = 256
seed = 1
clock = { mode = "virtual" }
record = "first"

[system]
A = [[1.2910, 0.0], [0.0, 1.005]]
B = [[-1.0], [1.0]]
C = [[1.0, -1.0], [0.0, 1.0]]
Q = [[20.0, 0.0], [0.0, 20.0]]
R = [[20.0, 0.0], [0.0, 20.0]]
x0_mean = [0.0, 0.0]
P0 = [[1.0, 0.0], [0.0, 1.0]]

[input]
kind = "exponential"
offset = 1.0
amplitude = 1.0
tau = 10.0

[links.observation]
loss = { kind = "markov", recovery = 0.5, failure = 0.3 }
[links.control]
loss = { kind = "bernoulli", arrival = 0.8 }
[links.ack]
mode = "none"

[[estimators]]
name = "aoe"
acks = "none"
"""

SMALL: dict[str, Any] = {
    "system": {"A": [[1, 0], [0, 2]], "B": [[1], [1]], "C": [[1, 1]], "Q": [[1, 0], [0, 1]], "R": [[3]]},
    "estimators": [{"name": "oe"}, {"name": "aoe"}],
}


def small(**changes: Any) -> Scenario:
    return parse_scenario({**SMALL, **changes})


def loss_of(**loss: Any) -> object:
    return small(links={"control": {"loss": loss}}).links.control.loss


def test_example_of_the_contract(tmp_path: Path) -> None:
    file = tmp_path / "scenario.toml"
    file.write_text(EXAMPLE, encoding="utf-8")
    scenario = load_scenario(file)
    assert (scenario.name, scenario.steps, scenario.lanes, scenario.seed) == ("markov-1.2910", 100, 256, 1)
    assert scenario.system.A == ((1.291, 0.0), (0.0, 1.005))
    assert scenario.links.observation.loss == MarkovLoss(recovery=0.5, failure=0.3)
    assert scenario.links.control.loss == BernoulliLoss(arrival=0.8)
    assert scenario.estimators == (EstimatorSpec(name="aoe", acks="none"),)
    assert load_scenario(str(file)) == scenario


def test_defaults() -> None:
    scenario = small()
    assert (scenario.name, scenario.steps, scenario.lanes, scenario.seed) == ("scenario", 100, 1, 1)
    assert (scenario.record, scenario.bounds) == ("first", True)
    assert scenario.clock == Clock(mode="virtual", period="10 ms", window=None)
    assert scenario.clock.period_ns == 10_000_000
    assert scenario.transport == Transport()
    assert scenario.transport.deadline_ns == 10_000_000_000
    assert scenario.links.control == Link(loss=NoLoss())
    assert scenario.links.ack == AckLink(mode="none", loss=NoLoss())
    assert scenario.input == ConstantInput(value=(0.0,))
    assert scenario.system.x0_mean == (0.0, 0.0)
    assert scenario.system.P0 == ((1.0, 0.0), (0.0, 1.0))
    assert scenario.estimators[1].kind == "aoe"


def test_sizes_of_a_system() -> None:
    system = System.model_validate(
        {"A": [[1, 0], [0, 2]], "B": [[1, 0, 2], [1, 0, 1]], "C": [[1, 1]], "G": [[1], [0]], "Q": [[1]], "R": [[3]]}
    )
    assert (system.n, system.q, system.p, system.g) == (2, 3, 1, 1)


def test_no_input_without_B() -> None:
    scenario = small(system={key: value for key, value in SMALL["system"].items() if key != "B"})
    assert scenario.input is None
    assert scenario.system.q == 0
    assert parse_scenario(to_toml(scenario)) == scenario


def test_scenarios_cannot_be_changed() -> None:
    with pytest.raises(ValidationError):
        small().steps = 3


def test_bernoulli_from_loss() -> None:
    assert loss_of(kind="bernoulli", loss=0.25) == BernoulliLoss(arrival=0.75)


def test_markov_from_loss_and_mean_burst() -> None:
    loss = loss_of(kind="markov", loss=0.2, mean_burst=4.0)
    assert isinstance(loss, MarkovLoss)
    assert 1 / loss.recovery == pytest.approx(4.0, rel=1e-15)
    assert loss.failure / (loss.recovery + loss.failure) == pytest.approx(0.2, rel=1e-15)
    assert loss.start is None


def test_markov_at_the_largest_loss_of_its_mean_burst() -> None:
    loss = loss_of(kind="markov", loss=0.75, mean_burst=3, start=1)
    assert isinstance(loss, MarkovLoss)
    assert loss.failure == pytest.approx(1.0, rel=1e-12)
    assert loss.failure <= 1.0
    assert loss.start == 1.0


def test_options_are_the_other_keys_of_an_estimator() -> None:
    table = {"name": "gpb3", "kind": "gpb", "until": 7, "depth": 3, "grid": {"spacing": 0.5, "axes": [1, True, "x"]}}
    spec = small(estimators=[table]).estimators[0]
    assert (spec.kind, spec.until, spec.acks) == ("gpb", 7, None)
    assert spec.options == {"depth": 3, "grid": {"spacing": 0.5, "axes": [1, True, "x"]}}
    assert spec == EstimatorSpec(name="gpb3", kind="gpb", until=7, options=spec.options)
    assert to_dict(small(estimators=[table]))["estimators"] == [table]


def test_feedback_names_the_first_estimator() -> None:
    source = small(input={"kind": "feedback", "gain": [[0.5, 1]]}).input
    assert source == FeedbackInput(gain=((0.5, 1.0),), estimator="oe")


def test_an_estimator_of_a_closed_loop_may_end_with_the_run() -> None:
    source = small(input={"kind": "feedback", "gain": [[0.5, 1]]}, steps=5, estimators=[{"name": "oe", "until": 5}])
    assert isinstance(source.input, FeedbackInput)


@pytest.mark.parametrize(
    "text", ["1\n2\n3\n", "u1\n1\n2\n3", "# a comment\n\n1.0\n 2e0\n\n+3\n", '"u"\r\n"1"\r\n2\r\n3\r\n']
)
def test_table_from_a_file_beside_the_scenario(tmp_path: Path, text: str) -> None:
    (tmp_path / "u.csv").write_text(text, encoding="utf-8", newline="")
    scenario = parse_scenario({**SMALL, "steps": 3, "input": {"kind": "table", "file": "u.csv"}}, tmp_path)
    assert scenario.input == TableInput(values=((1.0,), (2.0,), (3.0,)))
    assert parse_scenario(to_toml(scenario), "/nowhere") == scenario


def test_paths_become_absolute(tmp_path: Path) -> None:
    tls = {"ca": "ca.pem", "certificate": "/etc/router.pem", "key": "router.key"}
    transport = {"endpoint": "tls/10.0.0.1:7447", "tls": tls, "users_file": "users.txt"}
    resolved = parse_scenario({**SMALL, "transport": transport}, tmp_path).transport
    assert resolved.tls is not None
    assert resolved.tls.ca == str(tmp_path / "ca.pem")
    assert resolved.tls.certificate == "/etc/router.pem"
    assert resolved.users_file == str(tmp_path / "users.txt")


def test_covariances_are_kept_as_given() -> None:
    nearly = [[1.0, 0.5], [0.5 + 1e-12, 1.0]]
    assert small(system={**SMALL["system"], "Q": nearly}).system.Q == ((1.0, 0.5), (0.5 + 1e-12, 1.0))
    singular = [[1.0, 1.0], [1.0, 1.0]]
    assert small(system={**SMALL["system"], "Q": singular}).system.Q == ((1.0, 1.0), (1.0, 1.0))


@pytest.mark.parametrize("scale", [1e-300, 1e-9, 1e9, 1e300])
def test_definiteness_does_not_depend_on_the_units(scale: float) -> None:
    matrix = [[2 * scale, -scale], [-scale, 2 * scale]]
    system = {**SMALL["system"], "C": [[1, 0], [0, 1]], "R": matrix, "Q": matrix, "P0": [[0, 0], [0, 0]]}
    assert small(system=system).system.R[0][0] == 2 * scale
