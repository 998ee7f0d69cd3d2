"""From the errors of validation to one line: where, what was given, what is allowed, the nearest match."""

import types
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import annotated_types
from pydantic import BaseModel, Tag, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from testbed.errors import did_you_mean
from testbed.scenario.base import Part, shown
from testbed.scenario.estimators import NAME_ALLOWED, NAME_PATTERN
from testbed.scenario.models import Scenario
from testbed.scenario.replays import WORD_PATTERN

Target = type[BaseModel] | dict[str, "type[BaseModel] | None"] | None
"""What lies below a field: a model, the members of a union by their tag (None: one that is no model), or neither."""
_TAGS = ("kind", "action")
_A = {"kind": "a kind", "action": "an action"}


@dataclass(frozen=True)
class Place:
    """Where an error is: its path, the path of the table around it, and what the models say of it."""

    path: str
    parent: str
    part: type[Part] | None
    key: str
    field: FieldInfo | None
    target: Target


def explain(error: ValidationError, whole: type[Part] = Scenario) -> str:
    """One line for all the problems of `error`: the first of them, and how many more there are.

    Unknown keys come first, and hide what is missing beside them: most often it is the same key, misspelt.
    """
    details = [
        (entry, locate(entry["loc"], whole))
        for entry in error.errors()
        if entry["type"] != "default_factory_not_called"
    ]
    unknown = [(entry, place) for entry, place in details if _is_unknown(entry, place)]
    hidden = {place.parent for _, place in unknown}
    others = [
        (entry, place)
        for entry, place in details
        if entry["type"] != "extra_forbidden" and not (entry["type"] == "missing" and place.parent in hidden)
    ]
    texts = [_unknown_key(place) for _, place in unknown] + [_wrong_value(entry, place) for entry, place in others]
    more = f" (and {len(texts) - 1} more)" if len(texts) > 1 else ""
    return texts[0] + more


def _is_unknown(entry: ErrorDetails, place: Place) -> bool:
    return entry["type"] == "extra_forbidden" and not (place.part and place.key in place.part.other_keys)


def locate(loc: tuple[int | str, ...], whole: type[Part] = Scenario) -> Place:
    """The place of an error, from its location as the models report it (which has the kinds of unions in it)."""
    target: Target = whole
    path, parent, key = "", "", ""
    part: type[Part] | None = None
    field: FieldInfo | None = None
    for step in loc:
        if isinstance(step, int):
            path += f"[{step}]"
        elif isinstance(target, dict):
            target = target[step]
        elif target is not None:
            parent, key = path, step
            path = f"{path}.{step}" if path else step
            part = target if issubclass(target, Part) else None
            field = target.field_of(step) if issubclass(target, Part) else target.model_fields.get(step)
            target = _target(field.annotation) if field else None
    return Place(path, parent, part, key, field, target)


def _target(annotation: Any) -> Target:
    origin = get_origin(annotation)
    if origin is Annotated or origin is tuple:
        return _target(get_args(annotation)[0])
    if origin in (Union, types.UnionType):
        members = [member for member in get_args(annotation) if member is not type(None)]
        if len(members) == 1:
            return _target(members[0])
        return {tag: model for member in members for tag, model in _member(member)} or None
    return annotation if isinstance(annotation, type) and issubclass(annotation, BaseModel) else None


def _member(annotation: Any) -> list[tuple[str, type[BaseModel] | None]]:
    """The tag of a member of a union, and its model; nothing for one without a tag."""
    if get_origin(annotation) is Annotated:
        inner, *metadata = get_args(annotation)
        model = inner if isinstance(inner, type) and issubclass(inner, BaseModel) else None
        return [(entry.tag, model) for entry in metadata if isinstance(entry, Tag)]
    if not isinstance(annotation, type) or not issubclass(annotation, BaseModel):
        return []
    tag = _tag_key([annotation])
    return [(get_args(annotation.model_fields[tag].annotation)[0], annotation)]


def _tag_key(models: Iterable[type[BaseModel] | None]) -> str:
    """The key that tells the members of a union apart."""
    fields = [set(model.model_fields) for model in models if model is not None]
    return next(tag for tag in _TAGS if all(tag in names for names in fields))


def _unknown_key(place: Place) -> str:
    where = f"{place.parent}: " if place.parent else ""
    part = place.part or Scenario
    hint = did_you_mean(place.key, part.known_keys())
    return f"{where}unknown key {place.key!r}{hint or '; allowed: ' + ', '.join(part.known_keys())}"


