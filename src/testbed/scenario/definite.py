"""Checks of covariance matrices."""

import numpy as np

from testbed.scenario.base import Matrix, problem, size

RELATIVE_TOLERANCE = 1e-9
"""Of symmetry and of semi-definiteness, relative to the largest entry and the largest eigenvalue in magnitude."""


def check_symmetric(name: str, matrix: Matrix, wanted: int, why: str, *, definite: bool = False, at: str = "") -> None:
    """Check a covariance: `wanted` × `wanted`, symmetric, positive semi-definite (or, if `definite`, definite).

    `why` says where the wanted size comes from, `at` where below the value under validation the matrix is. Raises a
    problem of validation; the matrix is not changed.
    """
    rows, columns = size(matrix)
    if (rows, columns) != (wanted, wanted):
        raise problem(f"got {rows} × {columns}; allowed: {wanted} × {wanted}, from {why}", at)
    values = np.array(matrix)
    largest = float(np.abs(values).max())
    scaled = values / largest if largest > 0 else values  # no overflow below, whatever the units
    gap = np.abs(scaled - scaled.T)
    i, j = (int(index) for index in np.unravel_index(int(gap.argmax()), gap.shape))
    if gap[i, j] > RELATIVE_TOLERANCE:
        raise problem(
            f"{name} is not symmetric: got {matrix[i][j]!r} at [{i}][{j}] and {matrix[j][i]!r} at [{j}][{i}]", at
        )
    eigenvalues = np.linalg.eigvalsh((scaled + scaled.T) / 2)
    smallest, spread = float(eigenvalues[0]), float(np.abs(eigenvalues).max())
    if definite and smallest <= wanted * np.finfo(float).eps * spread:
        raise problem(f"{name} is not positive definite: its smallest eigenvalue is {smallest * largest:.6g}", at)
    if smallest < -RELATIVE_TOLERANCE * spread:
        raise problem(f"{name} is not positive semi-definite: its smallest eigenvalue is {smallest * largest:.6g}", at)
