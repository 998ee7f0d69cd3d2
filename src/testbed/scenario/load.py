"""Reading a scenario: the file, and its errors."""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from testbed.errors import UsageError
from testbed.scenario.files import resolve_files
from testbed.scenario.models import Scenario
from testbed.scenario.table import read_text


def load_scenario(path: Path | str) -> Scenario:
    """The scenario of a TOML file.

    Raises UsageError, of one line, if the file cannot be read, is not TOML, or is not a scenario.
    """
    try:
        text = read_text(Path(path))
    except UsageError as error:
        raise _error(str(path), error) from None
    return parse_scenario(text, Path(path).parent, source=str(path))


def parse_scenario(
    dict_or_text: Mapping[str, Any] | str, base_dir: Path | str = ".", *, source: str = "scenario"
) -> Scenario:
    """The scenario of a TOML text or of its tables.

    Relative paths in it are taken from `base_dir`. `source` is what errors call it. Raises UsageError, of one line.
    """
    try:
        tables = _parse_toml(dict_or_text) if isinstance(dict_or_text, str) else dict(dict_or_text)
        return Scenario(**resolve_files(tables, Path(base_dir)))
    except UsageError as error:
        raise _error(source, error) from None
    except RecursionError:
        raise _error(source, "arrays or tables are nested too deeply") from None


def _error(source: str, text: object) -> UsageError:
    """The error as one line that can be printed, whatever names and keys are in it."""
    line = " ".join(f"{source}: {text}".split())
    return UsageError("".join(letter if letter.isprintable() else "?" for letter in line))


def _parse_toml(text: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except ValueError as error:  # of the syntax, or an integer of thousands of digits
        raise UsageError(f"not valid TOML: {error}") from None
