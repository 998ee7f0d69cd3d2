"""The system: its matrices, their shapes and their definiteness.

    x_{k+1} = A x_k + nu_k B u_k + G w_k,  w ~ N(0, Q);     y_k = C x_k + v_k,  v ~ N(0, R);     x_0 ~ N(x0_mean, P0)

With an actuator that holds its last input, B a_k in place of nu_k B u_k, a_k = nu_k u_k + (1 - nu_k) a_{k-1}.
Sizes: x has n entries, u has q, y has p, w has g.
"""

from typing import Any

from pydantic import Field, ValidationInfo, field_validator

from testbed.scenario.base import Matrix, Part, Vector, count, problem, size
from testbed.scenario.definite import check_symmetric


def _zeros(data: dict[str, Any]) -> tuple[float, ...]:
    return (0.0,) * len(data["A"])


def _identity(data: dict[str, Any]) -> tuple[tuple[float, ...], ...]:
    n = len(data["A"])
    return tuple(tuple(float(i == j) for j in range(n)) for i in range(n))


class System(Part):
    """The linear system, its noises and its first state. Units are those of the user, the time step is one."""

    A: Matrix = Field(description="Dynamics, n x n.")
    B: Matrix | None = Field(default=None, description="Input, n x q; left out: a system without input.")
    C: Matrix = Field(description="Measurement, p x n.")
    G: Matrix | None = Field(default=None, description="Entry of the process noise, n x g; left out: the identity.")
    Q: Matrix = Field(
        description="Covariance of the process noise w, g x g (n x n without G), symmetric, positive semi-definite."
    )
    R: Matrix = Field(description="Covariance of the measurement noise v, p x p, symmetric, positive definite.")
    x0_mean: Vector = Field(default_factory=_zeros, description="Mean of the first state, n numbers; default zeros.")
    P0: Matrix = Field(
        default_factory=_identity,
        description="Covariance of the first state, n x n, symmetric, positive semi-definite; default the identity.",
    )

    @property
    def n(self) -> int:
        """Size of the state x."""
        return len(self.A)

    @property
    def q(self) -> int:
        """Size of the input u; 0 without B."""
        return len(self.B[0]) if self.B is not None else 0

    @property
    def p(self) -> int:
        """Size of the measurement y."""
        return len(self.C)

    @property
    def g(self) -> int:
        """Size of the process noise w."""
        return len(self.G[0]) if self.G is not None else self.n

    @field_validator("A")
    @classmethod
    def _square(cls, A: Matrix) -> Matrix:
        rows, columns = size(A)
        if rows != columns:
            raise problem(f"got {rows} × {columns}; allowed: a square matrix")
        return A

    @field_validator("B", "G")
    @classmethod
    def _rows_n(cls, matrix: Matrix | None, info: ValidationInfo) -> Matrix | None:
        if matrix is not None and "A" in info.data:
            n, (rows, columns) = len(info.data["A"]), size(matrix)
            if rows != n:
                raise problem(f"got {rows} × {columns}; allowed: {count(n, 'row')}, as A is {n} × {n}")
        return matrix

    @field_validator("C")
    @classmethod
    def _columns_n(cls, C: Matrix, info: ValidationInfo) -> Matrix:
        if "A" in info.data:
            n, (rows, columns) = len(info.data["A"]), size(C)
            if columns != n:
                raise problem(f"got {rows} × {columns}; allowed: {count(n, 'column')}, as A is {n} × {n}")
        return C

    @field_validator("Q")
    @classmethod
    def _check_Q(cls, Q: Matrix, info: ValidationInfo) -> Matrix:
        G = info.data.get("G")
        if G is not None:
            check_symmetric("Q", Q, len(G[0]), "the number of columns of G")
        elif "A" in info.data and "G" in info.data:
            check_symmetric("Q", Q, len(info.data["A"]), "the size of A")
        return Q

    @field_validator("R")
    @classmethod
    def _check_R(cls, R: Matrix, info: ValidationInfo) -> Matrix:
        if "C" in info.data:
            check_symmetric("R", R, len(info.data["C"]), "the number of rows of C", definite=True)
        return R

    @field_validator("x0_mean")
    @classmethod
    def _check_x0_mean(cls, x0_mean: Vector, info: ValidationInfo) -> Vector:
        if "A" in info.data and len(x0_mean) != len(info.data["A"]):
            raise problem(f"got {count(len(x0_mean), 'number')}; allowed: {len(info.data['A'])}, the size of A")
        return x0_mean

    @field_validator("P0")
    @classmethod
    def _check_P0(cls, P0: Matrix, info: ValidationInfo) -> Matrix:
        if "A" in info.data:
            check_symmetric("P0", P0, len(info.data["A"]), "the size of A")
        return P0
