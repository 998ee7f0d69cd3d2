"""What a controller in a closed loop is."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

from numpy.typing import NDArray

from testbed.numerics.lanes import Floats


@runtime_checkable
class Controller(Protocol):
    """Made with (model, lanes, **options), for a block of lanes. Limits are none of its business: see ``Limits``.

    It may also have ``begin_at(lane)``, which is told the first of its lanes in the run, and what makes it a
    ``RestartableController``.
    """

    def step(self, k: int, x_hat: Floats, P: Floats) -> Floats:
        """u_k (M, q), from x̂_k (M, n) and P_k (M, n, n); called for k = 0, 1, …; k = 0: the prior, x̄_0 and P_0.

        What it is given is not to be written to.
        """
        ...


@runtime_checkable
class RestartableController(Controller, Protocol):
    """A controller that hands over what it knows. State: arrays of float64, uint8 or int64 by name, all finite."""

    STATE_VERSION: int
    """Raised when the arrays change their meaning."""

    def state(self) -> dict[str, NDArray[Any]]:
        """Everything that the next step depends on, copied; ``k``, of shape (), is the number of steps done."""
        ...

    def set_state(self, state: dict[str, NDArray[Any]]) -> None:
        """Go on from the ``state`` of a controller with the same model, lanes and options.

        Raises UsageError, and changes nothing, where it is not such a state.
        """
        ...