def _wrong_value(entry: ErrorDetails, place: Place) -> str:
    kind, given = entry["type"], entry["input"]
    if kind == "problem":
        below = str(entry["ctx"]["at"])
        dot = "." if place.path and below and not below.startswith("[") else ""
        where = f"{place.path}{dot}{below}"
        return f"{where}: {entry['ctx']['text']}" if where else str(entry["ctx"]["text"])
    if kind == "missing":
        return f"{place.path}: missing; needed: {_described(place)}"
    if kind in ("union_tag_invalid", "union_tag_not_found") and isinstance(place.target, dict):
        kinds, key = list(place.target), _tag_key(place.target.values())
        if kind == "union_tag_not_found":
            return f"{place.path}.{key}: missing; allowed: {', '.join(kinds)}"
        tag = given.get(key) if isinstance(given, dict) else given
        return f"{place.path}.{key}: got {shown(tag)}; allowed: {', '.join(kinds)}{_hint(tag, kinds)}"
    where = f"{place.path}: " if place.path else ""
    return f"{where}got {shown(given)}; allowed: {allowed(place)}{_hint(given, _choices(place))}"


def _described(place: Place) -> str:
    text = place.field.description if place.field else None
    return (text or "a value").rstrip(".")


def _hint(given: object, choices: list[str]) -> str:
    return did_you_mean(given, choices) if isinstance(given, str) else ""


def _choices(place: Place) -> list[str]:
    plain = _plain(place.field.annotation) if place.field else None
    return [str(value) for value in get_args(plain)] if get_origin(plain) is Literal else []


def _plain(annotation: Any) -> Any:
    """The annotation without `None` and without what is annotated."""
    origin = get_origin(annotation)
    if origin is Annotated:
        return _plain(get_args(annotation)[0])
    if origin in (Union, types.UnionType):
        members = [member for member in get_args(annotation) if member is not type(None)]
        return _plain(members[0]) if len(members) == 1 else annotation
    return annotation


def _nested_metadata(annotation: Any) -> list[Any]:
    """The constraints that are annotated inside a union with `None`."""
    entries: list[Any] = []
    for member in get_args(annotation):
        if get_origin(member) is Annotated:
            for entry in get_args(member)[1:]:
                entries.extend(entry.metadata if isinstance(entry, FieldInfo) else [entry])
    return entries


def allowed(place: Place) -> str:
    """What is allowed at a place, in words."""
    if place.field is None:
        return "a table"
    if choices := _choices(place):
        return ", ".join(choices)
    if isinstance(place.target, dict):
        return f"a table with {_A[_tag_key(place.target.values())]}: {', '.join(place.target)}"
    plain = _plain(place.field.annotation)
    if place.target is not None:
        return f"an array of tables, [[{place.key}]]" if get_origin(plain) is tuple else "a table"
    return _allowed_plain(plain, place.field)


def _allowed_plain(plain: Any, field: FieldInfo) -> str:
    metadata = [*field.metadata, *_nested_metadata(field.annotation)]
    low = next((entry.ge for entry in metadata if isinstance(entry, annotated_types.Ge)), None)
    high = next((entry.le for entry in metadata if isinstance(entry, annotated_types.Le)), None)
    above = next((entry.gt for entry in metadata if isinstance(entry, annotated_types.Gt)), None)
    if above is not None:
        limits = f"more than {above:g}" + ("" if high is None else f", at most {high:g}")
    elif low is not None and high is None:
        limits = f"{low} or more"
    else:
        limits = f"{low:g} … {high:g}" if plain is float and low is not None else f"{low} … {high}"
    if plain is bool:
        return "true or false"
    if plain is int:
        return "an integer" if low is None else f"an integer, {limits}"
    if plain is float:
        return "a finite number" if low is None and above is None else limits
    patterns = {getattr(entry, "pattern", None) for entry in metadata}
    if NAME_PATTERN in patterns:
        return NAME_ALLOWED
    if WORD_PATTERN in patterns:
        return "a text of 0 and 1"
    most = next((entry.max_length for entry in metadata if isinstance(entry, annotated_types.MaxLen)), None)
    least = next((entry.min_length for entry in metadata if isinstance(entry, annotated_types.MinLen)), 0)
    return (
        f"a text of {least} to {most} characters, on one line"
        if most
        else "a text" + (" that is not empty" if least else "")
    )
