"""Every wrong input gives one line that says where, what was given, what is allowed, and the nearest match."""

import copy
import os
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from scenario.strategies import scenarios
from testbed.errors import RunFailed, TestbedError, UsageError, did_you_mean, nearest
from testbed.scenario import load_scenario, parse_scenario, to_toml

SOURCE = "scenario.toml"
SYSTEM: dict[str, Any] = {
    "A": [[1.0, 0.0], [0.0, 1.0]],
    "B": [[1.0], [1.0]],
    "C": [[1.0, 0.0]],
    "Q": [[1.0, 0.0], [0.0, 1.0]],
    "R": [[1.0]],
}
BASE: dict[str, Any] = {"system": SYSTEM, "estimators": [{"name": "oe"}]}
ABSENT = object()
KINDS = "none, bernoulli, markov, gilbert-elliott, four-state, trace, scripted"
LOSS = "links.control.loss"
_TO_GOOD = "Probability that a bad state is followed by a good one, 0 … 1"
NAN, INF = float("nan"), float("inf")


def changed(changes: dict[str, Any]) -> dict[str, Any]:
    """The base scenario with the values at dotted paths replaced."""
    table = copy.deepcopy(BASE)
    for path, value in changes.items():
        *above, key = path.split(".")
        place = table
        for step in above:
            place = place.setdefault(step, {})
        if value is ABSENT:
            del place[key]
        else:
            place[key] = value
    return table


def message(table: dict[str, Any] | str, base_dir: Path | str = ".") -> str:
    with pytest.raises(UsageError) as caught:
        parse_scenario(table, base_dir, source=SOURCE)
    text = str(caught.value)
    assert caught.value.exit_code == 2
    assert len(text.splitlines()) == 1
    assert text.startswith(f"{SOURCE}: ")
    return text.removeprefix(f"{SOURCE}: ")


