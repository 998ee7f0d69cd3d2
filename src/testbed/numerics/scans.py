"""A step function over a block of many steps at once: lanes last, the states after all steps kept.

Without numba, numpy takes step after step. With it, the steps of a thousand lanes are done before the next lanes, so
that what passes from step to step stays in the cache, and memory sees every number once. The bits are the same.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from testbed.numerics.kernels import available, primitives
from testbed.numerics.lanes import STRAIGHT_MAX, Bools, Floats
from testbed.numerics.symbols import Program, Shape, from_components, size_of, to_components, traced

LANE_STEPS_MIN = 50_000
"""Lane-steps from which compiling pays; it takes about a second a function."""
TILE = 1024
"""Lanes whose steps are done before those of the next."""

Arrays = Sequence[Floats]
Scan = Callable[[Bools, Arrays, Arrays, Arrays], None]
"""Called with (mask, start, given, out): see ``scan``."""


def scan(
    function: Callable[..., Sequence[Any]], state: Sequence[Shape], given: Sequence[Shape], lane_steps: int
) -> Scan:
    """``function(mask, *state, *given)``, which gives the next state, over a block of about ``lane_steps``.

    What comes back is called with a mask (T, M); the state before the first step, an array (s, M) for each shape; what
    is given, an array (T, s, M) for each shape; and arrays (T, s, M) that it fills with the states after each step.
    All are C-contiguous. s is the number of components: n for a vector, n(n + 1)/2 for a symmetric matrix, its upper
    triangle by rows. The function uses neither ``exp`` nor ``log``.
    """
    shapes: tuple[Shape, ...] = (("mask", 1), *state, *given)
    if lane_steps < LANE_STEPS_MIN or max(n for _, n in shapes) > STRAIGHT_MAX or not available():
        return _stepwise(function, state, given)
    return _compiled(traced(function, shapes, state), state, given)


def _stepwise(function: Callable[..., Sequence[Any]], state: Sequence[Shape], given: Sequence[Shape]) -> Scan:
    def run(mask: Bools, start: Arrays, inputs: Arrays, out: Arrays) -> None:
        before = _values(start, state)
        for k, arrived in enumerate(mask):
            before = list(function(arrived, *before, *_values([rows[k] for rows in inputs], given)))
            for rows, value, shape in zip(out, before, state, strict=True):
                for i, component in enumerate(to_components(value, shape)):
                    rows[k, i] = component

    return run


def _values(arrays: Arrays, shapes: Sequence[Shape]) -> list[Any]:
    return [from_components(list(rows), shape) for rows, shape in zip(arrays, shapes, strict=True)]


def _compiled(program: Program, state: Sequence[Shape], given: Sequence[Shape]) -> Scan:
    import numba

    namespace = primitives()
    exec("\n".join([*_lanes_source(program), *_block_source(program, state, given)]), namespace)
    namespace["lanes"] = numba.njit(error_model="numpy")(namespace["lanes"])
    block = numba.njit(error_model="numpy", nogil=True)(namespace["block"])

    def run(mask: Bools, start: Arrays, inputs: Arrays, out: Arrays) -> None:
        block(mask, *start, *inputs, *out)

    return run


def _lanes_source(program: Program) -> Iterator[str]:
    """One step of a row of lanes: ``lanes(inputs that are used, outputs)``."""
    outputs = [f"o{i}" for i in range(len(program.outputs))]
    yield f"def lanes({', '.join([f'i_{name}' for name in _used(program)] + outputs)}):"
    yield "    for i in range(len(o0)):"
    yield from (f"        {name} = i_{name}[i]" for name in _used(program))
    yield from (f"        {name} = {expression}" for name, expression in program.lines)
    yield from (f"        {out}[i] = {value}" for out, value in zip(outputs, program.outputs, strict=True))


def _block_source(program: Program, state: Sequence[Shape], given: Sequence[Shape]) -> Iterator[str]:
    """All steps of all lanes, a tile of lanes after the other: ``block(mask, starts, given, states after)``."""
    before = [f"before{i}" for i in range(len(state))]
    inputs = [f"given{i}" for i in range(len(given))]
    after = [f"after{i}" for i in range(len(state))]
    begin = _call(program, ["mask[0, lo:hi]", *_rows(before, "", state), *_rows(inputs, "0, ", given)])
    go_on = _call(program, ["mask[k, lo:hi]", *_rows(after, "k - 1, ", state), *_rows(inputs, "k, ", given)])
    yield f"def block({', '.join(['mask', *before, *inputs, *after])}):"
    yield "    steps, total = mask.shape"
    yield f"    for lo in range(0, total, {TILE}):"
    yield f"        hi = min(lo + {TILE}, total)"
    yield f"        {', '.join([begin, *_rows(after, '0, ', state)])})"
    yield "        for k in range(1, steps):"
    yield f"            {', '.join([go_on, *_rows(after, 'k, ', state)])})"


def _rows(arrays: Sequence[str], step: str, shapes: Sequence[Shape]) -> list[str]:
    """The rows of a tile at a step, one a component."""
    pairs = zip(arrays, shapes, strict=True)
    return [f"{array}[{step}{i}, lo:hi]" for array, shape in pairs for i in range(size_of(shape))]


def _call(program: Program, rows: Sequence[str]) -> str:
    """The beginning of a call of ``lanes``, with the rows of the inputs that are used."""
    used = set(_used(program))
    return "lanes(" + ", ".join(row for name, row in zip(program.inputs, rows, strict=True) if name in used)


def _used(program: Program) -> list[str]:
    named = {name for _, expression in program.lines for name in Program.names_in(expression)}
    return [name for name in program.inputs if name in named or name in program.outputs]
