"""What can be asked of a run that goes, from outside: how it is, an event, to hold the clock, to stop."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from testbed.errors import UsageError

if TYPE_CHECKING:
    from testbed.orchestrator.conductor import Conductor


class Asked(BaseModel):
    """What somebody asks of a run that goes: to change a link, an event, to hold the clock, how it is, or to stop."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    link: str | None = None
    set: dict[str, Any] | None = None
    event: dict[str, Any] | None = None
    do: Literal["status", "stop", "hold", "release"] | None = None
    step: Annotated[int, Field(ge=0)] | None = None


def answer(conductor: Conductor, question: bytes) -> bytes:
    """Answer what somebody asks of the run: {"link": …, "set": {…}}; with {"step": k}, or {"error": …}.

    {"event": {…}} is an event as in a scenario; with {"number": n}. {"do": "hold", "step": k}, {"do": "release"},
    {"do": "status"} and {"do": "stop"}; with status.
    """
    try:
        asked = Asked.model_validate_json(question)
        if asked.event is not None:
            return json.dumps({"number": conductor.order(asked.event)}).encode()
        if asked.do == "stop":
            conductor.end("stopped by command")
        elif asked.do == "hold":
            conductor.hold(asked.step if asked.step is not None else conductor.granted)
        elif asked.do == "release":
            conductor.release()
        if asked.do is not None:
            return json.dumps(status_of(conductor)).encode()
        return json.dumps({"step": conductor.change_link(asked.link or "", asked.set or {})}).encode()
    except (UsageError, ValidationError) as error:
        return json.dumps({"error": " ".join(str(error).split())}).encode()


def status_of(conductor: Conductor) -> dict[str, Any]:
    """How far the run is, who estimates, and what has happened."""
    at = conductor.granted
    future = [
        e for e in conductor.timeline.happened(conductor.setup.scenario.steps) if e.step > at + 1 and e.by != "timeline"
    ]
    roles = {name: conductor.services.role_at(name, max(at, 1)) for name in conductor.services.turns}
    return {
        "completed": conductor.collector.completed,
        "granted": at,
        "steps": conductor.setup.scenario.steps,
        "estimators": {
            name: {"role": role, "kind": next(t.spec.kind for t in conductor.services.turns[name] if t.role == role)}
            for name, role in roles.items()
            if role is not None
        },
        "held": conductor.timeline.held_at,
        "pending": sorted(conductor.timeline.numbers | {e.number for e in future if e.number is not None}),
        "events": [event.model_dump(mode="json", exclude_none=True) for event in conductor.timeline.happened(at + 1)],
    }
