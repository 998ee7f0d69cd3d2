"""The AsyncAPI document of a run: its keys and what goes over them, from the message models and the key expressions."""

from __future__ import annotations

from typing import Any

from testbed import __version__
from testbed.wire.keys import Keys
from testbed.wire.messages import MESSAGES, messages_json_schema

_RUN = "{run}"


def asyncapi() -> dict[str, Any]:
    """An AsyncAPI 3.0 document; ``{run}``, ``{name}`` and ``{role}`` stand for one part of a key."""
    keys, schemas = Keys(_RUN), messages_json_schema()
    channels: dict[str, tuple[str, str, str]] = {
        "clock": (keys.clock, "clock", "orchestrator → controller: how far time may go"),
        "command": (keys.command, "command", "orchestrator → all roles"),
        "change": (
            keys.change("{part}"),
            "change",
            "orchestrator → link (part: control, observation, ack), plant or controller: what is other from a step on",
        ),
        "controlSent": (keys.sent("control"), "control", "controller → link, and estimators, which know u as sent"),
        "controlDelivered": (keys.delivered("control"), "control", "link → plant"),
        "observationSent": (keys.sent("observation"), "observation", "plant → link"),
        "observationDelivered": (keys.delivered("observation"), "observation", "link → estimators"),
        "ackSent": (keys.sent("ack"), "ack", 'plant → link, and estimators with acks = "perfect"'),
        "ackDelivered": (keys.delivered("ack"), "ack", "link → estimators"),
        "truth": (keys.truth, "truth", "plant → collector; never for estimators"),
        "estimate": (keys.estimate("{name}"), "estimate", "estimator → collector, and a controller that follows it"),
        "bounds": (keys.bounds, "bounds", "bounds → collector"),
        "tap": (
            keys.tap(f"{keys.prefix}/{{link}}/{{end}}"),
            "observation",
            "controller, plant and links → recorder: copies of the recorded lanes of what goes over a link "
            "(control, observation or ack; sent or delivered), where a packet holds more lanes than are recorded",
        ),
        "status": (keys.status("{role}"), "status", "role → orchestrator, its last word"),
    }
    return {
        "asyncapi": "3.0.0",
        "info": {
            "title": "Messages of a testbed run",
            "version": __version__,
            "description": (
                f"{schemas['description']} {schemas['x-bundle']} "
                f"Transport: Eclipse Zenoh; a role is a client of the orchestrator's session. "
                f"A query on {keys.scenario} is answered with JSON: the run's identity and its resolved scenario "
                f"(TOML). A query on {keys.ask} with JSON orders an event, holds the clock, or asks how the run is. "
                "A role declares its subscriptions, then the liveliness token "
                f"{keys.presence('{role}')}; "
                "the run starts when all are there. Each key has one sender, and that of an estimate may change from "
                "one step to the next, with the numbers going on; "
                "seq counts its messages from 0. What joins at step k passes over the packets before, and counts them. "
                f"A query on {keys.handover('{role}')} orders an estimator's service to give or take a snapshot, to "
                "serve another name, or to leave; in real time it is told on "
                f"{keys.told('{role}')}, answers on {keys.said('{role}')}, and is handed a state on "
                f"{keys.handed('{role}')}. What a "
                f"role publishes on {keys.warm('{role}')} is read by nobody."
            ),
        },
        "channels": {
            name: {
                "address": address,
                "description": text,
                "parameters": {
                    p: {} for p in ("run", "name", "role", "link", "part", "end") if "{" + p + "}" in address
                },
                "messages": {message: {"$ref": f"#/components/messages/{message}"}},
            }
            for name, (address, message, text) in channels.items()
        },
        "components": {
            "messages": {
                name: {"contentType": "application/x-ncs1", "payload": {"$ref": f"#/components/schemas/{name}"}}
                for name in MESSAGES
            },
            "schemas": schemas["$defs"],
        },
    }
