"""Every message of a run. These pydantic models are the one source of the schemas and of what the codec accepts.

A message is a JSON header, which is what the models describe, and the arrays that the header lists in ``arrays``.
``ARRAYS`` says for each type which arrays there may be, with their shapes in the symbols of theory.md: ``lanes`` is the
field of that name; n, p, q are the sizes of state, observation and input; ``late`` is any number from 1 on, the same
for all arrays of a message.
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field

PROTOCOL = 1

RunId = Annotated[str, Field(pattern=r"^[a-z0-9]{8,32}$", description="Identifies the run; part of every key.")]
Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_.-]{0,63}$", description="Name of the role that sent it.")]
Count = Annotated[int, Field(ge=0, le=2**63 - 1)]
ArrayEntry = tuple[
    Annotated[str, Field(description="name of the array")],
    Annotated[Literal["<f8", "|u1"], Field(description="element type: little-endian float64, or one byte")],
    Annotated[tuple[Count, ...], Field(description="shape, C order")],
]


class ArrayRule(BaseModel):
    """What a message type allows of one array."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    dtype: Literal["<f8", "|u1"]
    shape: tuple[str, ...]
    required: bool
    description: str


def _floats(*shape: str, text: str, required: bool = True) -> ArrayRule:
    return ArrayRule(dtype="<f8", shape=shape, required=required, description=text)


def _bits(*shape: str, text: str, required: bool = True) -> ArrayRule:
    return ArrayRule(dtype="|u1", shape=shape, required=required, description=text)


class Message(BaseModel):
    """What every message carries."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)
    ARRAYS: ClassVar[dict[str, ArrayRule]] = {}
    ALWAYS: ClassVar[frozenset[str]] = frozenset({"v", "type"})
    """Fields that have a default here and are required in a header."""

    v: Annotated[int, Field(ge=PROTOCOL, le=PROTOCOL, description="version of the protocol")] = PROTOCOL
    type: str
    run: RunId
    source: Name
    seq: Annotated[Count, Field(description="number of this message on its key, from 0, without gaps")]


class Packet(Message):
    """A message of the loop: one step of the lanes lane … lane + lanes − 1."""

    step: Annotated[Count, Field(description="k; for a control packet the index of u_k")]
    lane: Annotated[Count, Field(description="first lane of the packet")]
    lanes: Annotated[int, Field(ge=1, le=2**31, description="number of lanes")]
    arrays: tuple[ArrayEntry, ...] = ()
    FIRST_STEP: ClassVar[int] = 1


_MASK = _bits(
    "lanes",
    required=False,
    text="1 where the packet arrived in the lane; only behind a link; values elsewhere are 0, or noise",
)
_LATE_STEP = _floats(
    "lanes",
    "late",
    required=False,
    text="only behind a link: the earlier step k that a late one belongs to; the same in all lanes",
)
_LATE_MASK = _bits("lanes", "late", required=False, text="1 where it arrived in the lane since the step before")


class Control(Packet):
    """u_k. Behind the link: with the arrival mask; without ``u`` if it arrived in no lane."""

    type: Literal["control"] = "control"
    FIRST_STEP: ClassVar[int] = 0
    ARRAYS: ClassVar[dict[str, ArrayRule]] = {
        "u": _floats("lanes", "q", required=False, text="control input u_k"),
        "mask": _MASK,
    }


class Observation(Packet):
    """y_k. Behind the link: with the arrival mask (γ_k); without ``y`` if it arrived in no lane.

    On a link with ``on_loss = "noise"`` v_k goes beside y_k, and behind it stands in place of y_k where that is lost.
    """

    type: Literal["observation"] = "observation"
    ARRAYS: ClassVar[dict[str, ArrayRule]] = {
        "y": _floats("lanes", "p", required=False, text="observation y_k"),
        "noise": _floats(
            "lanes", "p", required=False, text='sensor noise v_k; only before a link with `on_loss = "noise"`'
        ),
        "mask": _MASK,
        "late_y": _floats("lanes", "late", "p", required=False, text="observations of earlier steps, arrived late"),
        "late_mask": _LATE_MASK,
        "late_step": _LATE_STEP,
    }


class Acknowledgement(Packet):
    """ν_{k−1}: whether control packet step − 1 reached the actuator."""

    type: Literal["ack"] = "ack"
    ARRAYS: ClassVar[dict[str, ArrayRule]] = {
        "nu": _bits("lanes", required=False, text="ν_{k−1}, 1 where the control packet was applied"),
        "mask": _MASK,
        "late_nu": _bits("lanes", "late", required=False, text="ν_{k−1} of earlier steps k, learnt late"),
        "late_mask": _LATE_MASK,
        "late_step": _LATE_STEP,
    }


class Truth(Packet):
    """x_k and ν_{k−1}, and what was applied then, for the collector only, never for an estimator."""

    type: Literal["truth"] = "truth"
    ARRAYS: ClassVar[dict[str, ArrayRule]] = {
        "x": _floats("lanes", "n", text="state x_k"),
        "nu": _bits("lanes", text="ν_{k−1}"),
        "applied": _floats(
            "lanes", "q", required=False, text="the input a_{k−1} that was applied; only where the scenario has a cost"
        ),
    }


class EstimateMessage(Packet):
    """x̂_k and P_k of one estimator, after the observation of step k."""

    type: Literal["estimate"] = "estimate"
    ARRAYS: ClassVar[dict[str, ArrayRule]] = {
        "x_hat": _floats("lanes", "n", text="estimate of x_k"),
        "P": _floats("lanes", "n", "n", text="its error covariance"),
        "error_bound": _floats(
            "lanes", required=False, text="certified distance of x_hat to the optimal one, in units of sqrt(tr P)"
        ),
        "error_bound_P": _floats("lanes", required=False, text="certified relative error of tr P"),
    }


class BoundsMessage(Packet):
    """Traces of the lower bound Pᴬ_k and the upper bound S_k."""

    type: Literal["bounds"] = "bounds"
    ARRAYS: ClassVar[dict[str, ArrayRule]] = {
        "trace_lower": _floats("lanes", text="tr Pᴬ_k"),
        "trace_upper": _floats("lanes", text="tr S_k; absent where no bound is known", required=False),
        "trace_upper_correlated": _floats(
            "lanes", text="tr S_k with room for correlated control losses; only under such", required=False
        ),
    }


class ClockMessage(Message):
    """Time may advance until step ``step`` is complete; in real time: until then, as the wall clock goes."""

    type: Literal["clock"] = "clock"
    step: Count
    start_ns: Annotated[
        Count | None,
        Field(
            description="in real time: when u_0 is due, nanoseconds since 1970 (UTC), the same in all messages; u_k is "
            "due k periods later; in virtual time: null"
        ),
    ] = None


class Command(Message):
    """An order to all roles. ``stop``: report your counters and leave. ``ping``: report that you are there.

    ``forget``: of the packets that you keep for those that begin late, those up to step ``step`` are not needed.
    """

    type: Literal["command"] = "command"
    action: Literal["stop", "ping", "forget"]
    step: Annotated[Count | None, Field(description="with ``forget`` only")] = None


class Change(Message):
    """An order to one link, the plant or the controller: what is other from step ``step`` on."""

    type: Literal["change"] = "change"
    step: Count
    set: Annotated[
        dict[str, Any],
        Field(
            description="for a link: keys of its table as in a scenario, 'none' removes one; for the plant and the "
            "controller: the event's table"
        ),
    ]


class Status(Message):
    """A role's word to the orchestrator."""

    type: Literal["status"] = "status"
    state: Literal["failed", "stopped", "alive"]
    detail: Annotated[str, Field(max_length=2000)] = ""
    counters: dict[str, Count] = {}
    rejected: Annotated[dict[str, Count], Field(description="refused messages by reason")] = {}
    repeated: Annotated[Count, Field(description="messages that had come before, and were passed over")] = 0


