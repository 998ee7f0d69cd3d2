"""The same cell in simulated time: the carrier that a scenario's link gets; and what the law of the losses says."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from benchmarks.fidelity_cells import Cell, Seen
from testbed.channel.carriers import carriers_of
from testbed.channel.chains import chain_of
from testbed.channel.law import law_of, stationary_of
from testbed.channel.pipeline import Pipeline
from testbed.channel.tcp import TcpCarrier
from testbed.channel.udp import UdpCarrier
from testbed.scenario.carriers import UdpTransport
from testbed.scenario.links import Impairments, SteppedImpairments

_NEGLIGIBLE = 1e-15
_TRANSPORTS = {
    "tcp": {"kind": "tcp", "congestion": "cubic", "delayed_ack": "40 ms", "keep_alive": "2.5 s"},  # those of zenoh
    "udp": {"kind": "udp"},
}


def modelled(cell: Cell, seconds: float, offset_ms: float, seed: int) -> Seen:
    """``offset_ms`` is what the real path adds to the delay."""
    keys = cell.impairments(offset_ms) | {"transport": _TRANSPORTS[cell.transport]}
    link = SteppedImpairments.model_validate(keys)
    carrier = carriers_of(link, seed, "link.fidelity", 0, 1)[0]
    messages, period_ns = cell.messages(seconds), cell.period_ns
    got: list[tuple[int, int]] = []
    for number in range(messages):
        carrier.send(number, cell.size, number * period_ns)
        got += carrier.advance((number + 1) * period_ns - 1)
    got += carrier.advance(messages * period_ns + round(cell.drain_s * 1e9))
    numbers = np.array([number for _, number in got], dtype=np.int64)
    at_ms = np.array([at_ns for at_ns, _ in got], dtype=np.float64) * 1e-6
    timeouts = carrier.as_counters()["timeouts"] if isinstance(carrier, TcpCarrier) else 0
    return Seen(messages, period_ns * 1e-6, numbers, at_ms, timeouts)


def fragments(size: int) -> int:
    """IP packets of a message of ``size`` bytes."""
    return len(UdpCarrier(Pipeline(Impairments(), 1, "none"), UdpTransport()).fragments(size))


def law_of_messages(link: dict[str, Any], packets: int, messages: int) -> tuple[float, float]:
    """Mean and standard deviation of the share lost of so many messages, each of which needs all its ``packets``.

    link: the keys of its table.

    With h the state that the first packet of a message meets, T the moves and D = diag(arrives): a message arrives, and
    the next one meets h', with A = D (T D)^(packets − 1) T; F = T^packets whether it arrives or not. Then
    E[a_0 a_k] = π A F^(k−1) A 1, and the variance of the sum is Σ_k over all pairs.
    """
    chain = chain_of(Impairments.model_validate(link).loss)
    law, start = law_of(chain), stationary_of(chain)
    arrives = np.diag(law.arrived.astype(np.float64))
    whole = arrives @ np.linalg.matrix_power(law.transition @ arrives, packets - 1) @ law.transition
    step = np.linalg.matrix_power(law.transition, packets)
    ahead = whole.sum(axis=1)
    mean = float(start @ ahead)
    total = messages * mean * (1.0 - mean)
    here = start @ whole
    for lag in range(1, messages):
        covariance = float(here @ ahead) - mean**2
        total += 2.0 * (messages - lag) * covariance
        if abs(covariance) < _NEGLIGIBLE:
            break
        here = here @ step
    return 1.0 - mean, math.sqrt(total) / messages