EXACT: list[tuple[dict[str, Any], str]] = [
    # the form of a message
    ({f"{LOSS}": {"kind": "bernoulli", "arrival": 1.2}}, f"{LOSS}.arrival: got 1.2; allowed: 0 … 1"),
    ({"lane": 2}, "unknown key 'lane'; did you mean 'lanes'?"),
    ({"links.control.los": {}}, "links.control: unknown key 'los'; did you mean 'loss'?"),
    ({"sytem": SYSTEM, "system": ABSENT}, "unknown key 'sytem'; did you mean 'system'?"),
    ({"seed": -1, "steps": 0, "lane": 1}, "unknown key 'lane'; did you mean 'lanes'? (and 2 more)"),
    ({"steps": 0, "seed": -1, "record": 1}, "steps: got 0; allowed: an integer, 1 … 2147483647 (and 2 more)"),
    (
        {"links.ack.delay": "1 ms"},
        "links.ack.delay: got '1 ms'; allowed: a table with a kind: constant, uniform, normal, log-normal, table",
    ),
    (
        {"links.control.delay": {"kind": "uniform", "low": "3 ms", "high": "1 ms"}},
        "links.control.delay.high: got '1 ms'; allowed: not less than low, which is '3 ms'",
    ),
    (
        {"links.control.delay": {"kind": "table", "values": [1.0, -2.0]}},
        "links.control.delay.values[1]: got -2.0; allowed: 0 or more",
    ),
    (
        {"links.control.delay": {"kind": "normal", "mean": "3 ms", "std": "1 ms", "minimum": "10 ms"}},
        "links.control.delay.minimum: got '10 ms'; allowed: at most mean + 6 std",
    ),
    (
        {"links.control.clock": "time"},
        "links.control.slot: got nothing with clock 'time'; allowed: a duration such as '10 ms'",
    ),
    (
        {"links.control.slot": "1 ms"},
        "links.control.slot: got '1 ms' with clock 'packet'; allowed: only with clock = 'time'",
    ),
    (
        {"links.ack.duplicate": {"chance": 0.5}},
        "links.ack.duplicate: got a table with mode 'none'; allowed: only with mode 'link'",
    ),
    (
        {"links.control.rate": {"bits_per_second": 0}},
        "links.control.rate.bits_per_second: got 0; allowed: more than 0, at most 1e+15",
    ),
    ({"clock.deadlines": "soft"}, "clock.deadlines: got 'soft'; allowed: only with mode 'real'"),
    ({"clock.priority": 10}, "clock.priority: got 10; allowed: only with mode 'real'"),
    ({"clock": {"mode": "real", "priority": 100}}, "clock.priority: got 100; allowed: an integer, 1 … 99"),
    ({"clock.deadline": "5 ms"}, "clock.deadline: got '5 ms'; allowed: only with mode 'real'"),
    (
        {"clock": {"mode": "real", "deadlines": "strickt"}},
        "clock.deadlines: got 'strickt'; allowed: soft, strict; did you mean 'strict'?",
    ),
    (
        {"clock": {"mode": "real", "deadline": "0 ms"}},
        "clock.deadline: got '0 ms'; allowed: a whole number of nanoseconds, 1 … 2**63 - 1",
    ),
    (
        {"clock": {"mode": "real", "period": 0.01}},
        "clock.period: got 0.01; allowed: a duration with a unit (ns, us, ms, s, min), such as '10 ms'",
    ),
    # model error
    (
        {"uncertainty": {}},
        "uncertainty.delta: missing; needed: Each parameter is drawn from -delta … delta, at every step "
        "and in every lane",
    ),
    (
        {"uncertainty": {"delta": 1}},
        "uncertainty: got none of dA, dG, dC; allowed: at least one of them, with a matrix for each parameter",
    ),
    (
        {"uncertainty": {"dA": [], "delta": 1}},
        "uncertainty: got none of dA, dG, dC; allowed: at least one of them, with a matrix for each parameter",
    ),
    ({"uncertainty": {"dA": [[[1, 0], [0, 1]]], "delta": -1}}, "uncertainty.delta: got -1; allowed: 0 or more"),
    ({"uncertainty": {"dA": [[[1, 0], [0, 1]]], "delta": NAN}}, "uncertainty.delta: got nan; allowed: 0 or more"),
    (
        {"uncertainty": {"dA": 1, "delta": 1}},
        "uncertainty.dA: got 1; allowed: a list of matrices, one for each parameter",
    ),
    (
        {"uncertainty": {"dA": [[[1, 0], [0]]], "delta": 1}},
        "uncertainty.dA[0][1]: got 1 number; allowed: 2 numbers, as in row 0",
    ),
    (
        {"uncertainty": {"dA": [[1, 0], [0, 1]], "delta": 1}},
        "uncertainty.dA[0]: got [1, 0]; allowed: nested arrays, one list for each row, such as [[1], [0]] (a column) "
        "or [[1, 0]] (a row) (and 1 more)",
    ),
    ({"uncertainty": {"dA": [[[1, 0]]], "delta": 1}}, "uncertainty.dA[0]: got 1 × 2; allowed: 2 × 2, the size of A"),
    ({"uncertainty": {"dG": [[[1], [0]]], "delta": 1}}, "uncertainty.dG[0]: got 2 × 1; allowed: 2 × 2, the size of G"),
    (
        {"uncertainty": {"dC": [[[1, 0]], [[1]]], "delta": 1}},
        "uncertainty.dC[1]: got 1 × 1; allowed: 1 × 2, the size of C",
    ),
    (
        {"uncertainty": {"dA": [[[1, 0], [0, 1]]], "dC": [[[1, 0]], [[0, 1]]], "delta": 1}},
        "uncertainty.dC: got 2 parameters; allowed: 1, as many as dA has matrices",
    ),
    ({"uncertainty": {"da": [], "delta": 1}}, "uncertainty: unknown key 'da'; did you mean 'dA'?"),
    (
        {"links.observation.on_loss": "noize"},
        "links.observation.on_loss: got 'noize'; allowed: nothing, noise; did you mean 'noise'?",
    ),
    ({"links.control.on_loss": "noise"}, "links.control: unknown key 'on_loss'; did you mean 'loss'?"),
    # losses
    ({f"{LOSS}.arrival": 0.5}, f"{LOSS}.kind: missing; allowed: {KINDS}"),
    (
        {f"{LOSS}.kind": "bernouli"},
        f"{LOSS}.kind: got 'bernouli'; allowed: {KINDS}; did you mean 'bernoulli'?",
    ),
    (
        {LOSS: "bernoulli"},
        f"{LOSS}: got 'bernoulli'; allowed: a table with a kind: {KINDS}",
    ),
    ({LOSS: {"kind": ["markov"]}}, f"{LOSS}.kind: got ['markov']; allowed: {KINDS}"),
    ({LOSS: {"kind": "bernoulli", "arival": 0.5}}, f"{LOSS}: unknown key 'arival'; did you mean 'arrival'?"),
    (
        {LOSS: {"kind": "bernoulli", "loss": 0.5, "arival": 0.5}},
        f"{LOSS}: unknown key 'arival'; did you mean 'arrival'?",
    ),
    ({LOSS: {"kind": "bernoulli", "loss": -0.5}}, f"{LOSS}.loss: got -0.5; allowed: 0 … 1"),
    ({LOSS: {"kind": "bernoulli", "arrival": NAN}}, f"{LOSS}.arrival: got nan; allowed: 0 … 1"),
    ({LOSS: {"kind": "bernoulli", "arrival": True}}, f"{LOSS}.arrival: got true; allowed: 0 … 1"),
    ({LOSS: {"kind": "bernoulli"}}, f"{LOSS}: got none of them; allowed: exactly one of arrival, loss"),
    (
        {LOSS: {"kind": "bernoulli", "loss": 0.5, "arrival": 0.5}},
        f"{LOSS}: got arrival and loss; allowed: exactly one of arrival, loss",
    ),
    (
        {LOSS: {"kind": "markov", "recovery": 0.5, "loss": 0.5}},
        f"{LOSS}: got recovery and loss; allowed: recovery and failure, or loss and mean_burst",
    ),
    (
        {LOSS: {"kind": "markov", "recovery": 0, "failure": 0.0}},
        f"{LOSS}: got recovery 0 and failure 0; allowed: recovery + failure more than 0",
    ),
    (
        {LOSS: {"kind": "markov", "loss": 0.9, "mean_burst": 2}},
        f"{LOSS}.loss: got 0.9; allowed with mean_burst 2: 0 … 0.666667, that is mean_burst / (1 + mean_burst); "
        "more would need failure above 1",
    ),
    (
        {LOSS: {"kind": "markov", "loss": 0.5, "mean_burst": 0.5}},
        f"{LOSS}.mean_burst: got 0.5; allowed: 1 or more",
    ),
    (
        {LOSS: {"kind": "markov", "loss": 0.5, "mean_burst": 2, "start": 3}},
        f"{LOSS}.start: got 3; allowed: 0 … 1",
    ),
    ({LOSS: {"kind": "gilbert-elliott", "to_bad": 0.1}}, f"{LOSS}.to_good: missing; needed: {_TO_GOOD}"),
    (
        {LOSS: {"kind": "gilbert-elliott", "to_bad": 0, "to_good": 0.0}},
        f"{LOSS}: got to_bad 0 and to_good 0; allowed: to_bad + to_good more than 0",
    ),
    (
        {LOSS: {"kind": "gilbert-elliott", "to_bad": 0.1, "to_good": 0.5, "loss_good": 0.2, "loss_bad": 0.1}},
        f"{LOSS}.loss_good: got 0.2; allowed with loss_bad 0.1: 0 … 0.1, the bad state being the one that loses more",
    ),
    (
        {LOSS: {"kind": "gilbert-elliott", "to_bad": 0.1, "to_good": 0.5, "loss_bad": 1.5}},
        f"{LOSS}.loss_bad: got 1.5; allowed: 0 … 1",
    ),
    (
        {LOSS: {"kind": "gilbert-elliott", "to_bad": 0.1, "to_good": 0.5, "start": 0.5}},
        f"{LOSS}: unknown key 'start'; did you mean 'start_good'?",
    ),
    (
        {LOSS: {"kind": "gilbert", "to_bad": 0.1, "to_good": 0.5}},
        f"{LOSS}.kind: got 'gilbert'; allowed: {KINDS}; did you mean 'gilbert-elliott'?",
    ),
    (
        {LOSS: {"kind": "four-state", "to_burst": 0.7, "to_good": 0.5, "to_isolated": 0.4}},
        f"{LOSS}.to_isolated: got 0.4; allowed with to_burst 0.7: 0 … 0.3, so that they add up to 1 at most",
    ),
    (
        {LOSS: {"kind": "four-state", "to_burst": 0.7, "to_good": 0.5, "to_pause": 0.6}},
        f"{LOSS}.to_pause: got 0.6; allowed with to_good 0.5: 0 … 0.5, so that they add up to 1 at most",
    ),
    (
        {LOSS: {"kind": "four-state", "to_burst": 0, "to_good": 0.0, "to_isolated": 0.5}},
        f"{LOSS}: got to_burst 0 and to_good 0; allowed: to_burst + to_good more than 0",
    ),
    (
        {LOSS: {"kind": "four-state", "to_burst": 0.1, "to_good": 0.5, "from_pause": 0}},
        f"{LOSS}.from_pause: got 0.0; allowed: more than 0, so that a pause ends",
    ),
    (
        {LOSS: {"kind": "four-state", "to_burst": 0.1, "to_good": 0.5, "start": [0.5, 0.5]}},
        f"{LOSS}.start: got [0.5, 0.5]; allowed: four numbers of 0 or more that add up to 1",
    ),
    (
        {LOSS: {"kind": "four-state", "to_burst": 0.1, "to_good": 0.5, "p23": 0.5}},
        f"{LOSS}: unknown key 'p23'; allowed: kind, to_burst, to_good, to_pause, from_pause, to_isolated, start",
    ),
    ({LOSS: {"kind": "trace"}}, f"{LOSS}: got neither of file and fates; allowed: exactly one of file, fates"),
    ({LOSS: {"kind": "trace", "file": 3}}, f"{LOSS}.file: got 3; allowed: the path of a CSV file"),
    ({LOSS: {"kind": "trace", "fates": "10x"}}, f"{LOSS}.fates: got '10x'; allowed: a text of 0 and 1"),
    ({LOSS: {"kind": "trace", "fates": ""}}, f"{LOSS}.fates: got ''; allowed: a text of 0 and 1"),
    (
        {LOSS: {"kind": "trace", "fates": "1011", "offset": 4}},
        f"{LOSS}.offset: got 4; allowed: 0 … 3, the last packet of the trace",
    ),
    (
        {"steps": 9, LOSS: {"kind": "trace", "fates": "1011", "offset": 1, "repeat": False}},
        f"{LOSS}.fates: got 3 packets from offset 1 on with repeat false; allowed: at least 9, one for each step, or "
        "repeat = true",
    ),
    (
        {LOSS: {"kind": "trace", "fates": "1011", "assumed": {"kind": "trace", "fates": "1"}}},
        f"{LOSS}.assumed.kind: got 'trace'; allowed: none, bernoulli, markov, gilbert-elliott, four-state",
    ),
    (
        {LOSS: {"kind": "scripted"}},
        f"{LOSS}: got neither of lost and pattern; allowed: exactly one of lost, pattern",
    ),
    (
        {LOSS: {"kind": "scripted", "lost": [1], "pattern": "01"}},
        f"{LOSS}: got both of lost and pattern; allowed: exactly one of lost, pattern",
    ),
    (
        {LOSS: {"kind": "scripted", "lost": []}},
        f'{LOSS}.lost: got []; allowed: a list of packet numbers and ranges, such as [3, 4, "10-12"]',
    ),
    (
        {LOSS: {"kind": "scripted", "lost": [3, "12-10"]}},
        f"{LOSS}.lost[1]: got '12-10'; allowed: a number from 0, or a range such as \"10-12\"",
    ),
    (
        {LOSS: {"kind": "scripted", "lost": [-1]}},
        f'{LOSS}.lost[0]: got -1; allowed: a number from 0, or a range such as "10-12"',
    ),
    ({LOSS: {"kind": "scripted", "pattern": "1 0"}}, f"{LOSS}.pattern: got '1 0'; allowed: a text of 0 and 1"),
    (
        {"links.ack.loss": {"kind": "bernoulli", "arrival": 0.5}},
        "links.ack.loss: got kind 'bernoulli' with mode 'none'; allowed: only with mode 'link'",
    ),
    (
        {"links.ack.mode": "perfekt"},
        "links.ack.mode: got 'perfekt'; allowed: none, perfect, link; did you mean 'perfect'?",
    ),
    # the system
    ({"system": ABSENT}, "system: missing; needed: The system"),
    ({"system.C": ABSENT}, "system.C: missing; needed: Measurement, p x n"),
    ({"system": 3}, "system: got 3; allowed: a table"),
    ({"system.A": 1.0}, "system.A: got 1.0; allowed: nested arrays, one list for each row, such as [[1.0]]"),
    (
        {"system.B": [1.0, 2.0]},
        "system.B: got [1.0, 2.0]; allowed: nested arrays, one list for each row, "
        "such as [[1.0], [2.0]] (a column) or [[1.0, 2.0]] (a row)",
    ),
    ({"system.A": []}, "system.A: got []; allowed: nested arrays, one list for each row"),
    ({"system.A": [[1, 0], [0]]}, "system.A[1]: got 1 number; allowed: 2 numbers, as in row 0"),
    ({"system.A": [[1, 0], [0, INF]]}, "system.A[1][1]: got inf; allowed: a finite number"),
    ({"system.A": [[1, 0], [0, "1"]]}, "system.A[1][1]: got '1'; allowed: a finite number"),
    ({"system.A": [[1, 0]]}, "system.A: got 1 × 2; allowed: a square matrix"),
    ({"system.B": [[1]]}, "system.B: got 1 × 1; allowed: 2 rows, as A is 2 × 2"),
    ({"system.G": [[1]]}, "system.G: got 1 × 1; allowed: 2 rows, as A is 2 × 2"),
    ({"system.C": [[1]]}, "system.C: got 1 × 1; allowed: 2 columns, as A is 2 × 2"),
    ({"system.Q": [[1]]}, "system.Q: got 1 × 1; allowed: 2 × 2, from the size of A"),
    ({"system.G": [[1], [1]]}, "system.Q: got 2 × 2; allowed: 1 × 1, from the number of columns of G"),
    ({"system.R": [[1, 0], [0, 1]]}, "system.R: got 2 × 2; allowed: 1 × 1, from the number of rows of C"),
    ({"system.x0_mean": 1}, "system.x0_mean: got 1; allowed: a list of numbers, such as [1]"),
    ({"system.x0_mean": [1]}, "system.x0_mean: got 1 number; allowed: 2, the size of A"),
    ({"system.P0": [[1]]}, "system.P0: got 1 × 1; allowed: 2 × 2, from the size of A"),
    (
        {"system.Q": [[1, 0.2], [0.1, 1]]},
        "system.Q: Q is not symmetric: got 0.2 at [0][1] and 0.1 at [1][0]",
    ),
    (
        {"system.Q": [[1, 2], [2, 1]]},
        "system.Q: Q is not positive semi-definite: its smallest eigenvalue is -1",
    ),
    (
        {"system.P0": [[1, 0], [0, -0.25]]},
        "system.P0: P0 is not positive semi-definite: its smallest eigenvalue is -0.25",
    ),
    ({"system.R": [[0]]}, "system.R: R is not positive definite: its smallest eigenvalue is 0"),
    ({"actuator.on_loss": "hol"}, "actuator.on_loss: got 'hol'; allowed: zero, hold; did you mean 'hold'?"),
    ({"actuator.onloss": "hold"}, "actuator: unknown key 'onloss'; did you mean 'on_loss'?"),
    (
        {"system.B": ABSENT, "actuator": {"on_loss": "hold"}},
        "actuator.on_loss: got 'hold', but system.B is not given; allowed: zero, or hold with system.B",
    ),
    # the input
    (
        {"system.B": ABSENT, "input": {"kind": "constant", "value": [1]}},
        "input: got kind 'constant', but system.B is not given; allowed: [input] only with system.B",
    ),
    (
        {"input": {"kind": "exp"}},
        "input.kind: got 'exp'; allowed: constant, exponential, sine, uniform, table, feedback, lqg, pid, python; "
        "did you mean 'exponential'?",
    ),
    (
        {"input": {"kind": "exponential"}},
        "input.tau: missing; needed: Steps in which it decays by the factor e, more than 0: a number, or q",
    ),
    ({"input": {"kind": "exponential", "tau": 0}}, "input.tau: got 0.0; allowed: more than 0"),
    ({"input": {"kind": "sine", "period": [-1]}}, "input.period: got [-1.0]; allowed: more than 0"),
    (
        {"input": {"kind": "sine", "period": "4"}},
        "input.period: got '4'; allowed: a number, or a list of numbers, one for each input channel",
    ),
    (
        {"input": {"kind": "constant", "value": [1, 2]}},
        "input.value: got 2 numbers; allowed: 1, the number of columns of system.B",
    ),
    (
        {"input": {"kind": "sine", "period": 4, "phase": [1, 2]}},
        "input.phase: got 2 numbers; allowed: 1, the number of columns of system.B",
    ),
    (
        {"input": {"kind": "uniform", "low": 2, "high": 1}},
        "input.high: got 1.0; allowed: not less than low, which is 2.0",
    ),
    (
        {"input": {"kind": "table"}},
        "input: got neither of file and values; allowed: exactly one of file, values",
    ),
    (
        {"input": {"kind": "table", "file": "u.csv", "values": [[1]]}},
        "input: got both of file and values; allowed: exactly one of file, values",
    ),
    ({"input": {"kind": "table", "file": 3}}, "input.file: got 3; allowed: the path of a CSV file"),
    (
        {"input": {"kind": "table", "values": [[1]]}},
        "input.values: got 1 row; allowed: at least 100, one for each step",
    ),
    (
        {"input": {"kind": "table", "values": [[1, 2]] * 100}},
        "input.values: got 2 numbers a row; allowed: 1, the number of columns of system.B",
    ),
    (
        {"input": {"kind": "feedback", "gain": [[1, 1], [1, 1]]}},
        "input.gain: got 2 rows; allowed: 1, the number of columns of system.B",
    ),
    ({"input": {"kind": "feedback", "gain": [[1]]}}, "input.gain: got 1 × 1; allowed: 1 × 2"),
    (
        {"input": {"kind": "feedback", "gain": [[1, 1]], "estimator": "aoo"}, "estimators": [{"name": "aoe"}]},
        "input.estimator: got 'aoo'; allowed: aoe; did you mean 'aoe'?",
    ),
    (
        {"input": {"kind": "feedback", "gain": [[1, 1]]}, "estimators": []},
        "input.estimator: got no [[estimators]]; allowed: feedback only through an estimator of the scenario",
    ),
    (
        {"input": {"kind": "feedback", "gain": [[1, 1]]}, "estimators": [{"name": "oe", "until": 24}]},
        "input.estimator: got 'oe', which ends at step 24; allowed: one that runs to step 100",
    ),
    # the controllers
    (
        {"input": {"kind": "feedback", "gain": [[1, 1]], "reference": [1]}},
        "input.reference: got 1 number; allowed: 2, the size of A",
    ),
    (
        {"input": {"kind": "feedback", "gain": [[1, 1]], "low": [0, 0]}},
        "input.low: got 2 numbers; allowed: 1, the number of columns of system.B",
    ),
    (
        {"input": {"kind": "feedback", "gain": [[1, 1]], "low": 1, "high": [0.5]}},
        "input.high: got [0.5]; allowed: not less than low, which is 1.0",
    ),
    (
        {"input": {"kind": "lqg", "Qx": [[1]], "Ru": [[1]]}},
        "input.Qx: got 1 × 1; allowed: 2 × 2, from the size of A",
    ),
    (
        {"input": {"kind": "lqg", "Qx": [[1, 2], [2, 1]], "Ru": [[1]]}},
        "input.Qx: Qx is not positive semi-definite: its smallest eigenvalue is -1",
    ),
    (
        {"input": {"kind": "lqg", "Qx": [[1, 0], [0, 1]], "Ru": [[0]]}},
        "input.Ru: Ru is not positive definite: its smallest eigenvalue is 0",
    ),
    (
        {"input": {"kind": "lqg", "Qx": [[1, 0], [0, 1]], "Ru": [[1]], "terminal": [[1, 0], [0, 1]]}},
        "input.terminal: got a weight of the last state with horizon 'stationary'; allowed: only with horizon 'run'",
    ),
    (
        {"input": {"kind": "lqg", "Qx": [[1, 0], [0, 1]], "Ru": [[1]], "horizon": "ran"}},
        "input.horizon: got 'ran'; allowed: stationary, run; did you mean 'run'?",
    ),
    (
        {"input": {"kind": "lqg", "Qx": [[1, 0], [0, 1]], "Ru": [[1]]}, "estimators": []},
        "input.estimator: got no [[estimators]]; allowed: lqg only through an estimator of the scenario",
    ),
    (
        {"input": {"kind": "pid", "kp": 1, "output": [[1]]}},
        "input.output: got 1 × 1; allowed: 1 × 2, an output for each input channel",
    ),
    (
        {"input": {"kind": "pid", "kp": 1, "filter": -1, "output": [[1, 0]]}},
        "input.filter: got -1.0; allowed: 0 or more",
    ),
    (
        {"input": {"kind": "pid", "kp": 1, "tracking": 0.5, "output": [[1, 0]]}},
        "input.tracking: got 0.5; allowed: 1 or more",
    ),
    (
        {"input": {"kind": "pid", "Kp": 1}},
        "input: unknown key 'Kp'; did you mean 'kp'?",
    ),
    (
        {"input": {"kind": "python", "controller": "a:B", "options": {"x": NAN}}},
        "input.options.x: got nan; allowed: true or false, a finite number, a text, a list or a table",
    ),
    # the cost
    (
        {"cost": {"Ru": [[1]]}},
        "cost.Qx: missing; needed: Weight of the state, n x n, symmetric, positive semi-definite",
    ),
    (
        {"cost": {"Qx": [[1, 0], [1, 1]]}},
        "cost.Qx: Qx is not symmetric: got 0.0 at [0][1] and 1.0 at [1][0]",
    ),
    (
        {"cost": {"Qx": [[1, 0], [0, 1]], "reference": [1, 2, 3]}},
        "cost.reference: got 3 numbers; allowed: 2, the size of A",
    ),
    (
        {"system.B": ABSENT, "cost": {"Qx": [[1, 0], [0, 1]], "Ru": [[1]]}},
        "cost.Ru: got a weight of the input, but system.B is not given; allowed: nothing",
    ),
    # the estimators
    ({"estimators": {"name": "oe"}}, "estimators: got a table; allowed: an array of tables, [[estimators]]"),
    ({"estimators": ["oe"]}, "estimators[0]: got 'oe'; allowed: an array of tables, [[estimators]]"),
    ({"estimators": [{"kind": "oe"}]}, "estimators[0].name: missing; needed: Name in the results; unique"),
    (
        {"estimators": [{"name": "oe"}, {"name": "OE"}]},
        "estimators[1].name: got 'OE'; allowed: 1 to 32 of a-z, 0-9, _ and -, a letter first",
    ),
    (
        {"estimators": [{"name": "oe"}, {"name": "oe"}]},
        "estimators[1].name: got 'oe' a second time; allowed: a name of its own",
    ),
    ({"estimators": [{"name": "oe", "acks": "link"}]}, "estimators[0].acks: got 'link'; allowed: none, perfect"),
    ({"estimators": [{"name": "oe", "until": 0}]}, "estimators[0].until: got 0; allowed: an integer, 1 … 2147483647"),
    (
        {"estimators": [{"name": "oe", "until": 101}]},
        "estimators[0].until: got 101; allowed: 1 … 100, the steps of the scenario",
    ),
    (
        {"estimators": [{"name": "oe", "a": {"b": [1, NAN]}}]},
        "estimators[0].a.b[1]: got nan; allowed: true or false, a finite number, a text, a list or a table",
    ),
    ({"estimators": [{"name": "oe", "a": 2**63}]}, f"estimators[0].a: got {2**63}; allowed: an integer of 64 bits"),
    (
        {"estimators": [{"name": "oe", "options": 3}]},
        "estimators[0].options: got 3; allowed: a table, or its keys beside name, kind, acks, until, buffer",
    ),
    (
        {"estimators": [{"name": "oe", "options": {"kind": 3}}]},
        "estimators[0].options: got the reserved key 'kind'; allowed: any key but name, kind, acks, until, buffer, "
        "options",
    ),
    # the rest
    ({"seed": 2**63}, f"seed: got {2**63}; allowed: an integer, 0 … {2**63 - 1}"),
    ({"seed": 1.5}, f"seed: got 1.5; allowed: an integer, 0 … {2**63 - 1}"),
    ({"lanes": True}, "lanes: got true; allowed: an integer, 1 … 2147483647"),
    ({"steps": "10"}, "steps: got '10'; allowed: an integer, 1 … 2147483647"),
    ({"record": "frist"}, "record: got 'frist'; allowed: first, all, none; did you mean 'first'?"),
    ({"bounds": 1}, "bounds: got 1; allowed: true or false"),
    ({"name": "a\nb"}, "name: got 'a\\nb'; allowed: a text of 1 to 128 characters, on one line"),
    ({"clock.mode": "virtul"}, "clock.mode: got 'virtul'; allowed: virtual, real; did you mean 'virtual'?"),
    ({"clock.window": 0}, "clock.window: got 0; allowed: an integer, 1 … 2147483647"),
    (
        {"clock.period": "10 sec"},
        "clock.period: got '10 sec'; allowed: a duration with a unit (ns, us, ms, s, min), such as '10 ms'",
    ),
    (
        {"transport.deadline": "0.1 ns"},
        "transport.deadline: got '0.1 ns'; allowed: a whole number of nanoseconds, 1 … 2**63 - 1",
    ),
    (
        {"transport.endpoint": "tcp/localhost:70000"},
        "transport.endpoint: got 'tcp/localhost:70000'; allowed: tcp/HOST:PORT or tls/HOST:PORT, PORT 1 … 65535",
    ),
    (
        {"transport.endpoint": "tls/localhost:7447"},
        "transport.endpoint: got 'tls/localhost:7447'; allowed: tls/… with [transport.tls], tcp/… without",
    ),
    ({"transport.lanes_per_packet": 0}, "transport.lanes_per_packet: got 0; allowed: an integer, 1 … 2147483647"),
    ({"transport.user": "a"}, "transport.user: got only user; allowed: user and password_env, both or neither"),
    ({"transport.password": "a"}, "transport: unknown key 'password'; did you mean 'password_env'?"),
    (
        {"transport.tls": {"ca": "a", "certificate": "b", "key": "c", "client_key": "d"}},
        "transport.tls.client_key: got client_key without client_certificate; allowed: both or neither",
    ),
]


