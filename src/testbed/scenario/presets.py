"""Named links: keys of a [links.X] table with their source, and what speaks against them."""

import tomllib
from collections.abc import Mapping
from copy import deepcopy
from functools import lru_cache
from importlib.resources import files
from typing import Any, Literal

from pydantic import Field

from testbed.errors import UsageError, did_you_mean
from testbed.scenario.base import Part, shown

Direction = Literal["up", "down"]
"""From the end device into the network, and back."""
KEY = "preset"


class Preset(Part):
    """A named link. both: its keys in either direction; up and down add to them, key by key."""

    title: str = Field(min_length=1, description="What it is, in a line.")
    source: str = Field(min_length=1, description="Where the figures come from.")
    confirmed: str = Field(min_length=1, description="Which figures were found again, and which are second hand.")
    caveats: list[str] = Field(min_length=1, description="What speaks against it.")
    assumed: list[str] = Field(min_length=1, description="What a link needs and the source does not say.")
    both: dict[str, Any] = Field(default_factory=dict, description="Keys in either direction.")
    up: dict[str, Any] = Field(default_factory=dict, description="Keys from the end device into the network.")
    down: dict[str, Any] = Field(default_factory=dict, description="Keys from the network to the end device.")

    @property
    def symmetric(self) -> bool:
        """Whether the two directions are the same."""
        return self.link("up") == self.link("down")

    def link(self, direction: Direction) -> dict[str, Any]:
        """The keys of a [links.X] table in one direction."""
        return {**self.both, **(self.up if direction == "up" else self.down)}


@lru_cache
def presets() -> dict[str, Preset]:
    """All presets by name, in the order of presets.toml."""
    text = files("testbed.scenario").joinpath("presets.toml").read_text(encoding="utf-8")
    return {name: Preset.model_validate(table) for name, table in tomllib.loads(text).items()}


def preset_of(name: object) -> Preset:
    """The preset of a name. Raises UsageError for an unknown one."""
    known = presets()
    if not isinstance(name, str):
        raise UsageError(f"{KEY}: got {shown(name)}; allowed: the name of a preset, {', '.join(known)}")
    if name not in known:
        raise UsageError(
            f"{KEY}: got {shown(name)}, no such preset; allowed: {', '.join(known)}{did_you_mean(name, known)}"
        )
    return known[name]


def resolved(data: Mapping[str, Any], direction: Direction | None) -> dict[str, Any]:
    """The [links.X] table that ``data`` means: the keys of its preset, and its other keys in place of those.

    A key of ``data`` replaces that of the preset as a whole: ``loss`` is not mixed of two. direction None: the same
    in both directions, which not every preset is. Raises UsageError.
    """
    rest = {key: value for key, value in data.items() if key != KEY}
    if KEY not in data:
        return rest
    preset = preset_of(data[KEY])
    if direction is None and not preset.symmetric:
        raise UsageError(f"{KEY}: {data[KEY]} differs up and down; allowed here: one that does not, {_symmetric()}")
    return {**deepcopy(preset.link(direction or "up")), **rest}


def _symmetric() -> str:
    return ", ".join(name for name, preset in presets().items() if preset.symmetric)
