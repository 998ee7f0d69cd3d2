"""Straight-line code from a function of components, for one lane.

A step of a filter on one lane is a few hundred multiplications and additions; done through lists and small functions,
finding the operands costs ten times the arithmetic. So the function is run once on symbols that write down every
operation, and what they wrote is compiled: the same operations in the same order, hence the same bits.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

Kind = Literal["scalar", "vector", "symmetric"]
Shape = tuple[Kind, int]
"""What one argument or result is: a component, a vector of n, or a symmetric n × n matrix."""


class Symbol:
    """A component that is not known yet; arithmetic on it is written into its program."""

    __slots__ = ("name", "program")

    def __init__(self, program: _Program, name: str) -> None:
        self.program, self.name = program, name

    def apply(self, function: str, *arguments: object) -> Symbol:
        """A call of one of the functions that the program is compiled with."""
        return self.program.note(f"{function}({', '.join([self.name, *map(_written, arguments)])})")

    def __add__(self, other: object) -> Symbol:
        return self.program.note(f"{self.name} + {_written(other)}")

    def __radd__(self, other: object) -> Symbol:
        return self.program.note(f"{_written(other)} + {self.name}")

    def __sub__(self, other: object) -> Symbol:
        return self.program.note(f"{self.name} - {_written(other)}")

    def __rsub__(self, other: object) -> Symbol:
        return self.program.note(f"{_written(other)} - {self.name}")

    def __mul__(self, other: object) -> Symbol:
        return self.program.note(f"{self.name} * {_written(other)}")

    def __rmul__(self, other: object) -> Symbol:
        return self.program.note(f"{_written(other)} * {self.name}")

    def __truediv__(self, other: object) -> Symbol:
        return self.program.note(f"{self.name} / {_written(other)}")

    def __bool__(self) -> bool:
        raise TypeError("a decision cannot depend on a symbol")


class _Program:
    """The operations in the order they were done, each once."""

    def __init__(self) -> None:
        self.lines: list[tuple[str, str]] = []
        self._known: dict[str, Symbol] = {}

    def note(self, expression: str) -> Symbol:
        symbol = self._known.get(expression)
        if symbol is None:
            symbol = self._known[expression] = Symbol(self, f"t{len(self.lines)}")
            self.lines.append((symbol.name, expression))
        return symbol


def straight_line(
    function: Callable[..., Sequence[Any]],
    arguments: Sequence[Shape],
    results: Sequence[Shape],
    functions: Mapping[str, Callable[..., Any]],
) -> Callable[..., tuple[Any, ...]]:
    """``function`` as straight-line code on floats, with arguments and results of the given shapes.

    functions: what ``Symbol.apply`` may call, by name.
    """
    program = _Program()
    names: list[str] = []
    symbols = []
    for shape in arguments:
        count = _size(shape)
        fresh = [f"a{len(names) + i}" for i in range(count)]
        names += fresh
        symbols.append(_unflat([Symbol(program, name) for name in fresh], shape))
    outcome = [_flat(value, shape) for value, shape in zip(function(*symbols), results, strict=True)]
    returned = ", ".join("(" + ", ".join(map(_written, flat)) + ",)" for flat in outcome)
    body = "".join(f"    {name} = {expression}\n" for name, expression in program.lines)
    namespace: dict[str, Any] = dict(functions)
    exec(f"def compiled({', '.join(names)}):\n{body}    return ({returned},)\n", namespace)
    compiled = namespace["compiled"]
    argument_shapes, result_shapes = tuple(arguments), tuple(results)

    def run(*values: Any) -> tuple[Any, ...]:
        flat: list[float] = []
        for value, shape in zip(values, argument_shapes, strict=True):
            flat += _flat(value, shape)
        return tuple([_unflat(out, shape) for out, shape in zip(compiled(*flat), result_shapes, strict=True)])

    return run


def _written(operand: object) -> str:
    if isinstance(operand, Symbol):
        return operand.name
    if isinstance(operand, int | float):
        return f"({float(operand)!r})"
    raise TypeError(f"cannot write {type(operand).__name__} into straight-line code")


def _size(shape: Shape) -> int:
    kind, n = shape
    return 1 if kind == "scalar" else n if kind == "vector" else n * (n + 1) // 2


def _flat(value: Any, shape: Shape) -> list[Any]:
    kind, n = shape
    if kind == "scalar":
        return [value]
    if kind == "vector":
        return value  # type: ignore[no-any-return]
    return [value[i][j] for i in range(n) for j in range(i, n)]


def _unflat(flat: Sequence[Any], shape: Shape) -> Any:
    kind, n = shape
    if kind == "scalar":
        return flat[0]
    if kind == "vector":
        return list(flat)
    if n == 2:
        return [[flat[0], flat[1]], [flat[1], flat[2]]]
    out: list[list[Any]] = [[None] * n for _ in range(n)]
    position = 0
    for i in range(n):
        for j in range(i, n):
            out[i][j] = out[j][i] = flat[position]
            position += 1
    return out