@pytest.mark.parametrize(("changes", "expected"), EXACT, ids=[text[:60] for _, text in EXACT])
def test_wrong_value(changes: dict[str, Any], expected: str) -> None:
    assert message(changed(changes)) == expected


def test_an_unknown_key_like_no_other_lists_what_is_allowed() -> None:
    assert message(changed({"zzz": 1})) == (
        "unknown key 'zzz'; allowed: name, steps, lanes, seed, record, bounds, clock, system, uncertainty, "
        "estimators, actuator, input, cost, links, transport, recovery, events"
    )


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("steps = \n", "(at line 1, column 9)"),
        ("steps = 1\nsteps = 2\n", "(at line 2, column 10)"),
        ("steps", "not valid TOML: "),
        ("steps = " + "9" * 5000, "not valid TOML: "),
        ("steps = 0x" + "f" * 5000, "got a value too long to show"),
        ("steps = " + "[" * 9999, "nested too deeply"),
        ('"a\\u001b\\nb" = 1', "unknown key 'a\\x1b\\nb'"),
    ],
)
def test_wrong_text(text: str, expected: str) -> None:
    assert expected in message(text)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"1\nx\n", "line 2: got 'x'; allowed: a finite number"),
        (b"nan\n", "line 1: got 'nan'; allowed: a finite number"),
        (b"u\n1\n\n2,3\n", "line 4: got 2 numbers; allowed: 1, as in the first row"),
        (b"1,\n", "line 1: got ''; allowed: a finite number"),
        (b"# nothing\n", "no rows; allowed: a row of numbers for each step"),
        (b"\xff", "not UTF-8 text (byte 0)"),
    ],
)
def test_wrong_table(tmp_path: Path, content: bytes, expected: str) -> None:
    (tmp_path / "u.csv").write_bytes(content)
    table = changed({"input": {"kind": "table", "file": "u.csv"}})
    assert message(table, tmp_path) == f"input.file: u.csv: {expected}"


