"""Conditions: their text, their logic against the definition over whole histories, their errors."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from testbed.errors import UsageError
from testbed.scenario.conditions import Condition, Names, StepFigures
from testbed.scenario.conditions.parser import AMONG_MAX, DEPTH_MAX
from testbed.scenario.conditions.syntax import (
    Arithmetic,
    Call,
    Compare,
    Figure,
    HeldSteps,
    HeldTime,
    Lanes,
    Logic,
    LossRate,
    Negative,
    Node,
    Not,
    Number,
    Numeric,
    Quantity,
    Span,
    Truth,
    text_of,
)

NAMES = Names(("aoe", "aoe-acks", "kfio", "max"), ("control", "observation"), period_ns=10_000_000)
LANES = 3


def of_traces(*steps: Sequence[float] | float | None, name: str = "aoe") -> list[StepFigures]:
    """tr P of an estimator along k, of every lane, or of all the same; None: it has none."""
    return [
        StepFigures({} if v is None else {name: {"trace_P": np.broadcast_to(np.array(v, dtype=float), LANES)}})
        for v in steps
    ]


def fires(text: str, steps: Sequence[StepFigures], first: int = 1) -> list[int]:
    """The steps at which a condition begins to hold."""
    condition = Condition.parse(text, NAMES)
    return [k for k, figures in enumerate(steps, first) if condition.update(k, figures)]


def test_it_fires_once_each_time_it_begins_to_hold() -> None:
    assert fires("trace_P(aoe) > 5", of_traces(6, 7, 5, 5.1, 4, 9)) == [1, 4, 6]


def test_the_mean_over_lanes_or_another_figure_of_them() -> None:
    steps = of_traces([1, 2, 9], [1, 1, 1], [5, 5, 5])
    assert fires("trace_P(aoe) == 4", steps) == [1]
    assert fires("trace_P(aoe, mean) == 4", steps) == [1]
    assert fires("trace_P(aoe, max) == 9", steps) == [1]
    assert fires("trace_P(aoe, min) == 1", steps) == [1]
    assert fires("any lane (trace_P(aoe) > 4)", steps) == [1, 3]
    assert fires("all lanes (trace_P(aoe) > 4)", steps) == [3]
    assert fires("any lane (trace_P(aoe) > 2 * trace_P(aoe, mean))", steps) == [1]


def test_each_lane_has_its_own_count() -> None:
    steps = of_traces([9, 0, 0], [0, 9, 0], [0, 9, 0], [9, 0, 9])
    assert fires("any lane (trace_P(aoe) > 5) for 3 steps", steps) == [3]
    assert fires("any lane (trace_P(aoe) > 5 for 2 steps)", steps) == [3]
    assert fires("any lane (trace_P(aoe) > 5 for 3 steps)", steps) == []
    assert fires("any lane (trace_P(aoe) > 5 for at least 2 of 4 steps)", steps) == [3]
    assert fires("all lanes (trace_P(aoe) > 5 for at least 1 of 3 steps)", [*steps, *steps]) == [4, 8]
    assert fires("all lanes (trace_P(aoe) > 5 for at least 1 of 4 steps)", [StepFigures(), *steps]) == [5]


def test_error_nees_step_and_time() -> None:
    figures = StepFigures({"kfio": {"squared_error": np.array([1.0, 3.0]), "nees": np.array([4.0, 6.0])}})
    assert fires("error(kfio) == 2 and nees(kfio) == 5", [figures]) == [1]
    nothing = [StepFigures()] * 20
    assert fires("step == 7", nothing) == [7]
    assert fires("step == 7", nothing, first=5) == [7]
    assert fires("time >= 70 ms", nothing) == [7]
    assert fires('time >= "0.07 s"', nothing) == [7]
    assert fires("step - 3 == 4 and abs(3 - step) == 4", nothing) == [7]
    assert fires("max(step, 5) - min(step, 5, 2) < 4", nothing) == [2]
    assert fires("-step + 2 * 3 == -1", nothing) == [7]
    assert fires("step / 2 == 3.5", nothing) == [7]


def test_what_has_no_value_neither_holds_nor_fails() -> None:
    steps = of_traces(None, 9, math.nan, [math.nan, 9, 9], 1, math.inf)
    assert fires("trace_P(aoe) > 5", steps) == [2, 4]  # the mean of no finite value has none
    assert fires("trace_P(aoe, max) > 5", steps) == [2, 4, 6]
    assert fires("not trace_P(aoe) > 5", steps) == [5]
    assert fires("trace_P(aoe) > 5 or step == 1", steps) == [1, 4]
    assert fires("not (trace_P(aoe) > 5 and step == 1)", steps) == [2]
    assert fires("all lanes (trace_P(aoe) > 5)", steps) == [2, 6]
    assert fires("trace_P(aoe) > 5 for 2 steps", steps) == []
    assert fires("step / 0 > 1 or step / 0 <= 1", steps) == []


def test_a_name_with_a_hyphen_is_no_difference() -> None:
    assert fires("trace_P(aoe-acks) > 5", of_traces(6, name="aoe-acks")) == [1]
    assert fires("trace_P( max , max ) > 5", of_traces([1, 6, 1], name="max")) == [1]
    condition = Condition.parse("trace_P(aoe)-error(kfio) > 1 or loss_rate(control) > 0.5", NAMES)
    assert condition.estimators == {("aoe", "trace_P"), ("kfio", "squared_error")}
    assert condition.links == {"control"}


def test_loss_rate_over_all_or_the_last_steps() -> None:
    lost = [0, 3, 3, 0, 0, 3]
    steps = [StepFigures(links={"control": (4, count)}) for count in lost]
    assert fires("loss_rate(control) >= 0.5", steps) == [3]  # 0, 3/8, 6/12, 6/16, …
    assert fires("loss_rate(control, last 2 steps) >= 0.75", steps) == [3]
    assert fires("loss_rate(control, last 1 step) == 0", steps) == [1, 4]
    assert fires("loss_rate(observation) >= 0", steps) == []


TRUTHS = st.lists(st.sampled_from([True, False, None]), max_size=30)


def as_steps(truths: list[bool | None]) -> list[StepFigures]:
    return of_traces(*({True: 9.0, False: 1.0, None: None}[truth] for truth in truths))


def rising(holds: list[bool]) -> list[int]:
    return [k for k, now in enumerate(holds, 1) if now and not (k > 1 and holds[k - 2])]


@given(TRUTHS, st.integers(1, 5), st.integers(0, 4))
def test_held_steps_by_definition(truths: list[bool | None], need: int, more: int) -> None:
    among = need + more
    counts = [sum(truth is True for truth in truths[max(0, k - among) : k]) for k in range(1, len(truths) + 1)]
    expected = rising([count >= need for count in counts])
    assert fires(f"trace_P(aoe) > 5 for at least {need} of {among} steps", as_steps(truths)) == expected
    lanes = f"any lane (trace_P(aoe) > 5 for at least {need} of {among} steps)"
    assert fires(lanes, as_steps(truths)) == expected
    run = rising([k >= need and all(t is True for t in truths[k - need : k]) for k in range(1, len(truths) + 1)])
    assert fires(f"trace_P(aoe) > 5 for {need} steps", as_steps(truths)) == run


@pytest.mark.parametrize(("span", "steps"), [("10 ms", 1), ("11 ms", 2), ("20 ms", 2), ("1 ns", 1), ("0.1 s", 10)])
def test_a_duration_is_the_steps_that_fill_it(span: str, steps: int) -> None:
    for written in (span, f'"{span}"', f"'{span}'"):
        assert fires(f"trace_P(aoe) > 5 for {written}", of_traces(*[9] * 12)) == [steps]


def test_steps_are_told_in_order() -> None:
    condition = Condition.parse("step > 0", NAMES)
    condition.update(4, StepFigures())
    for k in (4, 6, 3):
        with pytest.raises(ValueError, match=f"step {k} after step 4"):
            condition.update(k, StepFigures())


def test_memory_is_bounded() -> None:
    import tracemalloc

    text = f"any lane (trace_P(aoe) > 5 for at least 2 of {AMONG_MAX} steps) or loss_rate(control, last 50 steps) > 2"
    condition, k = Condition.parse(text, NAMES), 0
    figures = StepFigures({"aoe": {"trace_P": np.ones(100)}}, {"control": (100, 3)})

    def go(steps: int) -> int:
        nonlocal k
        for _ in range(steps):
            k += 1
            condition.update(k, figures)
        return tracemalloc.get_traced_memory()[0]

    tracemalloc.start()
    try:
        early = go(200)
        assert go(2000) < early + 20_000
    finally:
        tracemalloc.stop()


# The text of a condition, and back.

NUMBERS: st.SearchStrategy[Numeric] = st.one_of(
    st.builds(Number, st.one_of(st.integers(0, 10**6).map(float), st.floats(0, 1e300))),
    st.builds(Span, st.integers(0, 2**50)),
    st.builds(Quantity, st.sampled_from(["step", "time"])),
    st.builds(
        Figure,
        st.sampled_from(["trace_P", "error", "nees"]),
        st.sampled_from(NAMES.estimators),
        st.sampled_from([None, "mean", "max", "min"]),
    ),
    st.builds(LossRate, st.sampled_from(NAMES.links), st.one_of(st.none(), st.integers(1, 10_000))),
)


def _larger_numbers(inner: st.SearchStrategy[Numeric]) -> st.SearchStrategy[Numeric]:
    return st.one_of(
        st.builds(Negative, inner),
        st.builds(Arithmetic, st.sampled_from("+-*/"), inner, inner),
        st.builds(Call, st.just("abs"), st.tuples(inner)),
        st.builds(Call, st.sampled_from(["min", "max"]), st.lists(inner, min_size=2, max_size=3).map(tuple)),
    )


NUMERIC = st.recursive(NUMBERS, _larger_numbers, max_leaves=5)
COMPARISON: st.SearchStrategy[Truth] = st.builds(
    Compare, st.sampled_from(["<", "<=", ">", ">=", "==", "!="]), NUMERIC, NUMERIC
)


def _held(inner: st.SearchStrategy[Truth]) -> st.SearchStrategy[Truth]:
    some = st.integers(1, 100).flatmap(lambda among: st.tuples(st.integers(1, among), st.just(among)))
    return st.one_of(
        st.builds(Not, inner),
        st.builds(Logic, st.sampled_from(["and", "or"]), inner, inner),
        st.builds(lambda of, counts: HeldSteps(of, *counts), inner, some),
        st.builds(lambda of, steps: HeldSteps(of, steps, steps), inner, st.integers(1, 10**6)),
        st.builds(HeldTime, inner, st.integers(1, 2**50)),
    )


PER_LANE = st.recursive(COMPARISON, _held, max_leaves=3)
CONDITIONS = st.recursive(
    st.one_of(COMPARISON, st.builds(Lanes, st.sampled_from(["any", "all"]), PER_LANE)), _held, max_leaves=4
)


@settings(max_examples=200, deadline=None)
@given(CONDITIONS)
def test_the_text_of_a_condition_parses_to_it(parts: Truth) -> None:
    text = text_of(parts)
    if len(text) <= 1000:
        condition = Condition.parse(text, NAMES)
        assert condition.parts == parts
        assert str(condition) == text


@given(CONDITIONS, st.data())
def test_spaces_and_superfluous_parentheses_change_nothing(parts: Truth, data: st.DataObject) -> None:
    text = text_of(parts)
    if len(text) <= 300:
        gap = data.draw(st.sampled_from([" ", "  ", "\n", "\t "]))
        assert Condition.parse(f"{gap}(({text.replace(' ', gap)})){gap}", NAMES).parts == parts


def refusal(text: str) -> str | None:
    try:
        Condition.parse(text, NAMES)
    except UsageError as error:
        return str(error)
    return None


WORDS = [
    "trace_P",
    "(",
    ")",
    "aoe",
    "for",
    "3",
    "steps",
    "of",
    "at",
    "least",
    "any",
    "lane",
    "and",
    "not",
    ">",
    "-",
    ",",
]


@settings(deadline=None)
@given(st.one_of(st.text(max_size=40), st.lists(st.sampled_from(WORDS), max_size=12).map(" ".join)))
@example("\x1f")
def test_any_text_is_a_condition_or_refused_in_one_line(text: str) -> None:
    refused = refusal(text)
    assert refused is None or re.fullmatch("got .*; allowed: .*", refused)


PLAIN = st.recursive(
    st.one_of(st.builds(Number, st.integers(0, 9).map(float)), st.just(Quantity("step"))),
    lambda inner: st.one_of(
        st.builds(Negative, inner),
        st.builds(Arithmetic, st.sampled_from("+-*"), inner, inner),
        st.builds(Call, st.sampled_from(["min", "max"]), st.tuples(inner, inner)),
        st.builds(Call, st.just("abs"), st.tuples(inner)),
    ),
    max_leaves=6,
)
LOGIC = st.recursive(
    st.builds(Compare, st.sampled_from(["<", "<=", ">", ">=", "==", "!="]), PLAIN, PLAIN),
    lambda inner: st.one_of(st.builds(Not, inner), st.builds(Logic, st.sampled_from(["and", "or"]), inner, inner)),
    max_leaves=4,
)


@given(LOGIC, st.integers(1, 9))
def test_without_figures_it_is_what_python_makes_of_the_same_text(parts: Truth, k: int) -> None:
    """`and`, `or`, `not`, comparisons and arithmetic bind as in Python."""
    text = text_of(parts)
    expected = eval(text, {"__builtins__": {}}, {"step": k, "abs": abs, "min": min, "max": max})
    assert (fires(text, [StepFigures()], first=k) == [k]) is bool(expected)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "got an empty text; allowed: a condition, such as trace_P(NAME) > 500"),
        ("trace_Q(aoe) > 5", "got 'trace_Q' at character 1; allowed: trace_P, error, nees, loss_rate, step, time, abs"),
        ("trace_Q(aoe) > 5", "; did you mean 'trace_P'?"),
        ("trace_P(aeo) > 5", "got 'aeo' at character 9 for the estimator; allowed: aoe, aoe-acks, kfio, max; did you"),
        ("loss_rate(ack) > 5", "got 'ack' at character 11 for the link; allowed: control, observation"),
        ("trace_P() > 5", "got ')' at character 9 for the estimator; allowed: aoe"),
        ("trace_P(aoe, median) > 5", "got 'median' at character 14; allowed: mean, max, min"),
        ("trace_P aoe > 5", "got 'aoe' at character 9; allowed: '('"),
        (
            "trace_P(aoe) = 5",
            "got '=' at character 14; allowed: a figure, a number, an operator or a parenthesis; did you mean '=='?",
        ),
        ("trace_P(aoe) > 5 && step > 2", "did you mean 'and'?"),
        ("trace_P(aoe)", "got a number at character 1; allowed: a condition"),
        ("step > 1 + (step > 2)", "got a condition at character 12; allowed: a number or a figure"),
        ("step > 1 and 5", "got a number at character 14; allowed: a condition"),
        ("not step", "got a number at character 5; allowed: a condition"),
        ("1 < step < 5", "got '<' at character 10; allowed: one comparison, and with a second one"),
        ("step > 1 step", "got 'step' at character 10; allowed: and, or, for, an operator, the end"),
        ("step > ", "got the end; allowed: trace_P"),
        ("(step > 1", "got the end; allowed: ')'"),
        ("step > 1 for 10", "got the end; allowed: steps, step, ns, us, ms, s, min"),
        (
            "step > 1 for 10 stpes",
            "got 'stpes' at character 17; allowed: steps, step, ns, us, ms, s, min; did you mean 'steps'?",
        ),
        ("step > 1 for 0 steps", "got '0' at character 14; allowed: a whole number, 1 … 2147483647"),
        ("step > 1 for 1.5 steps", "got '1.5' at character 14; allowed: a whole number"),
        ("step > 1 for 0 ms", "got '0 ms' at character 14; allowed: a whole number of nanoseconds"),
        ("step > 1 for '1 hour'", "got '1 hour' at character 14; allowed: a duration with a unit"),
        ("step > 1 for at least 5 of 4 steps", "got '5' at character 23; allowed: at most the 4 of 4 steps"),
        ("step > 1 for at most 5 of 4 steps", "got 'most' at character 17; allowed: least"),
        (f"step > 1 for at least 5 of {AMONG_MAX + 1} steps", f"allowed: a whole number, 1 … {AMONG_MAX}"),
        ("step > 1 for 3 steps for 2 steps", "got 'for' at character 22; allowed: and, or"),
        ("step for 3 steps", "got a number at character 1; allowed: a condition"),
        ("any lane (all lanes (nees(aoe) > 1))", "got 'all' at character 11; allowed: no lanes within lanes"),
        ("any lane (5)", "got a number at character 11; allowed: a condition"),
        ("abs(1, 2) > 1", "got 2 in abs() at character 1; allowed: 1 number"),
        ("max(1) > 1", "got 1 in max() at character 1; allowed: 2 numbers or more"),
        ("step > 1e999", "got '1e999' at character 8; allowed: a finite number"),
        ("__import__('os') > 1", "got '__import__' at character 1; allowed: trace_P"),
        ("step.__class__ > 1", "got '.' at character 5; allowed: a figure"),
        ('step > "5 ms', "got '\"' at character 8; allowed: a closing quote"),
        ("-" * (DEPTH_MAX + 1) + "1 > 2", f"got '-' at character 41, 41 levels deep; allowed: at most {DEPTH_MAX}"),
        ("(" * 500 + "1 > 2" + ")" * 490, "levels deep; allowed: at most"),
        ("not " * 200 + "1 > 2", "levels deep; allowed: at most"),
        ("1 > 2" + " " * 1000, "got 1005 characters; allowed: at most 1000"),
    ],
)
def test_errors_say_what_stands_where_and_what_may(text: str, expected: str) -> None:
    with pytest.raises(UsageError) as caught:
        Condition.parse(text, NAMES)
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


def test_without_estimators_there_is_nothing_to_name() -> None:
    with pytest.raises(UsageError, match="allowed: nothing: there is no link"):
        Condition.parse("loss_rate(control) > 1", Names((), (), 1))


def test_the_longest_chain_is_parsed() -> None:
    text = " and ".join(["1 < 2"] * 100)
    assert fires(text, [StepFigures()]) == [1]
    parts: Node = Condition.parse(text, NAMES).parts
    assert text_of(parts) == text
