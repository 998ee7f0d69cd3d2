"""Parts that somebody else wrote: found by MODULE:OBJECT, and made with checked options."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Any, get_type_hints

from pydantic import TypeAdapter, ValidationError

from testbed.errors import UsageError, did_you_mean


def load_object(name: str) -> Callable[..., Any]:
    """What MODULE:OBJECT names, the module also from the working folder.

    Raises UsageError where there is no such module or object, where it cannot be imported, or cannot be called.
    """
    module, _, path = name.partition(":")
    if not module or module.startswith("."):
        raise UsageError(f"{name}: allowed: MODULE:OBJECT")
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


def checked_options(
    what: str, factory: Callable[..., Any], options: Mapping[str, Any], also: Iterable[str] = ()
) -> dict[str, Any]:
    """Options as the factory's signature wants them: parameters after (model, lanes), by name and type.

    ``what``: how errors call the factory; ``also``: keys that may stand beside the options. Raises UsageError for one
    that is unknown, missing or of another type.
    """
    parameters = list(inspect.signature(factory).parameters.values())[2:]
    hints = get_type_hints(factory.__init__ if inspect.isclass(factory) else factory, include_extras=True)
    allowed = [parameter.name for parameter in parameters]
    for name in options:
        if name not in allowed:
            listed = ", ".join(allowed) if allowed else "none"
            raise UsageError(
                f"{what}: unknown option {name!r}; allowed: {listed}{did_you_mean(name, [*allowed, *also])}"
            )
    for parameter in parameters:
        if parameter.name not in options and parameter.default is inspect.Parameter.empty:
            raise UsageError(f"{what}: option {parameter.name!r} is missing")
    checked = {}
    for name, value in options.items():
        try:
            checked[name] = TypeAdapter(hints.get(name, Any)).validate_python(value, strict=True)
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            given = first["input"]
            raise UsageError(f"{what}: {name}: got {given!r}; {first['msg'].lower()}") from None
    return checked


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
