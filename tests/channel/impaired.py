"""Links in a few words: settings as a scenario has them, and packets through a pipeline."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from testbed.channel.pipeline import Copy, Pipeline
from testbed.scenario.links import Impairments, Link

MS = 1_000_000
NAME = "link.observation"
Sent = list[tuple[Copy, ...]]


def impairments(**keys: Any) -> Impairments:
    return Impairments.model_validate(keys)


def link(**keys: Any) -> Link:
    return Link.model_validate(keys)


def pipeline(seed: int = 3, lane: int = 0, **keys: Any) -> Pipeline:
    return Pipeline(impairments(**keys), seed, NAME, lane)


def times_of(packets: int, seed: int = 5) -> list[int]:
    """Times of sending with pauses and with packets at one and the same time."""
    gaps = np.random.default_rng(seed).integers(0, 4, packets) * (MS // 2)
    return [int(t) for t in np.cumsum(gaps)]


def send_all(pipe: Pipeline, times: Sequence[int], sizes: Sequence[int] | None = None) -> Sent:
    return [pipe.send(100 if sizes is None else sizes[i], at) for i, at in enumerate(times)]
