"""What owner and engine agree on, and what the engine wants of a backend."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

ADDRESSES = ("10.0.0.1", "10.0.0.2")
"""Of a and b. Their namespaces have no way out, so that the addresses collide with nothing."""

Plan = dict[str, Any]
"""As JSON: backend, seed, mtu, congestion (of a, of b), forward and backward (impairments, component, trace)."""


class Refused(Exception):
    """Why this machine cannot do it, in the words of the stage that failed."""


class Hosts(Protocol):
    """Two namespaces with their devices; once prepared, with the link between them.

    networks: file descriptors of the network namespaces of a and b.
    """

    networks: tuple[int, int]

    def prepare(self, plan: Plan) -> None:
        """Raises Refused."""

    def serve(self, others: dict[int, Callable[[], bool]]) -> None:
        """Move packets until one of ``others``, by the file descriptor to read, says False."""

    def change(self, direction: str, impairments: dict[str, Any]) -> None:
        """Other parameters from now on."""

    def begin(self, impairments: dict[str, Any]) -> None:
        """These, by direction, from the next packet on, which is number 0, with empty books."""

    def books(self) -> dict[str, dict[str, int]]:
        """By direction, what became of the packets."""

    def end(self) -> None:
        """Close what was being written."""
