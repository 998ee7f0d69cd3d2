"""PACKETS.jsonl: what is read, and that every kind of wrong line gives one line of error with its number."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from testbed.errors import RunFailed, TestbedError, UsageError
from testbed.estimator.errors import MissingAck, TooManyHistories
from testbed.estimator.model import Ack, Model
from testbed.estimator.packets import PacketLine, read_packets, replay
from testbed.estimator.registry import create, model_of
from testbed.scenario import parse_scenario

SYSTEM: dict[str, Any] = {
    "A": [[1.1, 0.2], [0.0, 0.7]],
    "B": [[1.0], [-0.5]],
    "C": [[1.0, 0.5]],
    "Q": [[0.5, 0.1], [0.1, 0.3]],
    "R": [[0.4]],
}
LOSSY = {"control": {"loss": {"kind": "bernoulli", "arrival": 0.7}}}
MODEL = model_of(parse_scenario({"system": SYSTEM, "links": LOSSY}))
NO_INPUT = model_of(parse_scenario({"system": {key: value for key, value in SYSTEM.items() if key != "B"}}))
FIRST = '{"k": 1, "u": [1.0], "y": [0.5]}'


def read(*lines: str, model: Model = MODEL) -> list[PacketLine]:
    return list(read_packets(lines, model))


def estimates(lines: list[str], kind: str = "aoe", model: Model = MODEL, **options: Any) -> list[dict[str, Any]]:
    use_acks = options.pop("use_acks", True)
    made = create(kind, model, lanes=1, options=options)
    return [json.loads(line) for line in replay(made, model, read_packets(lines, model), use_acks=use_acks)]


def test_a_line_has_what_it_says() -> None:
    (line,) = read('{"k": 1, "u": [2], "y": [-0.5], "gamma": 1, "acks": [[0, 1]]}')
    assert (line.k, line.u, line.y, line.gamma, line.acks) == (1, [2.0], [-0.5], 1, [(0, 1)])


@pytest.mark.parametrize(
    "text",
    [
        '{"k": 1, "u": [1.0]}',
        '{"k": 1, "u": [1.0], "y": null}',
        '{"k": 1, "u": [1.0], "y": null, "gamma": null, "acks": null}',
        '{"k": 1, "u": [1.0], "y": null, "gamma": 0}',
        '{"k": 1, "u": [1.0], "y": [1.0], "gamma": 0, "acks": []}',
        ' {"acks":[[0,0]],"y":[1e3],"u":[-1],"k":1} ',
    ],
)
def test_what_may_be_left_out(text: str) -> None:
    assert len(read(text)) == 1


def test_empty_lines_are_skipped_and_counted() -> None:
    assert [line.k for line in read(FIRST, "", "  \t", '{"k": 2, "u": [0.0]}')] == [1, 2]
    with pytest.raises(UsageError, match=r"^line 4: k: "):
        read(FIRST, "", "  ", FIRST)


def test_without_input_u_may_be_left_out() -> None:
    assert [
        line.u for line in read('{"k": 1, "y": [1.0]}', '{"k": 2, "u": []}', '{"k": 3, "u": null}', model=NO_INPUT)
    ] == [None, [], None]


WRONG = {
    "not JSON": ('{"k": 2, "u": [1.0]', "line"),
    "not an object": ("[1, 2]", "line"),
    "a number": ("2", "line"),
    "nothing but null": ("null", "line"),
    "no k": ('{"u": [1.0]}', "k"),
    "k of the line before": (FIRST, "k"),
    "k too large": ('{"k": 3, "u": [1.0]}', "k"),
    "k zero": ('{"k": 0, "u": [1.0]}', "k"),
    "k negative": ('{"k": -1, "u": [1.0]}', "k"),
    "k not an integer": ('{"k": 2.5, "u": [1.0]}', "k"),
    "k a text": ('{"k": "2", "u": [1.0]}', "k"),
    "k true": ('{"k": true, "u": [1.0]}', "k"),
    "k null": ('{"k": null, "u": [1.0]}', "k"),
    "k huge": ('{"k": ' + "9" * 30 + ', "u": [1.0]}', "k"),
    "no u": ('{"k": 2}', "u"),
    "u null": ('{"k": 2, "u": null}', "u"),
    "u too short": ('{"k": 2, "u": []}', "u"),
    "u too long": ('{"k": 2, "u": [1.0, 2.0]}', "u"),
    "u a number": ('{"k": 2, "u": 1.0}', "u"),
    "u of texts": ('{"k": 2, "u": ["1.0"]}', "u"),
    "u of booleans": ('{"k": 2, "u": [true]}', "u"),
    "u with null": ('{"k": 2, "u": [null]}', "u"),
    "u nested": ('{"k": 2, "u": [[1.0]]}', "u"),
    "u NaN": ('{"k": 2, "u": [NaN]}', ""),
    "u infinite": ('{"k": 2, "u": [1e999]}', "u"),
    "y too long": ('{"k": 2, "u": [1.0], "y": [1.0, 2.0]}', "y"),
    "y too short": ('{"k": 2, "u": [1.0], "y": []}', "y"),
    "y a number": ('{"k": 2, "u": [1.0], "y": 1.0}', "y"),
    "y of texts": ('{"k": 2, "u": [1.0], "y": ["1"]}', "y"),
    "y infinite": ('{"k": 2, "u": [1.0], "y": [-1e999]}', "y"),
    "y infinite by name": ('{"k": 2, "u": [1.0], "y": [Infinity]}', ""),
    "gamma 1 without y": ('{"k": 2, "u": [1.0], "y": null, "gamma": 1}', "gamma"),
    "gamma 2": ('{"k": 2, "u": [1.0], "y": [1.0], "gamma": 2}', "gamma"),
    "gamma true": ('{"k": 2, "u": [1.0], "y": [1.0], "gamma": true}', "gamma"),
    "gamma one half": ('{"k": 2, "u": [1.0], "y": [1.0], "gamma": 0.5}', "gamma"),
    "gamma a text": ('{"k": 2, "u": [1.0], "y": [1.0], "gamma": "1"}', "gamma"),
    "ack of the future": ('{"k": 2, "u": [1.0], "acks": [[2, 1]]}', "acks"),
    "ack of a negative packet": ('{"k": 2, "u": [1.0], "acks": [[-1, 1]]}', "acks"),
    "ack of half a packet": ('{"k": 2, "u": [1.0], "acks": [[0.5, 1]]}', "acks"),
    "ack of neither 0 nor 1": ('{"k": 2, "u": [1.0], "acks": [[0, 2]]}', "acks"),
    "ack true": ('{"k": 2, "u": [1.0], "acks": [[0, true]]}', "acks"),
    "ack without nu": ('{"k": 2, "u": [1.0], "acks": [[0]]}', "acks"),
    "ack with too much": ('{"k": 2, "u": [1.0], "acks": [[0, 1, 1]]}', "acks"),
    "acks not pairs": ('{"k": 2, "u": [1.0], "acks": [0, 1]}', "acks"),
    "acks not a list": ('{"k": 2, "u": [1.0], "acks": {"0": 1}}', "acks"),
    "a key too much": ('{"k": 2, "u": [1.0], "z": 1}', "z"),
    "a key misspelt": ('{"k": 2, "U": [1.0]}', ""),
    "a column too much": ('{"k": 2, "u": [1.0]} {"k": 3, "u": [1.0]}', "line"),
    "deep": ('{"k": 2, "u": ' + "[" * 5000 + "]" * 5000 + "}", ""),
    "not ASCII": ('{"k": 2, "ü": [1.0]}', ""),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_line_gives_one_line_of_error_with_its_number(name: str) -> None:
    text, where = WRONG[name]
    with pytest.raises(UsageError) as refusal:
        read(FIRST, text)
    message = str(refusal.value)
    assert message.startswith(f"line 2: {where}")
    assert len(message.splitlines()) == 1
    assert len(message) < 300


def test_the_first_line_is_step_1() -> None:
    with pytest.raises(UsageError, match=r"^line 1: k: got 2; allowed: 1"):
        read('{"k": 2, "u": [1.0]}')


@settings(deadline=None, max_examples=300)
@given(
    st.one_of(
        st.text(max_size=60),
        st.builds(
            json.dumps,
            st.recursive(
                st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5),
                lambda inner: (
                    st.lists(inner, max_size=3)
                    | st.dictionaries(st.sampled_from(["k", "u", "y", "gamma", "acks", "x"]), inner, max_size=5)
                ),
                max_leaves=8,
            ),
        ),
    )
)
def test_whatever_a_line_holds_it_is_read_or_refused_in_one_line(text: str) -> None:
    try:
        read(FIRST, text)
    except UsageError as error:
        line = str(error)
        if not line.startswith("line 2: ") or len(line.splitlines()) != 1:
            pytest.fail(f"not one line with its number: {line!r}")


def test_estimates_are_those_of_the_estimator() -> None:
    lines = [
        '{"k": 1, "u": [1.0], "y": [0.5]}',
        '{"k": 2, "u": [2.0], "y": null, "acks": [[1, 0]]}',
        '{"k": 3, "u": [3.0], "y": [4.0], "gamma": 0, "acks": [[0, 1], [2, 1]]}',
    ]
    made = create("oe", MODEL, lanes=1)
    one, zero, acks = (
        np.ones(1),
        np.zeros(1),
        [Ack(j, np.array([nu]), np.ones(1)) for j, nu in ((1, 0), (0, 1), (2, 1))],
    )
    direct = [
        made.step(np.array([[1.0]]), np.array([[0.5]]), one),
        made.step(np.array([[2.0]]), np.array([[0.0]]), zero, (acks[0],)),
        made.step(np.array([[3.0]]), np.array([[0.0]]), zero, (acks[1], acks[2])),
    ]
    for line, expected in zip(estimates(lines, "oe"), direct, strict=True):
        assert set(line) == {"k", "x_hat", "P", "error_bound", "error_bound_P"}
        assert line["error_bound"] == line["error_bound_P"] == 0.0
        assert line["x_hat"] == expected.x_hat[0].tolist()
        assert line["P"] == expected.P[0].tolist()
    without = estimates(lines, "oe", use_acks=False)
    assert without[0] == estimates(lines, "oe")[0]
    assert without[1] != estimates(lines, "oe")[1]


def test_noise_alone_is_no_observation() -> None:
    with_noise = estimates([FIRST, '{"k": 2, "u": [1.0], "y": [100.0], "gamma": 0}'])
    nothing = estimates([FIRST, '{"k": 2, "u": [1.0]}'])
    assert with_noise == nothing


def test_what_an_estimator_refuses_names_the_step() -> None:
    with pytest.raises(MissingAck, match=r"^step 1: kfio needs the ACK"):
        estimates([FIRST], "kfio")
    with pytest.raises(TooManyHistories, match=r"^step 2: oe-exact would need 4 histories"):
        estimates([FIRST, '{"k": 2, "u": [1.0]}'], "oe-exact", max_histories=2)


@pytest.mark.parametrize("u", [1.0, 0.0])
@pytest.mark.parametrize("kind", ["aoe", "ff", "oe"])
def test_estimates_that_are_no_numbers_are_an_error_and_not_bad_json(kind: str, u: float) -> None:
    system = {**SYSTEM, "A": [[1e200, 0.0], [0.0, 1.0]]}
    model = model_of(parse_scenario({"system": system, "links": LOSSY}))
    lines = [json.dumps({"k": k, "u": [u]}) for k in range(1, 6)]
    with pytest.raises(RunFailed, match=r"^step \d: the estimate left the range of floating-point numbers"):
        estimates(lines, kind, model)


def test_errors_of_a_replay_are_for_the_user() -> None:
    assert issubclass(RunFailed, TestbedError)
    assert RunFailed.exit_code == 1
    assert UsageError.exit_code == 2
