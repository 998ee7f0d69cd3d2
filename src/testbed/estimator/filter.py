"""An estimator for a script: predict, update, x̂ and P, without a scenario or a run."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from testbed.errors import UsageError
from testbed.estimator.model import Ack, Estimate, Estimator, Model
from testbed.estimator.registry import check_actuator, create
from testbed.estimator.snapshot import Form, Snapshot, restore, take
from testbed.numerics.lanes import Floats, matrix_of, vector_of


class Filter:
    """An estimator of ``kind``, a name or what is called with (model, lanes, **options).

    A step is ``predict``, then ``update``. Two predictions in a row: nothing arrived in between. With one lane, vectors
    are (n,), (p,), (q,), and P is (n, n); with M lanes they are (M, n), (M, p), (M, q), and P is (M, n, n). One lane
    takes inputs of the second form too.
    """

    def __init__(
        self, kind: str | Callable[..., Estimator], model: Model, lanes: int = 1, *, first_lane: int = 0, **options: Any
    ) -> None:
        """first_lane: the number of the first lane in a run, on which the draws of a particle filter depend.

        Raises UsageError for an unknown kind or option, or where the estimator does not hold for the model.
        """
        if lanes < 1:
            raise UsageError(f"lanes: got {lanes}; allowed: 1 or more")
        self._kind, self._model, self._lanes, self._first = kind, model, lanes, first_lane
        self._options = options
        self._estimator = self._fresh()
        self._step = 0
        self._latest = Estimate(*model.prior(lanes), lanes)
        self._waiting: tuple[Floats, tuple[Ack, ...]] | None = None  # u and ACKs of a step that is predicted only
        self._predicted: Estimate | None = None

    @property
    def step(self) -> int:
        """Steps predicted so far."""
        return self._step

    @property
    def x_hat(self) -> Floats:
        """x̂ of this step: after ``predict`` the prediction, after ``update`` the estimate."""
        return self._shown(self._estimate().x_hat)

    @property
    def P(self) -> Floats:
        """The covariance that goes with ``x_hat``."""
        return self._shown(self._estimate().P)

    @property
    def counters(self) -> dict[str, int]:
        """What the estimator counted, late ACKs for example."""
        return dict(self._estimator.counters)

    def predict(self, u: ArrayLike | None = None, *, nu: ArrayLike | None = None, acks: tuple[Ack, ...] = ()) -> None:
        """Move to the next step with the control u as it was sent; None without B.

        nu: the ACK of that packet, 0 or 1 in each lane, where it is known by now; acks: any ACKs.
        Raises UsageError for a wrong shape or value.
        """
        sent = self._array("u", np.zeros((self._lanes, 0)) if u is None and not self._model.q else u, self._model.q)
        heard = self._acks(nu, acks, self._step)
        self._settle()
        self._waiting, self._step = (sent, heard), self._step + 1

    def update(
        self,
        y: ArrayLike | None,
        arrived: ArrayLike | None = None,
        *,
        nu: ArrayLike | None = None,
        acks: tuple[Ack, ...] = (),
    ) -> None:
        """Observe: y None where nothing arrived in any lane; arrived: the lanes in which it did, by default all.

        For an estimator that knows no γ (kf, rse, rsemm), ``arrived`` are the lanes in which anything was received.
        nu, acks: as in ``predict``, where they come with the observation.
        Raises UsageError without a ``predict`` before it, and for a wrong shape or value; besides what the estimator
        raises, MissingAck for example.
        """
        if self._waiting is None:
            done = f"step {self._step} is updated already" if self._step else "there is no step yet"
            raise UsageError(f"update: {done}; allowed: predict first")
        mask = self._mask(y, arrived)
        given = np.zeros((self._lanes, self._model.p)) if y is None else self._array("y", y, self._model.p, mask)
        u, heard = self._waiting
        self._execute(u, given, mask, heard + self._acks(nu, acks, self._step - 1))

    def snapshot(self, form: Form = "full") -> Snapshot:
        """What is known after an ``update``. Raises UsageError after ``predict``, or where the estimator gives none."""
        if self._waiting is not None:
            raise UsageError(
                f"snapshot: step {self._step} is predicted only; allowed: update first, update(None) where nothing came"
            )
        return take(self._estimator, form, step=self._step, estimate=self._latest)

    def restore(self, snapshot: Snapshot | bytes) -> None:
        """Go on from a snapshot or its bytes. Raises UsageError, and changes nothing, where it is not for this one."""
        taken = Snapshot.from_bytes(snapshot) if isinstance(snapshot, bytes) else snapshot
        fresh = self._fresh()
        restore(taken, fresh, lanes=self._lanes, n=self._model.n)
        self._estimator, self._step = fresh, taken.step
        self._waiting = self._predicted = None
        self._latest = Estimate(vector_of(taken.arrays["x_hat"]), matrix_of(taken.arrays["P"]), self._lanes)

    def _fresh(self) -> Estimator:
        if isinstance(self._kind, str):
            return create(self._kind, self._model, lanes=self._lanes, options=self._options, lane=self._first)
        made = self._kind(self._model, self._lanes, **self._options)
        check_actuator(made, self._model)
        begin_at = getattr(made, "begin_at", None)
        if begin_at is not None:
            begin_at(self._first)
        return made

    def _estimate(self) -> Estimate:
        """The latest one; where the step is predicted only, what a copy of the estimator makes of a loss."""
        if self._waiting is None:
            return self._latest
        if self._predicted is None:
            u, acks = self._waiting
            twin = copy.deepcopy(self._estimator, {id(self._model): self._model})
            self._predicted = twin.step(u, *self._nothing(), acks)
        return self._predicted

    def _settle(self) -> None:
        """Execute a step that is predicted only: nothing arrived."""
        if self._waiting is not None:
            u, acks = self._waiting
            self._execute(u, *self._nothing(), acks)

    def _execute(self, u: Floats, y: Floats, arrived: NDArray[np.bool_], acks: tuple[Ack, ...]) -> None:
        self._latest = self._estimator.step(u, y, arrived, acks)
        self._waiting = self._predicted = None

    def _nothing(self) -> tuple[Floats, NDArray[np.bool_]]:
        return np.zeros((self._lanes, self._model.p)), np.zeros(self._lanes, dtype=np.bool_)

    def _shown(self, array: Floats) -> Floats:
        return array[0] if self._lanes == 1 else array

    def _array(self, name: str, values: Any, size: int, mask: NDArray[np.bool_] | None = None) -> Floats:
        """Values as (M, size); 0 in the lanes that a mask leaves out."""
        try:
            array = np.array(() if values is None else values, dtype=np.float64)
        except (TypeError, ValueError):
            raise UsageError(f"{name}: got {values!r}; allowed: {self._allowed(size)} numbers") from None
        if self._lanes == 1 and array.ndim < 2 and array.size == size:
            array = array.reshape(1, size)
        if array.shape != (self._lanes, size):
            raise UsageError(f"{name}: got shape {array.shape}; allowed: {self._allowed(size)}")
        if mask is not None:
            array[~mask] = 0.0
        if not np.isfinite(array).all():
            raise UsageError(f"{name}: got a value that is not finite; allowed: numbers")
        return array

    def _allowed(self, size: int) -> str:
        return f"({size},)" if self._lanes == 1 else f"({self._lanes}, {size})"

    def _bits(self, name: str, values: Any) -> NDArray[np.int64]:
        array = np.asarray(values)
        if self._lanes == 1 and array.shape == ():
            array = array.reshape(1)
        if array.shape != (self._lanes,):
            raise UsageError(f"{name}: got shape {array.shape}; allowed: ({self._lanes},)")
        if array.dtype.kind not in "biuf" or not np.isin(array, (0, 1)).all():
            raise UsageError(f"{name}: got {values!r}; allowed: 0 and 1")
        return array.astype(np.int64)

    def _mask(self, y: Any, arrived: Any) -> NDArray[np.bool_]:
        mask = np.full(self._lanes, y is not None) if arrived is None else self._bits("arrived", arrived) == 1
        if y is None and mask.any():
            raise UsageError("arrived: got 1 without y; allowed: 0 where y is None")
        return mask

    def _acks(self, nu: Any, acks: tuple[Ack, ...], packet: int) -> tuple[Ack, ...]:
        """The ACK of ``packet`` that nu is, and others, which must be of packets 0 … packet."""
        for ack in acks:
            if not 0 <= ack.j <= packet:
                raise UsageError(f"acks: got control packet {ack.j} at step {packet + 1}; allowed: 0 … {packet}")
        if nu is None:
            return tuple(acks)
        return (*acks, Ack(packet, self._bits("nu", nu), np.ones(self._lanes, dtype=np.bool_)))
