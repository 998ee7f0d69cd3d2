"""A step function over a block of many steps at once: lanes last, the states after all steps kept.

Without numba, numpy takes step after step. With it, the steps of a thousand lanes are done before the next lanes, so
that what passes from step to step stays in the cache, and memory sees every number once. The bits are the same.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from testbed.numerics.kernels import available, primitives
from testbed.numerics.lanes import STRAIGHT_MAX, Bools, Floats
from testbed.numerics.loops import Loop, loops
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

    computed = {name for name, _ in program.lines}
    parts = loops(program, [name for name in dict.fromkeys(program.outputs) if name in computed], program.inputs)
    namespace = primitives()
    exec("\n".join(_source(program, parts, state, given)), namespace)
    for i in range(len(parts)):
        namespace[f"part{i}"] = numba.njit(error_model="numpy")(namespace[f"part{i}"])
    block = numba.njit(error_model="numpy", nogil=True)(namespace["block"])

    def run(mask: Bools, start: Arrays, inputs: Arrays, out: Arrays) -> None:
        block(mask, *start, *inputs, *out)

    return run


def _source(program: Program, parts: Sequence[Loop], state: Sequence[Shape], given: Sequence[Shape]) -> Iterator[str]:
    """The loops over lanes, and ``block(mask, states before, given, states after)`` that calls them step by step."""
    computed = {name for name, _ in program.lines}
    for i, part in enumerate(parts):
        yield from part.source(f"part{i}")
    before, inputs, after = (
        [f"{name}{i}" for i in range(len(shapes))]
        for name, shapes in (("before", state), ("given", given), ("after", state))
    )
    yield f"def block({', '.join(['mask', *before, *inputs, *after])}):"
    yield "    steps, total = mask.shape"
    yield f"    for lo in range(0, total, {TILE}):"
    yield f"        hi = min(lo + {TILE}, total)"
    for head, step, last in (
        ("        k = 0", "        ", _rows(before, "", state)),
        ("        for k in range(1, steps):", "            ", _rows(after, "k - 1, ", state)),
    ):
        yield head
        here = ["mask[k, lo:hi]", *last, *_rows(inputs, "k, ", given)]
        outputs = list(zip(program.outputs, _rows(after, "k, ", state), strict=True))
        rows = {name: row for name, row in reversed(outputs) if name in computed}
        rows.update(zip(program.inputs, here, strict=True))
        for i, part in enumerate(parts):
            yield f"{step}part{i}({', '.join(rows[name] for name in (*part.inputs, *part.outputs))})"
        yield from (f"{step}{row}[:] = {rows.get(name, name)}" for name, row in outputs if rows.get(name) != row)


def _rows(arrays: Sequence[str], step: str, shapes: Sequence[Shape]) -> list[str]:
    """The rows of a tile, one a component."""
    pairs = zip(arrays, shapes, strict=True)
    return [f"{array}[{step}{i}, lo:hi]" for array, shape in pairs for i in range(size_of(shape))]