anything = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.dates(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=6,
)


def places(table: Any) -> list[tuple[Any, Any]]:
    """Every (table or list, key or index) below `table`."""
    keys: list[Any] = []
    if isinstance(table, (dict, list)):
        keys = list(table) if isinstance(table, dict) else list(range(len(table)))
    return [(table, key) for key in keys] + [place for key in keys for place in places(table[key])]


@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(scenarios(), st.data())
def test_whatever_is_wrong_is_said_in_one_line(table: dict[str, Any], data: st.DataObject) -> None:
    place, key = data.draw(st.sampled_from(places(table)))
    change = data.draw(st.sampled_from(["replace", "remove", "rename"]))
    if change == "rename" and isinstance(place, dict):
        place[data.draw(st.text())] = place.pop(key)
    elif change == "remove":
        del place[key]
    else:
        place[key] = data.draw(anything)
    text = f"{SOURCE}: "
    try:
        scenario = parse_scenario(table, "/nowhere", source=SOURCE)
    except UsageError as error:
        text = str(error)
    else:
        assert parse_scenario(to_toml(scenario)) == scenario
    assert text.startswith(f"{SOURCE}: ")
    assert len(text.splitlines()) == 1
    assert text.isprintable()


def test_missing_table(tmp_path: Path) -> None:
    table = changed({"input": {"kind": "table", "file": "u.csv"}})
    assert message(table, tmp_path) == "input.file: u.csv: no such file"


