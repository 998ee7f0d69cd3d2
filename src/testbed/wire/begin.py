"""Where a role begins, and the states that it gives on its way: what lets it go on after its process was lost."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from testbed.errors import UsageError
from testbed.wire.bundle import bundle, unbundle
from testbed.wire.handover import Order

_Step = Annotated[int, Field(ge=0, le=2**31)]


class _Header(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    step: _Step
    late: bool
    lanes: list[_Step]
    orders: list[Order]
    life: _Step


@dataclass(frozen=True)
class Begin:
    """After ``step`` steps, with the state of each block of lanes.

    late: the run goes already, so that what was sent since is asked for. orders: what an estimator's service was told
    on its way, to be done again, with the bytes of a snapshot each. changes: the messages of that type that it was
    sent so far. life: how often the role was started before.
    """

    step: int = 0
    late: bool = False
    states: Mapping[int, bytes] = field(default_factory=dict)
    orders: tuple[tuple[Order, bytes], ...] = ()
    changes: tuple[bytes, ...] = ()
    life: int = 0

    def to_bytes(self) -> bytes:
        header = _Header(
            step=self.step,
            late=self.late,
            lanes=list(self.states),
            orders=[order for order, _ in self.orders],
            life=self.life,
        )
        parts = [*self.states.values(), *(data for _, data in self.orders), *self.changes]
        return bundle([header.model_dump_json().encode(), *parts])

    @classmethod
    def from_bytes(cls, data: bytes) -> Begin:
        """Raises UsageError for what ``to_bytes`` does not write."""
        text, *parts = unbundle(data)
        try:
            header = _Header.model_validate_json(text)
        except ValidationError:
            raise UsageError("what the orchestrator says of the beginning is not understood") from None
        given, told = len(header.lanes), len(header.lanes) + len(header.orders)
        if len(parts) < told:
            raise UsageError("what the orchestrator says of the beginning is not whole")
        states = dict(zip(header.lanes, parts[:given], strict=True))
        orders = zip(header.orders, parts[given:told], strict=True)
        return cls(header.step, header.late, states, tuple(orders), tuple(parts[told:]), header.life)


AT_START = Begin()


class Given(BaseModel):
    """The header of a state: of a role's block of lanes, that begins at ``lane``, after ``step`` steps.

    life: how often the role was started before.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    role: Annotated[str, Field(max_length=128)]
    step: _Step
    lane: _Step
    life: _Step = 0

    def with_data(self, data: bytes) -> bytes:
        text = self.model_dump_json().encode()
        return len(text).to_bytes(4, "little") + text + data

    @classmethod
    def split(cls, payload: bytes) -> tuple[Given, bytes]:
        """Raises UsageError for what ``with_data`` does not write."""
        end = 4 + int.from_bytes(payload[:4], "little")
        try:
            return cls.model_validate_json(payload[4:end]), payload[end:]
        except ValidationError:
            raise UsageError("a state that is not understood") from None
