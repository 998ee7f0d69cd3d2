"""What the orchestrator tells estimators' services ahead of time, where the clock does not wait, and what they say.

All are published: an order on ``told``, a word on ``said``, both JSON; a state on ``handed``, a bundle of a header in
JSON and the bytes of a snapshot, for each block of lanes one.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from testbed.wire.bundle import bundle, unbundle
from testbed.wire.messages import Name

_Count = Annotated[int, Field(ge=0, le=2**31)]


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class Ahead(_Model):
    """What to do after step ``step``.

    hand: give the role ``to`` the state; where ``stop``, hold back the estimates of later steps until told to leave or
    to stay. begin: start from the state that is handed over, or, if cold and not ``handed``, at once from the prior.
    serve: publish the estimates of later steps under ``name`` from when the other has handed over. leave: no more
    estimates. stay: do not hand over to ``to``, or without ``to`` do not serve, publish what is held back and go on.
    number: the words to it repeat it.
    """

    action: Literal["hand", "begin", "serve", "leave", "stay"]
    number: _Count
    step: _Count
    form: Literal["cold", "moments", "full"] = "cold"
    to: Name | None = None
    stop: bool = False
    handed: bool = True
    name: Name | None = None


class Word(_Model):
    """ready: it will be done. begun: the service serves from the step after; ``bytes`` was the size of the state.

    late: that step is over. refused: it cannot be done.
    """

    number: _Count
    state: Literal["ready", "begun", "late", "refused"]
    detail: Annotated[str, Field(max_length=2000)] = ""
    bytes: Annotated[int, Field(ge=0)] = 0


class Handed(_Model):
    """The state of the block of lanes that begins at ``lane`` after step ``step``."""

    step: _Count
    lane: _Count


def pack(handed: Handed, data: bytes) -> bytes:
    return bundle([handed.model_dump_json().encode(), data])


def unpack(payload: bytes) -> tuple[Handed, bytes]:
    """Raises ValidationError, or Rejected, for what ``pack`` did not write."""
    header, data = unbundle(payload)
    return Handed.model_validate_json(header), data
