"""The loss model of four states: good reception, pauses and losses of a burst, and isolated losses.

S. Salsano, F. Ludovici, A. Ordine, D. Giannuzzi: Definition of a general and intuitive loss model for packet networks
and its implementation in the Netem module in the Linux kernel (2012).
"""

from __future__ import annotations

from collections.abc import Sequence

from testbed.channel.hidden import HiddenChain
from testbed.numerics.markov import long_run

GOOD, PAUSE, BURST, ISOLATED = range(4)
"""States 1 … 4 of ``tc netem loss state``."""


def four_state(
    to_burst: float,
    to_good: float,
    to_pause: float = 0.0,
    from_pause: float = 1.0,
    to_isolated: float = 0.0,
    start: Sequence[float] | None = None,
) -> HiddenChain:
    """In the words of ``tc netem loss state p13 p31 p32 p23 p14``: to_burst = p13, to_good = p31, to_pause = p32,
    from_pause = p23, to_isolated = p14.

    start: law of the first state; None: what the chain that is once in the good state tends to.
    """
    moves = (
        (max(0.0, 1.0 - to_burst - to_isolated), 0.0, to_burst, to_isolated),
        (0.0, 1.0 - from_pause, from_pause, 0.0),
        (to_good, to_pause, max(0.0, 1.0 - to_good - to_pause), 0.0),
        (1.0, 0.0, 0.0, 0.0),
    )
    once_good = HiddenChain((1.0, 0.0, 0.0, 0.0), moves, (0.0, 0.0, 1.0, 1.0))
    first = long_run(once_good.initial, once_good.transition) if start is None else start
    return HiddenChain(tuple(float(p) for p in first), moves, once_good.losses)
