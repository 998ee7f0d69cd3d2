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
        "status": (
            keys.status("{role}"),
            "status",
            "role → orchestrator: its last word, and before that `alive` whenever it is asked with the command `ping`",
        ),
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
                f"role publishes on {keys.warm('{role}')} is read by nobody. {_recovery(keys)}"
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


def _recovery(keys: Keys) -> str:
    """What there is for roles that are started anew, and what a program of somebody's own may leave out."""
    return (
        f"Recovery: a role asks with its name on {keys.begin} where it begins; the answer is a bundle of a JSON header "
        "(step, late, lanes, orders, life) and the bytes that go with it: a state for each of the lanes that begin a "
        "block, a snapshot for each order, and the changes that the role was told of. After every so many steps it "
        f"gives the state of each block of lanes on {keys.state('{role}')}: the length of a JSON header as a "
        "little-endian uint32, the header (role, step, lane, life), and bytes of its own choice. It keeps what it "
        f"sends on KEY, and answers a query on {keys.prefix}/history/KEY, with JSON (since, a number), by a bundle of "
        "the packets from that number on, by nothing where there is none, or by JSON with error; the command `forget` "
        "says which are not needed any more. What comes again with a number that it has seen, it passes over and "
        "counts as `repeated`. A program of somebody's own may leave all of this out, but for two: it must not take a "
        "packet twice, and it should answer `ping`, for a role that does not is taken for hung when the run stands "
        "still. Then it cannot be started anew (policy `fail`, or `continue` for an estimator that no controller "
        "follows), and neither can a role that listens to it. A run with such a role has no checkpoint in its journal: "
        "when resumed it begins anew."
    )
