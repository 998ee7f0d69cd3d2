"""A distributed testbed for state estimation over lossy networks.

For a script: ``Scenario`` or ``load_scenario``, then ``Scenario.start``; errors are ``UsageError`` and ``RunFailed``.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from testbed.errors import RunFailed, UsageError
    from testbed.scenario import Scenario, load_scenario

__version__ = "0.1.0"
__all__ = ["RunFailed", "Scenario", "UsageError", "__version__", "load_scenario"]

_HOMES = {"RunFailed": "errors", "Scenario": "scenario", "UsageError": "errors", "load_scenario": "scenario"}


def __getattr__(name: str) -> Any:
    """Imported when they are asked for: the processes of a run need none of them from here."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
