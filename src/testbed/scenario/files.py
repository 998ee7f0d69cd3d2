"""The files that the tables of a scenario refer to."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from testbed.errors import UsageError
from testbed.scenario.base import shown
from testbed.scenario.presets import resolved
from testbed.scenario.table import read_table
from testbed.scenario.trace_file import read_fates

_TLS_FILES = ("ca", "certificate", "key", "client_certificate", "client_key")


def resolve_files(tables: dict[str, Any], base_dir: Path) -> dict[str, Any]:
    """The tables with CSV files read in, and paths made absolute. What does not fit is left alone."""
    result = dict(tables)
    source = result.get("input")
    if isinstance(source, dict) and source.get("kind") == "table":
        result["input"] = _with_values("input", source, base_dir)
    events = result.get("events")
    if isinstance(events, list | tuple):
        result["events"] = [_read_event(f"events[{i}]", event, base_dir) for i, event in enumerate(events)]
    if isinstance(result.get("links"), dict):
        result["links"] = {
            name: _read_link(name, link, base_dir) if isinstance(link, dict) else link
            for name, link in result["links"].items()
        }
    transport = result.get("transport")
    if isinstance(transport, dict):
        transport = _absolute(transport, ("users_file",), base_dir)
        if isinstance(transport.get("tls"), dict):
            transport["tls"] = _absolute(transport["tls"], _TLS_FILES, base_dir)
        result["transport"] = transport
    return result


def _read_event(where: str, event: Any, base_dir: Path) -> Any:
    source = event.get("input") if isinstance(event, dict) else None
    if not isinstance(source, dict) or source.get("kind") != "table":
        return event
    return {**event, "input": _with_values(f"{where}.input", source, base_dir)}


def _absolute(table: dict[str, Any], keys: tuple[str, ...], base_dir: Path) -> dict[str, Any]:
    given = {key: table[key] for key in keys if isinstance(table.get(key), str) and table[key]}
    return {**table, **{key: str((base_dir / path).absolute()) for key, path in given.items()}}


def _read_link(name: str, table: dict[str, Any], base_dir: Path) -> dict[str, Any]:
    try:
        table = resolved(table, "down" if name == "control" else "up")
    except UsageError as error:
        raise UsageError(f"links.{name}.{error}") from None
    return _read_trace(name, _read_delays(name, table, base_dir), base_dir)


def _read_trace(link: str, table: dict[str, Any], base_dir: Path) -> dict[str, Any]:
    loss = table.get("loss")
    if not isinstance(loss, dict) or loss.get("kind") != "trace":
        return table

    def read(path: Path, name: str) -> str:
        word = read_fates(path, name).word
        if not word:
            raise UsageError(f"{name}: no packets; allowed: a row for each packet")
        return word

    return {**table, "loss": _read_in(f"links.{link}.loss", loss, base_dir, "fates", read)}


def _read_delays(link: str, table: dict[str, Any], base_dir: Path) -> dict[str, Any]:
    delay = table.get("delay")
    if not isinstance(delay, dict) or delay.get("kind") != "table":
        return table
    where = f"links.{link}.delay"
    resolved = _with_values(where, delay, base_dir)
    rows = resolved["values"]
    if resolved is not delay:
        if len(rows[0]) != 1:
            raise UsageError(f"{where}.file: {delay['file']}: got {len(rows[0])} numbers a row; allowed: one")
        resolved["values"] = [row[0] for row in rows]
    return {**table, "delay": resolved}


def _with_values(where: str, source: dict[str, Any], base_dir: Path) -> dict[str, Any]:
    """The table with the rows of its ``file`` as its ``values``."""

    def read(path: Path, name: str) -> list[list[float]]:
        try:
            return read_table(path)
        except UsageError as error:
            raise UsageError(f"{name}: {error}") from None

    return _read_in(where, source, base_dir, "values", read)


def _read_in(
    where: str, source: dict[str, Any], base_dir: Path, key: str, read: Callable[[Path, str], Any]
) -> dict[str, Any]:
    """The table with what is in its ``file`` under ``key``."""
    if ("file" in source) == (key in source):
        given = "both" if "file" in source else "neither"
        raise UsageError(f"{where}: got {given} of file and {key}; allowed: exactly one of file, {key}")
    if "file" not in source:
        return source
    file = source["file"]
    if not isinstance(file, str) or not file:
        raise UsageError(f"{where}.file: got {shown(file)}; allowed: the path of a CSV file")
    try:
        content = read(base_dir / file, file)
    except UsageError as error:
        raise UsageError(f"{where}.file: {error}") from None
    return {**{name: value for name, value in source.items() if name != "file"}, key: content}
