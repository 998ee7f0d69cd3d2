"""The names of the links of a scenario on the command line."""

from __future__ import annotations

from typing import cast, get_args

from testbed.errors import UsageError, did_you_mean
from testbed.wire.keys import LinkName


def link_of(name: str) -> LinkName:
    """The link of this name. Raises UsageError."""
    names = get_args(LinkName)
    if name not in names:
        raise UsageError(f"--link {name}: no such link; allowed: {', '.join(names)}{did_you_mean(name, names)}")
    return cast(LinkName, name)
