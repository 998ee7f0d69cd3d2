"""Loops cut from a program give, together, what the program gives."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from testbed.numerics.lanes import Matrix, Vector, dot, symmetric
from testbed.numerics.loops import COMPARISONS_MAX, loops
from testbed.numerics.symbols import Shape, traced


def products(x: Vector, P: Matrix) -> tuple[Vector, Matrix]:
    """P x + x, and P P'."""
    n = len(x)
    return [dot(row, x) + entry for row, entry in zip(P, x, strict=True)], symmetric(n, lambda i, j: dot(P[i], P[j]))


def direct(x: np.ndarray, P: np.ndarray) -> np.ndarray:
    square = P @ P.swapaxes(1, 2)
    rows, columns = np.triu_indices(x.shape[1])
    return np.concatenate([(P @ x[:, :, None])[:, :, 0] + x, square[:, rows, columns]], axis=1)


@pytest.mark.parametrize(("n", "several"), [(1, False), (2, False), (4, True), (8, False)])
def test_together_they_give_every_output_once(n: int, several: bool) -> None:
    shapes: tuple[Shape, ...] = (("vector", n), ("symmetric", n))
    program = traced(products, shapes, shapes)
    found = loops(program, program.outputs, program.inputs)
    assert (len(found) > 1) == several  # 8 states would take too many
    assert sorted(name for loop in found for name in loop.outputs) == sorted(program.outputs)
    if several:
        assert all(loop.comparisons <= COMPARISONS_MAX for loop in found)
    rng = np.random.default_rng(n)
    x, root = rng.normal(size=(5, n)), rng.normal(size=(5, n, n))
    P = root + root.swapaxes(1, 2)
    rows, columns = np.triu_indices(n)
    known = dict(zip(program.inputs, [*x.T, *P[:, rows, columns].T], strict=True))
    for i, loop in enumerate(found):
        out = [np.empty(5) for _ in loop.outputs]
        namespace: dict[str, Any] = {}
        exec("\n".join(loop.source(f"loop{i}")), namespace)
        namespace[f"loop{i}"](*[known[name] for name in loop.inputs], *out)
        known.update(zip(loop.outputs, out, strict=True))
    np.testing.assert_allclose(np.array([known[name] for name in program.outputs]).T, direct(x, P), rtol=1e-12)
