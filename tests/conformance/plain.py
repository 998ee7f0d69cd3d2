"""A sound estimator in numpy that owes nothing to those of the testbed, and spoilt versions of it."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from testbed.errors import UsageError
from testbed.estimator.model import Ack, Model


class Sound:
    """The linear MMSE filter with i.i.d. control losses."""

    STATE_VERSION: ClassVar[int] = 1

    def __init__(self, model: Model, lanes: int) -> None:
        if not model.control.independent:
            raise UsageError("i.i.d. control losses only")
        self.model, self.lanes, self.k = model, lanes, 0
        self.x: NDArray[np.float64] = np.tile(model.x0_mean, (lanes, 1))
        self.P: NDArray[np.float64] = np.tile(model.P0, (lanes, 1, 1))
        self.counters: dict[str, int] = {"late": 0}

    def nu(self, acks: tuple[Ack, ...]) -> NDArray[np.float64]:
        nu = np.full(self.lanes, self.model.control.first_arrival)
        for ack in acks:
            if ack.j == self.k:
                nu = np.where(ack.known, ack.nu, nu)
            else:
                self.counters["late"] += int(ack.known.sum())
        return nu

    def step(self, u: Any, y: Any, arrived: Any, acks: tuple[Ack, ...] = ()) -> Any:
        m, nu = self.model, self.nu(acks)
        self.k += 1
        self.x = self.x @ m.A.T
        self.P = m.A @ self.P @ m.A.T + m.Q
        if m.B is not None:
            push = u @ m.B.T
            self.x = self.x + nu[:, None] * push
            self.P = self.P + (nu * (1 - nu))[:, None, None] * push[:, :, None] * push[:, None, :]
        gain = self.P @ m.C.T @ np.linalg.inv(m.C @ self.P @ m.C.T + m.R)
        left = np.eye(m.n) - gain @ m.C
        x = self.x + (gain @ (y - self.x @ m.C.T)[..., None])[..., 0]
        P = left @ self.P @ left.transpose(0, 2, 1) + gain @ m.R @ gain.transpose(0, 2, 1)
        seen = np.asarray(arrived, dtype=bool)
        self.x, self.P = np.where(seen[:, None], x, self.x), np.where(seen[:, None, None], P, self.P)
        self.P = (self.P + self.P.transpose(0, 2, 1)) / 2
        return self.given(self.x.copy(), self.P.copy())

    def given(self, x: Any, P: Any) -> Any:
        return SimpleNamespace(x_hat=x, P=P)

    def state(self) -> dict[str, Any]:
        return {"k": np.array(self.k), "x": self.x.copy(), "P": self.P.copy()}

    def set_state(self, state: dict[str, Any]) -> None:
        self.k, self.x, self.P = int(state["k"]), state["x"].copy(), state["P"].copy()

    def start_from(self, step: int, x_hat: Any, P: Any) -> None:
        self.k, self.x, self.P = step, x_hat.copy(), P.copy()


SPOILT: dict[str, tuple[Callable[..., Any], set[str]]] = {}
"""By the name of the class: it, and the checks that must catch it and no others."""


def spoilt(*caught_by: str) -> Callable[[type], type]:
    def note(made: type) -> type:
        SPOILT[made.__name__] = made, set(caught_by)
        return made

    return note


@spoilt("symmetric")
class AsymmetricP(Sound):
    def given(self, x: Any, P: Any) -> Any:
        if P.shape[1] > 1:
            P[:, 0, -1] += 5e-9 * np.abs(P).max(axis=(1, 2))
        return super().given(x, P)


@spoilt("positive", "ack_bound", "consistency", "long_losses", "coordinates", "kfio_with_acks", "hand_over")
class NegativeP(Sound):
    def given(self, x: Any, P: Any) -> Any:
        P[:, 0, 0] = -0.1
        return super().given(x, P)


@spoilt(
    "shapes",
    *("finite", "no_control", "lost_y_ignored", "deterministic", "lanes"),
    *("coordinates", "kfio_with_acks", "late_acks", "consistency", "long_losses", "restart", "hand_over"),
)
class WrongShape(Sound):
    def given(self, x: Any, P: Any) -> Any:
        return super().given(x[:, None], P)


@spoilt("shapes", "coordinates", "kfio_with_acks", "restart", "hand_over")
class SinglePrecision(Sound):
    def given(self, x: Any, P: Any) -> Any:
        out = super().given(x, P)
        out.x_hat = x.astype(np.float32)
        return out


@spoilt("inputs_kept")
class ChangesItsInput(Sound):
    def step(self, u: Any, y: Any, arrived: Any, acks: tuple[Ack, ...] = ()) -> Any:
        out = super().step(u, y.copy(), arrived, acks)
        y -= self.x @ self.model.C.T
        return out


@spoilt("outputs_kept", "kfio_with_acks", "consistency", "hand_over")
class OneBuffer(Sound):
    buffer: Any = None

    def given(self, x: Any, P: Any) -> Any:
        self.buffer = x if self.buffer is None else self.buffer
        self.buffer[:] = x
        return super().given(self.buffer, P)


@spoilt("lanes", "kfio_with_acks", "hand_over")
class LooksAtOtherLanes(Sound):
    def given(self, x: Any, P: Any) -> Any:
        if len(x) < 10:
            x = x + 1e-3 * (x.mean(axis=0) - x)
        return super().given(x, P)


@spoilt("long_losses")
class LostAfterLongLosses(Sound):
    lost = 0

    def step(self, u: Any, y: Any, arrived: Any, acks: tuple[Ack, ...] = ()) -> Any:
        self.lost = 0 if np.any(arrived) else self.lost + 1
        if self.lost > 100:
            self.P = self.P * np.nan
        return super().step(u, y, arrived, acks)


@spoilt("long_losses")
class SureAfterLongLosses(Sound):
    lost = 0

    def step(self, u: Any, y: Any, arrived: Any, acks: tuple[Ack, ...] = ()) -> Any:
        self.lost = 0 if np.any(arrived) else self.lost + 1
        if self.lost > 100:
            self.P = self.P * 0.5
        return super().step(u, y, arrived, acks)


@spoilt("kfio_with_acks", "late_acks", "hand_over")
class IgnoresAcks(Sound):
    def nu(self, acks: tuple[Ack, ...]) -> NDArray[np.float64]:
        return super().nu(())


@spoilt("late_acks")
class LosesLateAcks(Sound):
    def nu(self, acks: tuple[Ack, ...]) -> NDArray[np.float64]:
        return super().nu(tuple(ack for ack in acks if ack.j == self.k))


@spoilt("late_acks", "restart")
class FailsAtLateAcks(Sound):
    def nu(self, acks: tuple[Ack, ...]) -> NDArray[np.float64]:
        if any(ack.j != self.k for ack in acks):
            raise KeyError("late")
        return super().nu(acks)


@spoilt("ack_bound", "consistency", "kfio_with_acks", "long_losses", "hand_over")
class Overconfident(Sound):
    def given(self, x: Any, P: Any) -> Any:
        return super().given(x, 0.25 * P)


@spoilt("consistency", "kfio_with_acks", "hand_over")
class Underconfident(Sound):
    def given(self, x: Any, P: Any) -> Any:
        return super().given(x, 4.0 * P)


@spoilt("consistency", "coordinates", "kfio_with_acks", "hand_over")
class Biased(Sound):
    def given(self, x: Any, P: Any) -> Any:
        return super().given(x + np.sqrt(np.diagonal(P, axis1=1, axis2=2)), P)


@spoilt("coordinates", "kfio_with_acks", "hand_over")
class InflatesByUnits(Sound):
    def given(self, x: Any, P: Any) -> Any:
        return super().given(x, P + 0.01 * np.eye(x.shape[1]))


@spoilt("lost_y_ignored")
class ReadsWhatWasLost(Sound):
    def step(self, u: Any, y: Any, arrived: Any, acks: tuple[Ack, ...] = ()) -> Any:
        out = super().step(u, y, arrived, acks)
        if np.abs(y).max() > 500.0:
            out.x_hat += 1e-6
        return out


@spoilt("deterministic")
class SharesItsState(Sound):
    seen: ClassVar[list[object]] = []

    def __init__(self, model: Model, lanes: int) -> None:
        super().__init__(model, lanes)
        self.seen[:] = []

    def step(self, u: Any, y: Any, arrived: Any, acks: tuple[Ack, ...] = ()) -> Any:
        others = [other for other in self.seen if other is not self]
        self.seen.append(self)
        out = super().step(u, y, arrived, acks)
        out.x_hat += 1e-12 * len(others)
        return out


@spoilt("no_control")
class NeedsControl(Sound):
    def step(self, u: Any, y: Any, arrived: Any, acks: tuple[Ack, ...] = ()) -> Any:
        u[:, 0]
        return super().step(u, y, arrived, acks)


@spoilt("restart")
class ForgetsP(Sound):
    def set_state(self, state: dict[str, Any]) -> None:
        self.k, self.x = int(state["k"]), state["x"].copy()


@spoilt("restart")
class GivesNoNumbers(Sound):
    def state(self) -> dict[str, Any]:
        return {**super().state(), "last": np.array(np.nan)}


@spoilt("hand_over")
class StartsAnew(Sound):
    def start_from(self, step: int, x_hat: Any, P: Any) -> None:
        super().start_from(0, x_hat, P)


@spoilt("declaration")
class ClaimsTooLittle(Sound):
    not_claimed: ClassVar[dict[str, str]] = {"lane": "it looks at others"}


@spoilt("declaration")
class GivesNoReason(Sound):
    not_claimed: ClassVar[dict[str, str]] = {"coordinates": " "}
