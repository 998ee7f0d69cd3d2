"""Estimators by name: built in and registered, their options, and what is said of wrong ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
import pytest
from annotated_types import Ge, Le

from testbed.errors import UsageError
from testbed.estimator import registry
from testbed.estimator.model import Ack, Estimate, Model
from testbed.estimator.registry import check, create, kinds, model_of
from testbed.scenario import EstimatorSpec, Scenario, parse_scenario

SYSTEM: dict[str, Any] = {"A": [[1.1]], "B": [[1.0]], "C": [[1.0]], "Q": [[0.5]], "R": [[0.4]]}
LOSSY = {"control": {"loss": {"kind": "bernoulli", "arrival": 0.7}}}


def scenario(**changes: Any) -> Scenario:
    return parse_scenario({"system": SYSTEM, "links": LOSSY, "input": {"kind": "constant", "value": [1.0]}, **changes})


MODEL = model_of(scenario())
BUILT_IN = [
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
ALLOWED = ", ".join(sorted([*BUILT_IN, "function", "silly"]))


class Silly:
    """A third party's estimator: always the same."""

    def __init__(
        self,
        model: Model,
        lanes: int,
        gain: float,
        depth: Annotated[int, Ge(1), Le(9)] = 2,
        mode: Literal["fast", "slow"] = "fast",
        weights: list[float] | None = None,
    ) -> None:
        self.lanes, self.gain, self.depth, self.mode, self.weights = lanes, gain, depth, mode, weights
        self.counters: dict[str, int] = {}

    def step(self, u: Any, y: Any, arrived: Any, acks: tuple[Ack, ...] = ()) -> Estimate:
        return Estimate([self.gain], [[1.0]], 1)


@dataclass
class Point:
    name: str
    target: Any

    def load(self) -> Any:
        return self.target


def silly(model: Model, lanes: int, *, gain: float = 3.0) -> Silly:
    return Silly(model, lanes, gain)


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    points = [Point("silly", Silly), Point("function", silly), Point("aoe", Silly)]

    def entry_points(group: str, name: str | None = None) -> list[Point]:
        assert group == "testbed.estimators"
        return [point for point in points if name in (None, point.name)]

    monkeypatch.setattr(registry, "entry_points", entry_points)


def test_kinds_are_those_built_in_and_those_registered() -> None:
    assert ", ".join(kinds()) == ALLOWED


@pytest.mark.parametrize("kind", BUILT_IN)
@pytest.mark.parametrize("lanes", [1, 3])
def test_every_built_in_estimator_keeps_the_protocol(kind: str, lanes: int) -> None:
    made = create(kind, MODEL, lanes=lanes)
    acks = (Ack(0, np.ones(lanes), np.ones(lanes)),)
    out = made.step(np.ones((lanes, 1)), np.zeros((lanes, 1)), np.ones(lanes, dtype=np.uint8), acks)
    assert out.x_hat.shape == (lanes, 1)
    assert out.P.shape == (lanes, 1, 1)
    assert isinstance(made.counters, dict)


def test_registered_estimators_get_their_options() -> None:
    made: Any = create("silly", MODEL, lanes=4, options={"gain": 2, "depth": 9, "mode": "slow", "weights": [1.0, 2]})
    assert (made.lanes, made.gain, made.depth, made.mode, made.weights) == (4, 2.0, 9, "slow", [1.0, 2.0])
    by_function: Any = create("function", MODEL, lanes=1)
    assert by_function.gain == 3.0


def test_a_registered_name_does_not_replace_a_built_in_one() -> None:
    assert type(create("aoe", MODEL, lanes=1)).__module__ == "testbed.estimator.aoe"


