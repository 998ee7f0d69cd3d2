"""``testbed link presets``."""

from __future__ import annotations

import json as json_format
from typing import TYPE_CHECKING, Annotated, Any

import typer

from testbed.cli.tables import row, table

if TYPE_CHECKING:
    from testbed.scenario.presets import Preset


def presets(
    name: Annotated[str | None, typer.Argument(metavar="NAME", help="Show one in full.")] = None,
    json: Annotated[bool, typer.Option("--json", help="Print as JSON.")] = False,
) -> None:
    """List the named links, or show one: its keys in each direction, its source and what speaks against it.

    Use one in a scenario with `preset = "NAME"` in a [links.X] table; other keys of the table replace its own.
    """
    from testbed.scenario.presets import preset_of
    from testbed.scenario.presets import presets as known

    shown = known() if name is None else {name: preset_of(name)}
    if json:
        typer.echo(json_format.dumps({key: preset.model_dump() for key, preset in shown.items()}, ensure_ascii=False))
        return
    from rich.console import Console

    console = Console(highlight=False, markup=False)
    if name is None:
        made = table("preset", "what it is")
        for key, preset in shown.items():
            row(made, key, preset.title)
        console.print(made)
        console.print("\ntestbed link presets NAME: its figures, its source and what speaks against it.")
        return
    preset = shown[name]
    console.print(f"{name}: {preset.title}\n")
    for line in lines_of(preset):
        console.print(line, soft_wrap=True)
    console.print()
    made = table("", "")
    made.show_header = False
    row(made, "source", preset.source)
    row(made, "confirmed", preset.confirmed)
    for index, text in enumerate(preset.caveats):
        row(made, "" if index else "caveats", text)
    for index, text in enumerate(preset.assumed):
        row(made, "" if index else "assumed", text)
    console.print(made)


def lines_of(preset: Preset) -> list[str]:
    """The keys of each direction as lines of TOML; once where the directions are the same."""
    if preset.symmetric:
        return [_line(key, value) for key, value in preset.link("up").items()]
    out = []
    for heading, keys in (("# up", preset.link("up")), ("# down", preset.link("down"))):
        out += [heading, *(_line(key, value) for key, value in keys.items())]
    return out


def _line(key: str, value: dict[str, Any]) -> str:
    return f"{key} = {{ {', '.join(f'{name} = {_toml(entry)}' for name, entry in value.items())} }}"


def _toml(value: Any) -> str:
    return json_format.dumps(value) if isinstance(value, (str, bool)) else repr(value)
