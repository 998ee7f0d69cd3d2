"""A masked step in the form that suits the number of lanes: straight-line code for one, loops or numpy for many."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from testbed.numerics.lanes import Mask, many_lanes, one_lane
from testbed.numerics.symbols import Shape

Step = Callable[..., tuple[Any, ...]]
"""Called with (mask, *arguments): what the function makes of them in each lane."""


def masked_step(
    function: Callable[..., Sequence[Any]], arguments: Sequence[Shape], results: Sequence[Shape], lanes: int
) -> Step:
    """``function(mask, *arguments)`` for a block of ``lanes`` lanes.

    With one lane the mask is a ``bool``, and there is code for either; what needs no observation is not computed.
    """
    if lanes > 1:
        return many_lanes(function, (("mask", 1), *arguments), results, lanes)
    codes: dict[bool, Callable[..., tuple[Any, ...]]] = {}

    def step(mask: Mask, *values: Any) -> tuple[Any, ...]:
        code = codes.get(mask)
        if code is None:
            code = codes[mask] = one_lane(partial(function, mask), arguments, results)
        return code(*values)

    return step
