"""What the orchestrator asks of an estimator's service when one takes over from another, and how that is answered.

A question is a bundle of two messages: JSON, and the bytes of a snapshot, which may be empty. The answer is the bytes
of a snapshot, or JSON: {} or {"error": "…"}.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from testbed.errors import TestbedError
from testbed.wire.bundle import bundle, unbundle
from testbed.wire.bus import Bus
from testbed.wire.messages import Name


class Order(BaseModel):
    """give: the snapshot of the block of lanes that begins at ``lane``. take: start the block from a snapshot.

    serve: estimates of step + 1 and later go under ``name``. leave: no more estimates. ready: say whether all is done.
    step: the steps that are done; in a cold start no snapshot comes.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    action: Literal["give", "take", "serve", "leave", "ready"]
    step: Annotated[int, Field(ge=0, le=2**31)]
    lane: Annotated[int, Field(ge=0, le=2**31)] = 0
    form: Literal["cold", "moments", "full"] = "moments"
    name: Name | None = None


class Refused(TestbedError):
    """A service did not do what it was asked."""


class Behind(TestbedError):
    """A service was started anew, and has not come so far."""


def ask(bus: Bus, key: str, order: Order, data: bytes = b"") -> bytes:
    """The answer of a service.

    Raises Refused where it says no, Behind where it is not there yet, BusError where it does not answer in time.
    """
    answer = bus.ask(key, bundle([order.model_dump_json().encode(), data]))
    if answer[:1] == b"{" and (error := json.loads(answer).get("error")) is not None:
        raise (Behind if error == _BEHIND else Refused)(str(error))
    return answer


_BEHIND = "behind"


def answered(do: Callable[[Order, bytes], bytes], question: bytes) -> bytes:
    """The answer to a question; whatever goes wrong becomes an error in it, so that the service goes on."""
    try:
        header, data = unbundle(question)
        return do(Order.model_validate_json(header), data) or b"{}"
    except Behind:
        text = _BEHIND
    except (TestbedError, ValidationError) as error:
        text = str(error)
    except Exception as error:
        text = f"{type(error).__name__}: {error}"
    return json.dumps({"error": " ".join(text.split())[:2000]}).encode()
