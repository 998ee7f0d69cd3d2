"""Model error: the matrices of the plant depend on parameters that nobody measures.

    A(e) = A + sum_k e_k dA_k,    G(e) = G + sum_k e_k dG_k,    C(e) = C + sum_k e_k dC_k

Each parameter e_k is drawn afresh at every step and in every lane, uniformly from -delta … delta.
"""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BeforeValidator, Field, model_validator

from testbed.scenario.base import Matrix, Part, count, problem, sequence, shown, size
from testbed.scenario.system import System


def _list_of_matrices(value: Any) -> Any:
    entries = sequence(value)
    if entries is None:
        raise problem(f"got {shown(value)}; allowed: a list of matrices, one for each parameter")
    return tuple(entries)


Matrices = Annotated[tuple[Matrix, ...], BeforeValidator(_list_of_matrices)]


class Uncertainty(Part):
    """Parameters of the plant that are not known. Lists that are left out are zero; the others have one length."""

    dA: Matrices = Field(default=(), description="Derivatives of A, a matrix n x n for each parameter.")
    dG: Matrices = Field(default=(), description="Derivatives of G, a matrix n x g for each parameter.")
    dC: Matrices = Field(default=(), description="Derivatives of C, a matrix p x n for each parameter.")
    delta: float = Field(
        ge=0, description="Each parameter is drawn from -delta … delta, at every step and in every lane."
    )

    @property
    def parameters(self) -> int:
        """How many parameters there are."""
        return max(len(self.dA), len(self.dG), len(self.dC))

    @model_validator(mode="after")
    def _one_length(self) -> Uncertainty:
        given = {key: len(getattr(self, key)) for key in ("dA", "dG", "dC") if getattr(self, key)}
        if not given:
            raise problem("got none of dA, dG, dC; allowed: at least one of them, with a matrix for each parameter")
        first, length = next(iter(given.items()))
        for key, other in given.items():
            if other != length:
                raise problem(
                    f"got {count(other, 'parameter')}; allowed: {length}, as many as {first} has matrices", key
                )
        return self

    def check_sizes(self, system: System) -> None:
        """Raises a problem of validation where a matrix does not fit the system."""
        wanted = {"dA": (system.n, system.n), "dG": (system.n, system.g), "dC": (system.p, system.n)}
        for key, (rows, columns) in wanted.items():
            for i, matrix in enumerate(getattr(self, key)):
                found = size(matrix)
                if found != (rows, columns):
                    raise problem(
                        f"got {found[0]} × {found[1]}; allowed: {rows} × {columns}, the size of {key[1:]}",
                        f"{key}[{i}]",
                    )
