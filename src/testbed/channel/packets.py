"""How long the packets of the three links are."""

from __future__ import annotations

from testbed.scenario import Scenario

_AROUND = {"control": 168, "observation": 168, "ack": 152}
"""Bytes of a message of one lane and step 1 beside its content."""


def packet_bytes(scenario: Scenario, link: str) -> int:
    """Bytes of a packet of one lane as the testbed encodes it: the same for every step, lane and run.

    An ACK that carries a batch is as long as if each outcome took as much as an entry.
    """
    entries = {"control": scenario.system.q, "observation": scenario.system.p, "ack": scenario.links.ack.batch}
    return _AROUND[link] + 8 * entries[link]
