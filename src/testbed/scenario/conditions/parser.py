"""From the text of a condition to its parts, by recursive descent.

Python's own parser would take neither `for 10 steps` nor durations nor `any lane`, and its errors are of Python.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Literal, NoReturn, cast, get_args

from pydantic_core import PydanticCustomError

from testbed.errors import UsageError, did_you_mean
from testbed.scenario.base import COUNT_MAX, shown
from testbed.scenario.conditions.figures import FIGURES, FUNCTIONS, LOSS_RATE, QUANTITIES, REDUCTIONS, Names
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
)
from testbed.scenario.conditions.tokens import Piece, Pieces
from testbed.scenario.durations import UNITS_NS, parse_duration

DEPTH_MAX = 40
AMONG_MAX = 1000
"""Steps of `at least N of M steps`: what holds at each is kept."""
LAST_MAX = 10_000
_COMPARISONS = ("<", "<=", ">", ">=", "==", "!=")
_STARTS = (*FIGURES, LOSS_RATE, *QUANTITIES, *FUNCTIONS, "any", "all", "not")
_EXAMPLE = "a condition, such as trace_P(NAME) > 500"


def parse(text: str, names: Names) -> Truth:
    """The condition that a text is. Raises UsageError, of one line: what stands where, and what may."""
    return _Parser(text, names).condition()


class _Parser:
    def __init__(self, text: str, names: Names) -> None:
        self._pieces, self._names = Pieces(text), names
        self._depth = 0
        self._in_lanes = False

    def condition(self) -> Truth:
        begin = self._pieces.next
        if begin.kind == "end":
            raise UsageError(f"got an empty text; allowed: {_EXAMPLE}")
        found = _truth(self._or(), begin)
        if self._pieces.next.kind != "end":
            _refuse(self._pieces.next, ["and", "or", "for", "an operator", "the end"])
        return found

    def _or(self) -> Node:
        return self._logic("or")

    def _logic(self, operator: Literal["or", "and"]) -> Node:
        def part() -> Node:
            return self._logic("and") if operator == "or" else self._not()

        begin = self._pieces.next
        left = part()
        while self._is(operator):
            self._pieces.take()
            after = self._pieces.next
            right = part()
            left = Logic(operator, _truth(left, begin), _truth(right, after))
        return left

    def _not(self) -> Node:
        if not self._is("not"):
            return self._held()
        begin = self._pieces.take()
        after = self._pieces.next
        self._deeper(begin)
        of = _truth(self._not(), after)
        self._depth -= 1
        return Not(of)

    def _held(self) -> Node:
        begin = self._pieces.next
        of = self._compare()
        if not self._is("for"):
            return of
        self._pieces.take()
        truth = _truth(of, begin)
        piece = self._pieces.next
        if self._is("at"):
            self._pieces.take()
            self._word("least")
            need_at = self._pieces.next
            need = self._whole(COUNT_MAX)
            self._word("of")
            among = self._whole(AMONG_MAX)
            self._word("steps", "step")
            if need > among:
                _refuse(need_at, [f"at most the {among} of {among} steps"])
            return HeldSteps(truth, need, among)
        if piece.kind == "quoted":
            return HeldTime(truth, _duration(self._pieces.take(), piece.text[1:-1], zero=False))
        number = self._pieces.take()
        if number.kind != "number":
            _refuse(number, ["a number of steps", "a duration", "at least N of M steps"])
        if self._pieces.next.text in UNITS_NS:
            return HeldTime(truth, _duration(number, f"{number.text} {self._pieces.take().text}", zero=False))
        steps = _whole(number, COUNT_MAX)
        self._word("steps", "step", *UNITS_NS)
        return HeldSteps(truth, steps, steps)

    def _compare(self) -> Node:
        begin = self._pieces.next
        left = self._sum()
        if self._pieces.next.text not in _COMPARISONS:
            return left
        operator = self._pieces.take().text
        after = self._pieces.next
        right = self._sum()
        if self._pieces.next.text in _COMPARISONS:
            _refuse(self._pieces.next, ["one comparison", "and with a second one"])
        return Compare(operator, _number(left, begin), _number(right, after))

    def _sum(self) -> Node:
        return self._arithmetic("+-")

    def _arithmetic(self, operators: str) -> Node:
        def part() -> Node:
            return self._arithmetic("*/") if operators == "+-" else self._unary()

        begin = self._pieces.next
        left = part()
        while self._pieces.next.kind == "sign" and self._pieces.next.text in operators:
            operator = self._pieces.take().text
            after = self._pieces.next
            left = Arithmetic(operator, _number(left, begin), _number(part(), after))
        return left

    def _unary(self) -> Node:
        if self._pieces.next.text != "-":
            return self._atom()
        self._deeper(self._pieces.take())
        after = self._pieces.next
        of = _number(self._unary(), after)
        self._depth -= 1
        return Negative(of)

    def _atom(self) -> Node:
        piece = self._pieces.take()
        if piece.kind == "number":
            if self._pieces.next.text in UNITS_NS:
                return Span(_duration(piece, f"{piece.text} {self._pieces.take().text}", zero=True))
            value = float(piece.text)
            if not math.isfinite(value):
                _refuse(piece, ["a finite number"])
            return Number(value)
        if piece.kind == "quoted":
            return Span(_duration(piece, piece.text[1:-1], zero=True))
        if piece.text == "(":
            return self._inner(piece)
        if piece.kind != "word":
            _refuse(piece, _STARTS)
        if piece.text in QUANTITIES:
            return Quantity(piece.text)
        if piece.text in FIGURES:
            return self._figure(piece)
        if piece.text == LOSS_RATE:
            return self._loss_rate()
        if piece.text in FUNCTIONS:
            return self._call(piece)
        if piece.text not in ("any", "all"):
            _refuse(piece, _STARTS)
        return self._lanes(piece)

    def _inner(self, opening: Piece) -> Node:
        """What stands in parentheses, of which the first is taken."""
        self._deeper(opening)
        found = self._or()
        self._sign(")")
        self._depth -= 1
        return found

    def _figure(self, piece: Piece) -> Figure:
        self._sign("(")
        estimator = self._known(self._names.estimators, "estimator")
        over = None
        if self._pieces.next.text == ",":
            self._pieces.take()
            over = self._word(*REDUCTIONS)
        self._sign(")")
        return Figure(piece.text, estimator, over)

    def _loss_rate(self) -> LossRate:
        self._sign("(")
        link = self._known(self._names.links, "link")
        last = None
        if self._pieces.next.text == ",":
            self._pieces.take()
            self._word("last")
            last = self._whole(LAST_MAX)
            self._word("steps", "step")
        self._sign(")")
        return LossRate(link, last)

    def _call(self, piece: Piece) -> Call:
        self._deeper(piece)
        self._sign("(")
        arguments: list[Numeric] = []
        while True:
            begin = self._pieces.next
            arguments.append(_number(self._sum(), begin))
            if self._pieces.next.text != ",":
                break
            self._pieces.take()
        self._sign(")")
        self._depth -= 1
        wanted = FUNCTIONS[piece.text]
        if len(arguments) < wanted or (wanted == 1 < len(arguments)):
            number = f"{wanted} number" if wanted == 1 else f"{wanted} numbers or more"
            place = f"at character {piece.begin + 1}"
            raise UsageError(f"got {len(arguments)} in {piece.text}() {place}; allowed: {number}")
        return Call(piece.text, tuple(arguments))

    def _lanes(self, piece: Piece) -> Lanes:
        if self._in_lanes:
            raise UsageError(f"got {piece.text!r} at character {piece.begin + 1}; allowed: no lanes within lanes")
        self._word("lane", "lanes")
        self._in_lanes = True
        opening = self._sign("(")
        after = self._pieces.next
        of = _truth(self._inner(opening), after)
        self._in_lanes = False
        return Lanes(cast(Literal["any", "all"], piece.text), of)

    def _known(self, names: tuple[str, ...], what: str) -> str:
        piece = self._pieces.take_name()
        if piece.text not in names:
            allowed = ", ".join(names) or f"nothing: there is no {what}"
            hint = did_you_mean(piece.text, names)
            raise UsageError(f"got {_told(piece)} for the {what}; allowed: {allowed}{hint}")
        return piece.text

    def _whole(self, most: int) -> int:
        return _whole(self._pieces.take(), most)

    def _is(self, word: str) -> bool:
        return self._pieces.next.kind == "word" and self._pieces.next.text == word

    def _word(self, *allowed: str) -> str:
        piece = self._pieces.take()
        if piece.kind != "word" or piece.text not in allowed:
            _refuse(piece, allowed)
        return piece.text

    def _sign(self, sign: str) -> Piece:
        piece = self._pieces.take()
        if piece.text != sign:
            _refuse(piece, [repr(sign)])
        return piece

    def _deeper(self, piece: Piece) -> None:
        self._depth += 1
        if self._depth > DEPTH_MAX:
            raise UsageError(f"got {_told(piece)}, {self._depth} levels deep; allowed: at most {DEPTH_MAX}")


def _truth(node: Node, begin: Piece) -> Truth:
    if isinstance(node, get_args(Truth)):
        return cast(Truth, node)
    raise UsageError(f"got a number at character {begin.begin + 1}; allowed: {_EXAMPLE}")


def _number(node: Node, begin: Piece) -> Numeric:
    if isinstance(node, get_args(Numeric)):
        return cast(Numeric, node)
    raise UsageError(f"got a condition at character {begin.begin + 1}; allowed: a number or a figure")


def _whole(piece: Piece, most: int) -> int:
    if piece.kind != "number" or not piece.text.isdigit() or len(piece.text) > 10 or not 1 <= int(piece.text) <= most:
        _refuse(piece, [f"a whole number, 1 … {most}"])
    return int(piece.text)


def _duration(piece: Piece, text: str, *, zero: bool) -> int:
    try:
        return parse_duration(text, zero=zero)
    except PydanticCustomError as error:
        raise UsageError(str(error).replace("; allowed:", f" at character {piece.begin + 1}; allowed:", 1)) from None


def _refuse(piece: Piece, allowed: Iterable[str]) -> NoReturn:
    words = list(allowed)
    hint = did_you_mean(piece.text, words) if piece.kind == "word" else ""
    raise UsageError(f"got {_told(piece)}; allowed: {', '.join(words)}{hint}")


def _told(piece: Piece) -> str:
    return "the end" if piece.kind == "end" else f"{shown(piece.text)} at character {piece.begin + 1}"
