"""Names of links as options give them."""

from __future__ import annotations

from typing import cast, get_args

from testbed.errors import UsageError, did_you_mean
from testbed.wire.keys import LinkName


def link_name(name: str, option: str = "--link") -> LinkName:
    """Raises UsageError for an unknown one."""
    names = get_args(LinkName)
    if name not in names:
        raise UsageError(f"{option} {name}: no such link; allowed: {', '.join(names)}{did_you_mean(name, names)}")
    return cast(LinkName, name)
