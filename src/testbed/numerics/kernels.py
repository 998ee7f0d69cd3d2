"""Compiled loops over lanes (numba, an extra), from the same functions of components and with the same bits.

numpy does one operation on all lanes after the other; a loop does all operations on one lane, and needs memory only at
its ends. Only additions, multiplications, divisions, square roots and choices are compiled, without contraction, so
that nothing is rounded otherwise than by numpy. ``exp`` and ``log`` stay numpy's own: a function is cut into loops
around them.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from typing import Any

import numpy as np

from testbed.numerics.symbols import Program, Shape, traced

LANES_MIN = 1024
"""Lanes from which compiling pays; it takes about half a second a function."""
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
    stages = _stages(program)
    compiled = [_loop(stage, types) if stage.lines else None for stage in stages]

    def run(*values: Any) -> tuple[Any, ...]:
        flat = program.flatten(values)
        lanes = max((len(v) for v in flat if isinstance(v, np.ndarray)), default=1)
        columns = zip(program.inputs, flat, program.kinds, strict=True)
        known = {name: _array(value, lanes, kind) for name, value, kind in columns}
        for stage, loop in zip(stages, compiled, strict=True):
            if loop is not None:
                out = [np.empty(lanes) for _ in stage.outputs]
                loop(*[known[name] for name in stage.inputs], *out)
                known.update(zip(stage.outputs, out, strict=True))
            if stage.after is not None:
                name, function_name, operand = stage.after
                known[name] = whole[function_name](known[operand])
        return program.unflatten([known.get(name, name) for name in program.outputs])

    return run


class _Stage:
    """One loop: its lines, the names it needs and gives, and the call on whole arrays behind it."""

    def __init__(self) -> None:
        self.lines: list[tuple[str, str]] = []
        self.inputs: list[str] = []
        self.outputs: list[str] = []
        self.after: tuple[str, str, str] | None = None


def _stages(program: Program) -> list[_Stage]:
    stages = [_Stage()]
    born: dict[str, int] = dict.fromkeys(program.inputs, -1)
    for name, expression in program.lines:
        call, _, operand = expression.partition("(")
        if call in _BETWEEN:
            stages[-1].after = (name, call, operand.rstrip(")"))
            _need(stages, born, [operand.rstrip(")")], len(stages))
            stages.append(_Stage())
            born[name] = len(stages) - 2  # known to every later stage
        else:
            here = len(stages) - 1
            _need(stages, born, Program.names_in(expression), here)
            stages[-1].lines.append((name, expression))
            born[name] = here
    _need(stages, born, [name for name in program.outputs if name in born], len(stages))
    return stages


def _need(stages: list[_Stage], born: Mapping[str, int], names: Sequence[str], here: int) -> None:
    """Note which stage gives a name and that stage ``here`` takes it."""
    for name in names:
        origin = born[name]
        if origin == here:
            continue
        if origin >= 0 and name not in stages[origin].outputs:
            after = stages[origin].after
            if after is None or after[0] != name:
                stages[origin].outputs.append(name)
        if here < len(stages) and name not in stages[here].inputs:
            stages[here].inputs.append(name)


def _loop(stage: _Stage, types: Mapping[str, str]) -> Callable[..., None]:
    import numba

    parameters = [f"i_{name}" for name in stage.inputs] + [f"o_{name}" for name in stage.outputs]
    lines = [f"def loop({', '.join(parameters)}):", f"    for i in range(len({parameters[0]})):"]
    lines += [f"        {name} = i_{name}[i]" for name in stage.inputs]
    lines += [f"        {name} = {expression}" for name, expression in stage.lines]
    lines += [f"        o_{name}[i] = {name}" for name in stage.outputs]
    namespace = primitives()
    exec("\n".join(lines), namespace)
    floats, bits = (numba.types.Array(t, 1, "C", readonly=True) for t in (numba.float64, numba.boolean))
    signature: list[Any] = [bits if types.get(name) == "mask" else floats for name in stage.inputs]
    signature += [numba.float64[::1]] * len(stage.outputs)
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
