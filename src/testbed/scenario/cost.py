"""The quadratic cost of a run: its weights."""

from pydantic import Field

from testbed.scenario.base import Matrix, Part, Vector, problem
from testbed.scenario.closed_loop import check_state, check_weights
from testbed.scenario.system import System


class Cost(Part):
    """J = sum over k = 1 … steps of (x_k - reference)' Qx (x_k - reference) + a_{k-1}' Ru a_{k-1}.

    a is the input that the plant applied: zero where a packet was lost, or with an actuator that holds what it held.
    """

    Qx: Matrix = Field(description="Weight of the state, n x n, symmetric, positive semi-definite.")
    Ru: Matrix | None = Field(
        default=None,
        description="Weight of the applied input, q x q, symmetric, positive semi-definite; left out: zero.",
    )
    terminal: Matrix | None = Field(
        default=None, description="Weight of the last state in place of Qx, n x n; left out: Qx."
    )
    reference: Vector | None = Field(
        default=None, description="The state from which deviations cost, n numbers; left out: zero."
    )

    def check_sizes(self, system: System) -> None:
        """Raises a problem of validation where a weight does not fit the system."""
        if self.Ru is not None and system.B is None:
            raise problem("got a weight of the input, but system.B is not given; allowed: nothing", "Ru")
        check_weights(self.Qx, self.Ru, self.terminal, system)
        check_state("reference", self.reference, system.n)