MESSAGES: dict[str, type[Message]] = {
    "control": Control,
    "observation": Observation,
    "ack": Acknowledgement,
    "truth": Truth,
    "estimate": EstimateMessage,
    "bounds": BoundsMessage,
    "clock": ClockMessage,
    "command": Command,
    "change": Change,
    "status": Status,
}


def messages_json_schema() -> dict[str, Any]:
    """JSON Schema of every header, with ``x-arrays`` for what follows it."""
    definitions: dict[str, Any] = {}
    for name, model in MESSAGES.items():
        schema = model.model_json_schema()
        schema.pop("$defs", None)
        schema["required"] = [*sorted(model.ALWAYS, reverse=True), *schema["required"]]
        if model.ARRAYS:
            schema["x-arrays"] = {key: rule.model_dump() for key, rule in model.ARRAYS.items()}
        definitions[name] = schema
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Messages of a testbed run",
        "description": (
            "A message is: the four bytes 'NCS1'; the header's length in bytes as a little-endian uint32; the header, "
            "JSON in UTF-8 (integers without a decimal point), padded with spaces to a multiple of 8; then the arrays "
            "in the order of 'arrays' (name, dtype, shape), C order, little-endian, each padded with zero bytes to a "
            "multiple of 8. 'x-arrays' says which arrays a type may have; 'lanes' there is the field, n, p, q are the "
            "sizes of the state, the observation and the input; 'late' is any number from 1 on, the same for all "
            "arrays of a message, which has all of those or none."
        ),
        "x-bundle": (
            "A payload is one message, or several: the four bytes 'NCSB'; their number as a little-endian uint32; then "
            "each message behind its length in bytes as a little-endian uint64."
        ),
        "oneOf": [{"$ref": f"#/$defs/{name}"} for name in definitions],
        "$defs": definitions,
    }
