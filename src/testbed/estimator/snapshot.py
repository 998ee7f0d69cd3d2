"""Snapshots: what an estimator knows after a step, as arrays and as bytes, so that another object can go on from it.

*Moments* are x̂ and P, from which an estimator of any kind can start. A *full* snapshot has the state besides, with
which an estimator of the same kind, model and options goes on to the same bits.

Bytes: ``NCSS`` and what ``testbed.numerics.packed`` says.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from testbed.errors import UsageError
from testbed.estimator.model import Estimate, Estimator, Restartable
from testbed.estimator.registry import kind_of
from testbed.estimator.state import MAX_STEP
from testbed.numerics.packed import Header, Layout

MAX_BYTES = 1 << 28
_STATE, _COUNTER = "state.", "counter."
MEMORY = "memory."

Form = Literal["full", "moments"]
_Size = Annotated[int, Field(ge=1, le=2**31)]


class _Header(Header):
    form: Form
    kind: Annotated[str, Field(min_length=1, max_length=256)]
    version: Annotated[int, Field(ge=0, le=2**31)]
    step: Annotated[int, Field(ge=0, le=MAX_STEP)]
    lanes: _Size
    n: _Size


_LAYOUT = Layout(b"NCSS", "snapshot", _Header, MAX_BYTES)


@dataclass(frozen=True, eq=False)
class Snapshot:
    """After ``step`` steps of an estimator of ``kind``.

    version: the estimator's STATE_VERSION; arrays: x_hat (lanes, n) and P (lanes, n, n), and in the full form
    ``state.NAME`` for each array of the state and ``counter.NAME`` for each counter, and where late packets are of use
    ``memory.NAME`` for what is kept of the last steps.
    """

    form: Form
    kind: str
    version: int
    step: int
    lanes: int
    n: int
    arrays: Mapping[str, NDArray[Any]]

    def moments(self) -> Snapshot:
        """The same without the state: any kind can start from it."""
        return replace(self, form="moments", arrays={name: self.arrays[name] for name in ("x_hat", "P")})

    def to_bytes(self) -> bytes:
        """Raises UsageError for a type that has no code, for what is not finite, or for more than MAX_BYTES."""
        self._check_finite()
        fields = {name: getattr(self, name) for name in ("form", "kind", "version", "step", "lanes", "n")}
        return _LAYOUT.write(fields, self.arrays)

    @classmethod
    def from_bytes(cls, data: bytes) -> Snapshot:
        """Raises UsageError for everything that ``to_bytes`` does not write."""
        header, arrays = _LAYOUT.read(data)
        found = cls(header.form, header.kind, header.version, header.step, header.lanes, header.n, arrays)
        found._check_finite()
        found._check()
        return found

    def _check_finite(self) -> None:
        for name, array in self.arrays.items():
            if array.dtype.kind == "f" and not np.isfinite(array).all():
                raise UsageError(f"snapshot: {name!r} holds a value that is not finite")

    def _check(self) -> None:
        for name, shape in (("x_hat", (self.lanes, self.n)), ("P", (self.lanes, self.n, self.n))):
            array = self.arrays.get(name)
            if array is None:
                raise UsageError(f"snapshot: {name!r} is missing")
            if array.dtype != np.float64 or array.shape != shape:
                raise UsageError(f"snapshot: {name!r} is {array.dtype} {array.shape}; expected float64 {shape}")
        for name, array in self.arrays.items():
            counter = name.startswith(_COUNTER)
            own = counter or name.startswith((_STATE, MEMORY))
            known = name in ("x_hat", "P") or (self.form == "full" and own)
            if not known or (counter and (array.dtype != np.int64 or array.shape != ())):
                raise UsageError(f"snapshot: unexpected array {name!r} in the {self.form} form")


def take(estimator: Estimator, form: Form, *, step: int, estimate: Estimate) -> Snapshot:
    """What an estimator knows after ``step`` steps, the last of which gave ``estimate``; copies.

    Raises UsageError for one that has no state to give.
    """
    given = _restartable(estimator)
    lanes, n = estimate.x_hat.shape
    arrays: dict[str, NDArray[Any]] = {"x_hat": np.array(estimate.x_hat), "P": np.array(estimate.P)}
    if form == "full":
        arrays |= {_STATE + name: array for name, array in given.state().items()}
        arrays |= {_COUNTER + name: np.array(count, dtype=np.int64) for name, count in estimator.counters.items()}
    return Snapshot(form, kind_of(estimator), given.STATE_VERSION, step, lanes, n, arrays)


def restore(snapshot: Snapshot, estimator: Estimator, *, lanes: int, n: int, step: int | None = None) -> None:
    """Let a fresh estimator go on from a snapshot: of its own kind if that is full, of any kind if it is moments.

    lanes, n: those of the estimator; step: the one that is expected, None for any.
    Raises UsageError where the snapshot is not for this estimator.
    """
    given, kind = _restartable(estimator), kind_of(estimator)
    for what, expected in (("lanes", lanes), ("n", n), ("step", step)):
        if expected is not None and getattr(snapshot, what) != expected:
            raise UsageError(f"snapshot: {what} is {getattr(snapshot, what)}; expected {expected}")
    if snapshot.form == "moments":
        given.start_from(snapshot.step, snapshot.arrays["x_hat"], snapshot.arrays["P"])
        return
    if snapshot.kind != kind:
        raise UsageError(f"snapshot: of {snapshot.kind!r}, in full; expected {kind!r}, or the moments of any kind")
    if snapshot.version != given.STATE_VERSION:
        raise UsageError(
            f"snapshot: version {snapshot.version} of the state of {kind!r}; expected {given.STATE_VERSION}, or moments"
        )
    state = {name.removeprefix(_STATE): a for name, a in snapshot.arrays.items() if name.startswith(_STATE)}
    if "k" in state and (state["k"].shape != () or state["k"] != snapshot.step):
        raise UsageError(f"snapshot: of step {snapshot.step}, and its state is of another")
    given.set_state(state)
    estimator.counters.clear()
    for name, array in snapshot.arrays.items():
        if name.startswith(_COUNTER):
            estimator.counters[name.removeprefix(_COUNTER)] = int(array)


def _restartable(estimator: Estimator) -> Restartable:
    if not isinstance(estimator, Restartable):
        raise UsageError(
            f"estimator {kind_of(estimator)!r} cannot be snapshotted: "
            "it lacks one of STATE_VERSION, state, set_state, start_from"
        )
    return estimator
