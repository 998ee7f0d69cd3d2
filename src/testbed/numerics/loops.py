"""A program of components cut into loops over lanes that a compiler makes vector code of.

Before it does, it has to know that no output overlaps another array, and gives up where that takes too many
comparisons. So a loop has few outputs, and computes again what others compute too: additions and multiplications are
cheap beside numbers that wait in memory, and the same operations give the same bits.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from testbed.numerics.symbols import Program

COMPARISONS_MAX = 120
"""Pairs of arrays that a loop may have to compare; the compiler's own limit is 128."""
LOOPS_MAX = 5
"""More loops than this for the same results cost more than they gain: then there is one."""


@dataclass(frozen=True)
class Loop:
    """What gives ``outputs`` from ``inputs``, lane by lane."""

    inputs: tuple[str, ...]
    lines: tuple[tuple[str, str], ...]
    outputs: tuple[str, ...]

    @property
    def comparisons(self) -> int:
        outputs = len(self.outputs)
        return outputs * len(self.inputs) + outputs * (outputs - 1) // 2

    def source(self, name: str) -> list[str]:
        """A function of the inputs and then of the outputs, arrays of the same length."""
        parameters = [f"i_{given}" for given in self.inputs] + [f"o{i}" for i in range(len(self.outputs))]
        lines = [f"def {name}({', '.join(parameters)}):", "    for i in range(len(o0)):"]
        lines += [f"        {given} = i_{given}[i]" for given in self.inputs]
        lines += [f"        {found} = {expression}" for found, expression in self.lines]
        lines += [f"        o{i}[i] = {found}" for i, found in enumerate(self.outputs)]
        return lines


def loops(program: Program, outputs: Sequence[str], known: Iterable[str]) -> list[Loop]:
    """Loops that, one after the other, give the ``outputs`` of a program from what is ``known``, its inputs or more.

    What needs least comes first, so that it can serve what needs more.
    """
    given, found = set(known), []
    ordered = sorted(outputs, key=lambda output: len(_loop(program, [output], given).lines))
    group: list[str] = []
    for output in ordered:
        if group and _loop(program, [*group, output], given).comparisons > COMPARISONS_MAX:
            found.append(_loop(program, group, given))
            given.update(group)
            group = []
        group.append(output)
    found.append(_loop(program, group, given))
    return found if len(found) <= LOOPS_MAX else [_loop(program, outputs, set(known))]


def _loop(program: Program, outputs: Sequence[str], known: set[str]) -> Loop:
    """The lines that lead to the outputs."""
    needed, lines, inputs = set(outputs), [], []
    for name, expression in reversed(program.lines):
        if name in needed and name not in known:
            lines.append((name, expression))
            needed.update(Program.names_in(expression))
    inputs = [name for name in (*program.inputs, *(name for name, _ in program.lines)) if name in needed & known]
    return Loop(tuple(inputs), tuple(reversed(lines)), tuple(outputs))
