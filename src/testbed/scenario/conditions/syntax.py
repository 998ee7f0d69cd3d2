"""The parts of a condition, and their text: parsed again, it gives the same parts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from testbed.scenario.durations import format_duration


@dataclass(frozen=True)
class Number:
    """Not negative."""

    value: float


@dataclass(frozen=True)
class Span:
    """A duration; as a number its seconds."""

    ns: int


@dataclass(frozen=True)
class Quantity:
    """`step` or `time`."""

    name: str


@dataclass(frozen=True)
class Figure:
    """Of an estimator. ``over`` None: of each lane within `any lane` and `all lanes`, else the mean."""

    name: str
    estimator: str
    over: str | None = None


@dataclass(frozen=True)
class LossRate:
    """Of a link, over the last so many steps or all."""

    link: str
    last: int | None = None


@dataclass(frozen=True)
class Negative:
    of: Numeric


@dataclass(frozen=True)
class Arithmetic:
    """operator: + - * /"""

    operator: str
    left: Numeric
    right: Numeric


@dataclass(frozen=True)
class Call:
    """function: abs, min, max."""

    function: str
    arguments: tuple[Numeric, ...]


@dataclass(frozen=True)
class Compare:
    """operator: < <= > >= == !="""

    operator: str
    left: Numeric
    right: Numeric


@dataclass(frozen=True)
class Not:
    of: Truth


@dataclass(frozen=True)
class Logic:
    operator: Literal["and", "or"]
    left: Truth
    right: Truth


@dataclass(frozen=True)
class Lanes:
    which: Literal["any", "all"]
    of: Truth


@dataclass(frozen=True)
class HeldSteps:
    """At ``need`` or more of the last ``among`` steps."""

    of: Truth
    need: int
    among: int


@dataclass(frozen=True)
class HeldTime:
    """At every step of a duration."""

    of: Truth
    ns: int


Numeric = Number | Span | Quantity | Figure | LossRate | Negative | Arithmetic | Call
Truth = Compare | Not | Logic | Lanes | HeldSteps | HeldTime
Node = Numeric | Truth

_OR, _AND, _NOT, _HELD, _COMPARE, _SUM, _PRODUCT, _UNARY, _ATOM = range(9)


def text_of(node: Node, at_least: int = _OR) -> str:
    """The shortest text, with parentheses where a part binds less than ``at_least``."""
    text, binds = _written(node)
    return text if binds >= at_least else f"({text})"


def _written(node: Node) -> tuple[str, int]:
    """The text without parentheses around it, and how strongly it binds."""
    match node:
        case Number(value):
            return (f"{value:.0f}" if value < 1e15 and value == int(value) else repr(value)), _ATOM
        case Span(ns):
            return format_duration(ns), _ATOM
        case Quantity(name):
            return name, _ATOM
        case Figure(name, estimator, over):
            return f"{name}({estimator}{'' if over is None else f', {over}'})", _ATOM
        case LossRate(link, last):
            return f"loss_rate({link}{'' if last is None else f', last {_steps(last)}'})", _ATOM
        case Call(function, arguments):
            return f"{function}({', '.join(map(text_of, arguments))})", _ATOM
        case Negative(of):
            return f"-{text_of(of, _UNARY)}", _UNARY
        case Arithmetic(operator, left, right):
            binds = _SUM if operator in "+-" else _PRODUCT
            return f"{text_of(left, binds)} {operator} {text_of(right, binds + 1)}", binds
        case Compare(operator, left, right):
            return f"{text_of(left, _SUM)} {operator} {text_of(right, _SUM)}", _COMPARE
        case Not(of):
            return f"not {text_of(of, _NOT)}", _NOT
        case Logic(operator, left, right):
            binds = _OR if operator == "or" else _AND
            return f"{text_of(left, binds)} {operator} {text_of(right, binds + 1)}", binds
        case Lanes(which, of):
            return f"{'any lane' if which == 'any' else 'all lanes'} ({text_of(of)})", _ATOM
        case HeldSteps(of, need, among):
            many = _steps(among) if need == among else f"at least {need} of {_steps(among)}"
            return f"{text_of(of, _COMPARE)} for {many}", _HELD
        case HeldTime(of, ns):
            return f"{text_of(of, _COMPARE)} for {format_duration(ns)}", _HELD


def _steps(number: int) -> str:
    return f"{number} step" if number == 1 else f"{number} steps"
