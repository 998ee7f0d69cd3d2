"""What every part of a scenario is built from: the base model, numbers, vectors and matrices.

Each validator raises `problem`, whose text has the form "got …; allowed: …"; `explain` adds where.
"""

import math
from collections.abc import Sequence
from typing import Annotated, Any, ClassVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, WithJsonSchema
from pydantic.fields import FieldInfo
from pydantic_core import PydanticCustomError

SHOWN_MAX = 60
COUNT_MAX = 2**31 - 1
"""Of steps, lanes and the like: far beyond what can run, and within every integer type."""


class Part(BaseModel):
    """Base of the models: immutable, no unknown keys, no silent conversion between types, finite numbers only."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    other_keys: ClassVar[tuple[str, ...]] = ()
    """Keys allowed in the file that are resolved into fields, such as `mean_burst`."""

    @classmethod
    def known_keys(cls) -> list[str]:
        """The keys allowed in the table of this part."""
        return [*(field.alias or name for name, field in cls.model_fields.items()), *cls.other_keys]

    @classmethod
    def field_of(cls, key: str) -> FieldInfo | None:
        """The field of a key of the table."""
        fields = cls.model_fields
        return fields.get(key) or next((field for field in fields.values() if field.alias == key), None)


def problem(text: str, at: str = "") -> PydanticCustomError:
    """An error of validation. `at` says where below the value under validation: a key, or an index such as "[0]"."""
    return PydanticCustomError("problem", "{text}", {"text": text, "at": at})


def shown(value: object) -> str:
    """A value as it is shown in an error: one line, of limited length."""
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, dict):
        return "a table"
    try:
        text = repr(list(value) if isinstance(value, tuple) else value)
    except (ValueError, RecursionError):  # an integer of thousands of digits, lists within lists within …
        return "a value too long to show"
    return text if len(text) <= SHOWN_MAX else text[: SHOWN_MAX - 2] + " …"


def plain(tables: dict[str, Any]) -> dict[str, Any]:
    """Tables with the numbers and arrays of numpy in them as Python's own."""
    return {
        key: plain(value) if isinstance(value, dict) else value.tolist() if hasattr(value, "tolist") else value
        for key, value in tables.items()
    }


def count(amount: int, noun: str) -> str:
    """An amount with its noun: "1 row", "2 rows"."""
    return f"{amount} {noun}" if amount == 1 else f"{amount} {noun}s"


def number(value: object, at: str = "", allowed: str = "a finite number") -> float:
    """`value` as a float; a problem if it is not a finite number."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise problem(f"got {shown(value)}; allowed: {allowed}", at)
    try:
        result = float(value)
    except OverflowError:
        result = math.inf
    if not math.isfinite(result):
        raise problem(f"got {shown(value)}; allowed: {allowed}", at)
    return result


def probability(value: object, at: str = "") -> float:
    """`value` as a probability; a problem if it is not in 0 … 1."""
    result = number(value, at, "0 … 1")
    if not 0.0 <= result <= 1.0:
        raise problem(f"got {shown(value)}; allowed: 0 … 1", at)
    return result


def sequence(value: object) -> Sequence[Any] | None:
    """`value` as a list or tuple (an array of numpy as a list); None if it is none of these."""
    plain = value.tolist() if hasattr(value, "tolist") else value
    return plain if isinstance(plain, (list, tuple)) else None


def to_vector(value: object) -> tuple[float, ...]:
    """A list of finite numbers as a tuple of floats."""
    entries = sequence(value)
    if not entries:
        example = f", such as [{value!r}]" if isinstance(value, (int, float)) and not isinstance(value, bool) else ""
        raise problem(f"got {shown(value)}; allowed: a list of numbers{example}")
    return tuple(number(entry, f"[{i}]") for i, entry in enumerate(entries))


def to_matrix(value: object) -> tuple[tuple[float, ...], ...]:
    """A list of rows of finite numbers, all of one length, as a tuple of tuples of floats."""
    rows = [sequence(row) for row in sequence(value) or ()]
    if not rows or any(row is None for row in rows):
        raise problem(f"got {shown(value)}; allowed: nested arrays, one list for each row{_example(value)}")
    result = tuple(
        tuple(number(entry, f"[{i}][{j}]") for j, entry in enumerate(row or ())) for i, row in enumerate(rows)
    )
    for i, row in enumerate(result):
        if not row or len(row) != len(result[0]):
            wanted = f"{count(len(result[0]), 'number')}, as in row 0" if result[0] else "at least one number"
            raise problem(f"got {count(len(row), 'number')}; allowed: {wanted}", f"[{i}]")
    return result


def _example(value: object) -> str:
    """The nested arrays that a number or a flat list may have been meant to be."""
    flat = sequence(value)
    if flat is None:
        flat = [value]
    if not flat or not all(isinstance(entry, (int, float)) and not isinstance(entry, bool) for entry in flat):
        return ""
    row = [list(flat)]
    if len(flat) == 1:
        return f", such as {row!r}"
    return f", such as {shown([[entry] for entry in flat])} (a column) or {shown(row)} (a row)"


def to_scalar_or_vector(value: object) -> float | tuple[float, ...]:
    """A number, or a list of numbers."""
    if sequence(value) is not None:
        return to_vector(value)
    return number(value, allowed="a number, or a list of numbers, one for each input channel")


def size(matrix: Sequence[Sequence[float]]) -> tuple[int, int]:
    """(rows, columns) of a matrix."""
    return len(matrix), len(matrix[0])


Vector = Annotated[tuple[float, ...], Field(min_length=1), BeforeValidator(to_vector)]
Matrix = Annotated[tuple[tuple[float, ...], ...], Field(min_length=1), BeforeValidator(to_matrix)]
Count = Annotated[int, Field(ge=1, le=COUNT_MAX)]
Probability = Annotated[float, Field(ge=0.0, le=1.0)]
ScalarOrVector = Annotated[
    float | tuple[float, ...],
    BeforeValidator(to_scalar_or_vector),
    WithJsonSchema(
        {"anyOf": [{"type": "number"}, {"type": "array", "items": {"type": "number"}, "minItems": 1}]},
    ),
]
