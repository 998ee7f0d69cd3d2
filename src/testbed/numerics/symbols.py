"""Programs written down from a function of components.

A step of a filter on one lane is a few hundred multiplications and additions; done through lists and small functions,
finding the operands costs ten times the arithmetic. So the function is run once on symbols that write down every
operation, and what they wrote is compiled: the same operations in the same order, hence the same bits.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

Kind = Literal["scalar", "vector", "symmetric", "mask"]
Shape = tuple[Kind, int]
"""What one argument or result is: a component, a vector of n, a symmetric n × n matrix, or a mask."""

_NAME = re.compile(r"\b[at][0-9]+\b")


class Symbol:
    """A component that is not known yet; arithmetic on it is written into its program."""

    __slots__ = ("name", "program")

    def __init__(self, program: Program, name: str) -> None:
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


class Program:
    """What a function did to symbols: each operation once, in order; and how its arguments and results are laid out."""

    def __init__(self) -> None:
        self.lines: list[tuple[str, str]] = []
        self.inputs: list[str] = []
        self.kinds: list[Kind] = []
        self.outputs: list[str] = []
        self._known: dict[str, Symbol] = {}
        self._arguments: tuple[Shape, ...] = ()
        self._results: tuple[Shape, ...] = ()

    def note(self, expression: str) -> Symbol:
        """The symbol of an operation; the same one if the operation was done before."""
        symbol = self._known.get(expression)
        if symbol is None:
            symbol = self._known[expression] = Symbol(self, f"t{len(self.lines)}")
            self.lines.append((symbol.name, expression))
        return symbol

    def take(self, shapes: Sequence[Shape]) -> list[Any]:
        """Arguments made of fresh symbols."""
        self._arguments = tuple(shapes)
        out = []
        for shape in shapes:
            fresh = [f"a{len(self.inputs) + i}" for i in range(size_of(shape))]
            self.inputs += fresh
            self.kinds += [shape[0]] * len(fresh)
            out.append(from_components([Symbol(self, name) for name in fresh], shape))
        return out

    def give(self, values: Sequence[Any], shapes: Sequence[Shape]) -> None:
        """Note the results."""
        self._results = tuple(shapes)
        for value, shape in zip(values, shapes, strict=True):
            self.outputs += map(_written, to_components(value, shape))
        self._drop_unused()

    def flatten(self, values: Sequence[Any]) -> list[Any]:
        """The components of arguments in the order of ``inputs``."""
        flat: list[Any] = []
        for value, shape in zip(values, self._arguments, strict=True):
            flat += to_components(value, shape)
        return flat

    def unflatten(self, flat: Sequence[Any]) -> tuple[Any, ...]:
        """Results from components in the order of ``outputs``; a component that is a text is a constant."""
        out, position = [], 0
        for shape in self._results:
            size = size_of(shape)
            part = [float(v.strip("()")) if isinstance(v, str) else v for v in flat[position : position + size]]
            out.append(from_components(part, shape))
            position += size
        return tuple(out)

    @staticmethod
    def names_in(expression: str) -> list[str]:
        """The names of symbols in an expression."""
        return _NAME.findall(expression)

    def _drop_unused(self) -> None:
        needed, kept = set(self.outputs), []
        for name, expression in reversed(self.lines):
            if name in needed:
                kept.append((name, expression))
                needed.update(self.names_in(expression))
        self.lines = kept[::-1]


def traced(function: Callable[..., Sequence[Any]], arguments: Sequence[Shape], results: Sequence[Shape]) -> Program:
    """Run a function on symbols."""
    program = Program()
    program.give(function(*program.take(arguments)), results)
    return program


def straight_line(
    function: Callable[..., Sequence[Any]],
    arguments: Sequence[Shape],
    results: Sequence[Shape],
    functions: Mapping[str, Callable[..., Any]],
) -> Callable[..., tuple[Any, ...]]:
    """``function`` as straight-line code on floats, with arguments and results of the given shapes.

    functions: what ``Symbol.apply`` may call, by name.
    """
    program = traced(function, arguments, results)
    values = [f"v{i}" for i in range(len(arguments))]
    lines = [f"def compiled({', '.join(values)}):"]
    names = iter(program.inputs)
    for value, shape in zip(values, arguments, strict=True):
        taken = [next(names) for _ in range(size_of(shape))]
        lines += [f"    {name} = {value}{place}" for name, place in zip(taken, _places(shape), strict=True)]
    lines += [f"    {name} = {expression}" for name, expression in program.lines]
    outputs = iter(program.outputs)
    given = [_packed([next(outputs) for _ in range(size_of(shape))], shape) for shape in results]
    lines.append(f"    return {', '.join(given)},")
    namespace: dict[str, Any] = dict(functions)
    exec("\n".join(lines), namespace)
    compiled: Callable[..., tuple[Any, ...]] = namespace["compiled"]
    return compiled


def _places(shape: Shape) -> list[str]:
    """Where the components of an argument are, in the order of ``to_components``."""
    kind, n = shape
    if kind in ("scalar", "mask"):
        return [""]
    if kind == "vector":
        return [f"[{i}]" for i in range(n)]
    return [f"[{i}][{j}]" for i in range(n) for j in range(i, n)]


def _packed(flat: Sequence[str], shape: Shape) -> str:
    """The expression of a result made of the given components."""
    return str(from_components(flat, shape)).replace("'", "")


def _written(operand: object) -> str:
    if isinstance(operand, Symbol):
        return operand.name
    if isinstance(operand, int | float):
        return f"({float(operand)!r})"
    raise TypeError(f"cannot write {type(operand).__name__} into straight-line code")


def size_of(shape: Shape) -> int:
    kind, n = shape
    return 1 if kind in ("scalar", "mask") else n if kind == "vector" else n * (n + 1) // 2


def to_components(value: Any, shape: Shape) -> list[Any]:
    kind, n = shape
    if kind in ("scalar", "mask"):
        return [value]
    if kind == "vector":
        return value  # type: ignore[no-any-return]
    return [value[i][j] for i in range(n) for j in range(i, n)]


def from_components(flat: Sequence[Any], shape: Shape) -> Any:
    kind, n = shape
    if kind in ("scalar", "mask"):
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