def file_message(path: Path | str) -> str:
    with pytest.raises(UsageError) as caught:
        load_scenario(path)
    assert len(str(caught.value).splitlines()) == 1
    return str(caught.value)


def test_wrong_file(tmp_path: Path) -> None:
    assert file_message(tmp_path / "none.toml") == f"{tmp_path}/none.toml: no such file"
    assert file_message(tmp_path) == f"{tmp_path}: not a file"
    (tmp_path / "bad.toml").write_bytes(b"name = '\xff'")
    assert file_message(tmp_path / "bad.toml") == f"{tmp_path}/bad.toml: not UTF-8 text (byte 8)"
    assert "cannot be read" in file_message(f"{tmp_path}/\0")
    assert file_message(f"{tmp_path}/a\nb") == f"{tmp_path}/a b: no such file"


@pytest.mark.skipif(os.geteuid() == 0, reason="root reads every file")
def test_unreadable_file(tmp_path: Path) -> None:
    file = tmp_path / "secret.toml"
    file.touch(mode=0)
    assert file_message(file) == f"{file}: cannot be read: Permission denied"


def test_errors_of_a_file_name_it(tmp_path: Path) -> None:
    file = tmp_path / "scenario.toml"
    file.write_text("lane = 2\n")
    assert file_message(file) == f"{file}: unknown key 'lane'; did you mean 'lanes'?"


def test_exit_codes() -> None:
    assert (TestbedError.exit_code, UsageError.exit_code, RunFailed.exit_code) == (1, 2, 1)


@pytest.mark.parametrize(
    ("word", "expected"),
    [("lane", "lanes"), ("STEPS", "steps"), ("st", "steps"), ("s", None), ("zzz", None), ("", None)],
)
def test_nearest(word: str, expected: str | None) -> None:
    assert nearest(word, ["steps", "lanes", "seed"]) == expected


def test_did_you_mean() -> None:
    assert did_you_mean("lane", ["steps", "lanes"]) == "; did you mean 'lanes'?"
    assert did_you_mean("zzz", ["steps", "lanes"]) == ""
