"""Estimators: one a file, pure; the registry; snapshots; the service. ``Filter`` is one for a script."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from testbed.estimator.filter import Filter
    from testbed.estimator.model import Ack, Estimate, Model
    from testbed.estimator.snapshot import Snapshot

__all__ = ["Ack", "Estimate", "Filter", "Model", "Snapshot"]

_HOMES = {"Ack": "model", "Estimate": "model", "Filter": "filter", "Model": "model", "Snapshot": "snapshot"}


def __getattr__(name: str) -> Any:
    """Imported when they are asked for: a process of a run needs none of them from here."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