@pytest.mark.parametrize(
    ("kind", "options", "expected"),
    [
        ("silli", {}, f"unknown estimator 'silli'; allowed: {ALLOWED}; did you mean 'silly'?"),
        ("kalman", {}, f"unknown estimator 'kalman'; allowed: {ALLOWED}"),
        ("aoe", {"depth": 1}, "estimator 'aoe': unknown option 'depth'; allowed: none"),
        (
            "oe",
            {"max_history": 1},
            "estimator 'oe': unknown option 'max_history'; allowed: tolerance, max_histories, max_lag; did you mean",
        ),
        ("oe", {"max_histories": 0}, "estimator 'oe': max_histories: got 0; "),
        ("oe", {"max_histories": "4"}, "estimator 'oe': max_histories: got '4'; "),
        ("oe", {"max_histories": True}, "estimator 'oe': max_histories: got True; "),
        ("oe", {"max_histories": 4.5}, "estimator 'oe': max_histories: got 4.5; "),
        ("oe", {"max_histories": [4]}, "estimator 'oe': max_histories: got [4]; "),
        ("silly", {}, "estimator 'silly': option 'gain' is missing"),
        ("silly", {"gain": "x"}, "estimator 'silly': gain: got 'x'; "),
        ("silly", {"gain": 1.0, "depth": 10}, "estimator 'silly': depth: got 10; "),
        ("silly", {"gain": 5, "depth": 10.0}, "estimator 'silly': depth: got 10.0; "),
        ("silly", {"gain": 1.0, "mode": "slo"}, "estimator 'silly': mode: got 'slo'; "),
        ("silly", {"gain": 1.0, "weights": [1.0, "a"]}, "estimator 'silly': weights"),
        ("silly", {"gain": 1.0, "weights": {"a": 1}}, "estimator 'silly': weights"),
        ("function", {"gain": None}, "estimator 'function': gain: got None; "),
    ],
)
def test_what_is_wrong_is_said_in_one_line(kind: str, options: dict[str, Any], expected: str) -> None:
    with pytest.raises(UsageError) as refusal:
        create(kind, MODEL, lanes=1, options=options)
    assert str(refusal.value).startswith(expected)
    assert len(str(refusal.value).splitlines()) == 1


def test_ff_holds_for_independent_losses_only() -> None:
    markov = {"control": {"loss": {"kind": "markov", "recovery": 0.5, "failure": 0.3}}}
    with pytest.raises(UsageError, match=r"i\.i\.d"):
        create("ff", model_of(scenario(links=markov)), lanes=1)
    same = {"control": {"loss": {"kind": "markov", "recovery": 0.7, "failure": 0.3}}}
    create("ff", model_of(scenario(links=same)), lanes=1)
    started = {"control": {"loss": {"kind": "markov", "recovery": 0.7, "failure": 0.3, "start": 1.0}}}
    with pytest.raises(UsageError, match=r"i\.i\.d"):
        create("ff", model_of(scenario(links=started)), lanes=1)


def allowed(
    kind: str, acks: str, until: int | None = None, options: dict[str, Any] | None = None, **changes: Any
) -> bool:
    given = scenario(**changes)
    try:
        check(EstimatorSpec(name=kind, until=until, options=options or {}), model_of(given), acks=acks, scenario=given)
    except UsageError as error:
        if not str(error).startswith(f"estimators.{kind}: "):
            pytest.fail(f"does not name the estimator: {error}")
        return False
    return True


def test_kfio_runs_where_every_ack_that_matters_is_there() -> None:
    ack_link = {**LOSSY, "ack": {"mode": "link"}}
    lossy_ack = {**LOSSY, "ack": {"mode": "link", "loss": {"kind": "bernoulli", "arrival": 0.9}}}
    assert allowed("kfio", "perfect")
    assert not allowed("kfio", "none")
    assert allowed("kfio", "link", links=ack_link)
    assert not allowed("kfio", "link", links=lossy_ack)
    assert allowed("kfio", "none", links={})
    assert allowed("kfio", "none", input={"kind": "constant", "value": [0.0]})
    assert allowed("kfio", "none", system={key: value for key, value in SYSTEM.items() if key != "B"}, input=None)


@pytest.mark.parametrize(("limit", "longest"), [(1, 0), (2, 1), (3, 1), (4, 2), (1024, 10), (1025, 10)])
def test_oe_runs_as_long_as_its_histories_fit(limit: int, longest: int) -> None:
    options = {"max_histories": limit}
    for until in range(max(1, longest - 1), longest + 3):
        assert allowed("oe-exact", "none", until, options) == (until <= longest)
        assert allowed("oe", "none", until, options)
    assert allowed("oe-exact", "none", 50, options, links={})


def test_the_model_is_that_of_the_scenario() -> None:
    system = {
        "A": [[1.0, 2.0], [0.0, 1.0]],
        "C": [[1.0, 0.0]],
        "G": [[1.0], [3.0]],
        "Q": [[2.0]],
        "R": [[4.0]],
        "x0_mean": [5.0, 6.0],
        "P0": [[7.0, 1.0], [1.0, 8.0]],
    }
    model = model_of(parse_scenario({"system": system}))
    np.testing.assert_array_equal(model.Q, [[2.0, 6.0], [6.0, 18.0]])  # G Q G'
    np.testing.assert_array_equal(model.A, system["A"])
    np.testing.assert_array_equal(model.P0, system["P0"])
    np.testing.assert_array_equal(model.x0_mean, system["x0_mean"])
    assert (model.n, model.p, model.q, model.B) == (2, 1, 0, None)
    assert model.control.never_loses
    assert MODEL.control.start == 0.7
