"""Strong observability, also called non-degeneracy (M Definition 5)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from testbed.analysis.structure import TOLERANCE
from testbed.numerics.lanes import Floats

EQUAL = 1e-5
"""Eigenvalues, and moduli, that differ by no more than this times ‖A‖ count as equal."""
_RANK = 1e-9


@dataclass(frozen=True)
class StrongObservability:
    """Whether it holds, why not, and the eigenvalues of the quasi-equiblock that fails (empty if none does)."""

    holds: bool
    reason: str
    failing: tuple[complex, ...] = ()


def strong_observability(A: Floats, C: Floats) -> StrongObservability:
    """M Definition 5 for A (n, n), C (p, n): A is diagonalisable and every quasi-equiblock one-step observable.

    A quasi-equiblock holds all eigenvalues of one modulus; it is one-step observable if C has full column rank on
    their eigenvectors. An eigenvalue with fewer eigenvectors than its multiplicity makes A not diagonalisable.
    """
    size = float(np.linalg.norm(A, 2)) or 1.0
    spaces: list[tuple[complex, int, Floats]] = []
    for cluster in _clusters([complex(value) for value in np.linalg.eigvals(A)], EQUAL * size):
        centre, multiplicity = complex(np.mean(cluster)), len(cluster)
        _, sizes, right = np.linalg.svd((A - centre * np.eye(A.shape[0])) / size)
        found = int((sizes <= EQUAL).sum())
        if found < multiplicity:
            reason = f"A is not diagonalisable: eigenvalue {shown(centre)} has multiplicity {multiplicity}"
            return StrongObservability(False, f"{reason} and {found} eigenvectors", (centre,) * multiplicity)
        spaces.append((centre, multiplicity, right[-multiplicity:].conj().T))
    largest_C = float(np.linalg.norm(C, 2)) or 1.0
    for block in _by_modulus(spaces, EQUAL * size):
        vectors = np.linalg.qr(np.hstack([space for _, _, space in block]))[0]
        sizes = np.linalg.svd(C @ vectors, compute_uv=False) / largest_C
        if int((sizes > _RANK).sum()) < vectors.shape[1]:
            eigenvalues = tuple(value for value, multiplicity, _ in block for _ in range(multiplicity))
            listed = ", ".join(shown(value) for value in eigenvalues)
            rank = int((sizes > _RANK).sum())
            reason = f"the quasi-equiblock of {listed} is not one-step observable: C has rank {rank} on it"
            return StrongObservability(False, f"{reason}, {len(eigenvalues)} needed", eigenvalues)
    return StrongObservability(True, "A is diagonalisable and every quasi-equiblock is one-step observable")


def shown(value: complex) -> str:
    """An eigenvalue as text, without an imaginary part that is rounding."""
    if abs(value.imag) <= TOLERANCE * max(1.0, abs(value)):
        return f"{value.real:.6g}"
    return f"{value.real:.6g}{value.imag:+.6g}i"


def _clusters(values: list[complex], width: float) -> list[list[complex]]:
    """The values in groups; each is within ``width`` of another of its group."""
    groups: list[list[complex]] = []
    for value in values:
        near = [group for group in groups if any(abs(value - other) <= width for other in group)]
        groups = [group for group in groups if group not in near]
        groups.append([value, *(other for group in near for other in group)])
    return groups


def _by_modulus(spaces: list[tuple[complex, int, Floats]], width: float) -> list[list[tuple[complex, int, Floats]]]:
    """The eigenspaces in groups of equal modulus, largest first."""
    groups: list[list[tuple[complex, int, Floats]]] = []
    for space in sorted(spaces, key=lambda entry: -abs(entry[0])):
        if groups and abs(abs(groups[-1][-1][0]) - abs(space[0])) <= width:
            groups[-1].append(space)
        else:
            groups.append([space])
    return groups
