"""Compiled loops over lanes (numba, an extra), from the same functions of components and with the same bits.

numpy does one operation on all lanes after the other; a loop does all operations on one lane, and needs memory only at
its ends. Only additions, multiplications, divisions, square roots and choices are compiled, without contraction, so
that nothing is rounded otherwise than by numpy. ``exp`` and ``log`` stay numpy's own: a function is cut into loops
around them (see loops.py).
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np

from testbed.numerics.loops import COMPARISONS_MAX, Loop, loops
from testbed.numerics.symbols import Program, Shape, traced

LANES_MIN = 1024
"""Lanes from which compiling pays; it takes a second a function of two states, several of four."""
SWITCH = "TESTBED_KERNELS"
"""Environment variable; ``off`` keeps to numpy."""

_BETWEEN = ("exp", "log")


def available() -> bool:
    """Whether numba is there and wanted."""
    return os.environ.get(SWITCH, "on") != "off" and find_spec("numba") is not None


def kernel(
    function: Callable[..., Sequence[Any]],
    arguments: Sequence[Shape],
    results: Sequence[Shape],
    whole: Mapping[str, Callable[..., Any]],
) -> Callable[..., tuple[Any, ...]]:
    """``function`` as compiled loops, called with components that are arrays of shape (M,) or floats.

    whole: the functions that are applied to whole arrays between the loops.
    """
    program = traced(function, arguments, results)
    types = dict(zip(program.inputs, program.kinds, strict=True))
    stages = [(stage, [_compiled(loop, types) for loop in stage.loops]) for stage in _stages(program)]
    used = set(program.outputs).union(*(stage.needs() for stage, _ in stages))

    def run(*values: Any) -> tuple[Any, ...]:
        flat = program.flatten(values)
        lanes = max((len(v) for v in flat if isinstance(v, np.ndarray)), default=1)
        columns = zip(program.inputs, flat, program.kinds, strict=True)
        known = {name: _array(value, lanes, kind) for name, value, kind in columns if name in used}
        for stage, codes in stages:
            for loop, code in zip(stage.loops, codes, strict=True):
                out = [np.empty(lanes) for _ in loop.outputs]
                code(*[known[name] for name in loop.inputs], *out)
                known.update(zip(loop.outputs, out, strict=True))
            for name, function_name, operand in stage.calls:
                known[name] = whole[function_name](known[operand])
        return program.unflatten([known.get(name, name) for name in program.outputs])

    return run


@dataclass
class _Stage:
    """Loops, and behind them the calls on whole arrays: (name, function, operand)."""

    loops: list[Loop]
    calls: list[tuple[str, str, str]]

    def needs(self) -> set[str]:
        return {name for loop in self.loops for name in loop.inputs} | {operand for _, _, operand in self.calls}


def _stages(program: Program) -> list[_Stage]:
    """Calls that need no other call first, then those that need these, and at last the results.

    Where some loop cannot be made short enough to be vector code, none computes again what an earlier one did.
    """
    depths: dict[str, int] = {}
    calls: list[list[tuple[str, str, str]]] = []
    for name, expression in program.lines:
        depths[name] = max((depths.get(operand, 0) for operand in Program.names_in(expression)), default=0)
        function, _, operand = expression.partition("(")
        if function in _BETWEEN:
            calls += [[]] if depths[name] == len(calls) else []
            calls[depths[name]].append((name, function, operand.rstrip(")")))
            depths[name] += 1
    wanted = [[operand for _, _, operand in level] for level in calls] + [program.outputs]
    stages = _cut(program, calls, wanted)
    if all(loop.comparisons <= COMPARISONS_MAX for stage in stages for loop in stage.loops):
        return stages
    return _cut(program, calls, [_kept(program, depths, level, names) for level, names in enumerate(wanted)])


def _kept(program: Program, depths: Mapping[str, int], level: int, wanted: Sequence[str]) -> list[str]:
    """What is wanted of a level, and what deeper ones need of it."""
    deeper = [expression for name, expression in program.lines if depths[name] > level]
    later = {name for expression in deeper for name in Program.names_in(expression)} | set(program.outputs)
    return [*wanted, *(name for name, _ in program.lines if depths[name] == level and name in later)]


def _cut(
    program: Program, calls: Sequence[list[tuple[str, str, str]]], wanted: Sequence[Sequence[str]]
) -> list[_Stage]:
    known, stages = set(program.inputs), []
    lines = {name for name, _ in program.lines}
    for names, behind in zip(wanted, [*calls, []], strict=True):
        outputs = [name for name in dict.fromkeys(names) if name in lines and name not in known]
        found = loops(program, outputs, known) if outputs else []
        stages.append(_Stage(found, list(behind)))
        known |= {name for loop in found for name in loop.outputs} | {name for name, _, _ in behind}
    return stages


def _compiled(loop: Loop, types: Mapping[str, str]) -> Callable[..., None]:
    """A loop on arrays of shape (M,); ``types``: the kinds of the inputs that are no numbers."""
    import numba

    namespace = primitives()
    exec("\n".join(loop.source("loop")), namespace)
    floats, bits = (numba.types.Array(t, 1, "C", readonly=True) for t in (numba.float64, numba.boolean))
    signature: list[Any] = [bits if types.get(name) == "mask" else floats for name in loop.inputs]
    signature += [numba.float64[::1]] * len(loop.outputs)
    found: Callable[..., None] = numba.njit(numba.void(*signature), error_model="numpy", nogil=True)(namespace["loop"])
    return found


def primitives() -> dict[str, Any]:
    """The functions of components that are compiled, by name."""
    import numba

    inline = numba.njit(inline="always", error_model="numpy")
    return {
        "sqrt": math.sqrt,
        "reciprocal": inline(_reciprocal),
        "clip": inline(_clip),
        "where": inline(_where),
    }


def _array(value: Any, lanes: int, kind: str) -> Any:
    dtype = np.bool_ if kind == "mask" else np.float64
    if isinstance(value, np.ndarray):
        return np.ascontiguousarray(value, dtype=dtype)
    return np.full(lanes, value, dtype=dtype)


def _reciprocal(x: float) -> float:
    return 1.0 / x


def _clip(x: float, low: float, high: float) -> float:
    return low if x < low else (high if x > high else x)


def _where(mask: bool, a: float, b: float) -> float:
    return a if mask else b
