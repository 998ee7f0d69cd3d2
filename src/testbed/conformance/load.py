"""From what the user names to the estimator under examination."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Any

from testbed.conformance.subject import Subject
from testbed.errors import UsageError, did_you_mean
from testbed.estimator.registry import checked_options, factory_of, kinds


def subject_of(name: str, options: Mapping[str, Any]) -> Subject:
    """MODULE:OBJECT, the module also from the working folder, or the kind of a registered estimator.

    Raises UsageError where there is no such module, object or kind, where it cannot be imported,
    and for a wrong option.
    """
    if ":" in name:
        module, _, path = name.partition(":")
        if not module or module.startswith("."):
            raise UsageError(f"{name}: allowed: MODULE:OBJECT")
        factory = _object(name, module, path)
    elif name in kinds():
        factory = factory_of(name)
    else:
        listed = ", ".join(kinds())
        raise UsageError(f"{name}: no such estimator; allowed: MODULE:OBJECT, or {listed}{did_you_mean(name, kinds())}")
    return Subject(name, factory, checked_options(name, factory, dict(options)))


def _object(name: str, module: str, path: str) -> Callable[..., Any]:
    with _working_folder():
        found: Any = _module(name, module)
    for part in path.split("."):
        public = [word for word in dir(found) if not word.startswith("_")]
        if not part or not hasattr(found, part):
            raise UsageError(f"{name}: {module} has no {part!r}{did_you_mean(part, public)}")
        found = getattr(found, part)
    if not callable(found):
        raise UsageError(f"{name}: is a {type(found).__name__}; allowed: what is called with (model, lanes)")
    result: Callable[..., Any] = found
    return result


def _module(name: str, module: str) -> Any:
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        missing = error.name or module
        if module != missing and not module.startswith(f"{missing}."):
            raise UsageError(f"{name}: cannot be imported: {error}") from None
        parent, _, last = missing.rpartition(".")
        inside = list(getattr(sys.modules.get(parent), "__path__", [])) if parent else None
        near = did_you_mean(last, [found.name for found in iter_modules(inside)])
        raise UsageError(f"{name}: no module {missing!r}{near}") from None
    except (Exception, SystemExit) as error:  # whatever a stranger's module raises
        text = " ".join(str(error).split())
        raise UsageError(f"{name}: cannot be imported: {type(error).__name__}: {text}") from None


@contextmanager
def _working_folder() -> Iterator[None]:
    """With the working folder among those that are searched for modules, as Python itself has it."""
    folder = str(Path.cwd())
    sys.path.insert(0, folder)
    try:
        yield
    finally:
        sys.path.remove(folder)
