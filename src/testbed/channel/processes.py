"""Loss processes: what draws, or knows, the fate of each packet of a link."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from testbed.channel.chains import chain_of
from testbed.channel.gilbert_elliott import GilbertElliott, GilbertElliottProcess
from testbed.channel.hidden import Hidden, HiddenChain, HiddenProcess
from testbed.channel.loss import LossProcess
from testbed.channel.replay import Recorded, ReplayProcess, Scripted
from testbed.errors import UsageError
from testbed.numerics.lanes import Mask, mask_of
from testbed.numerics.streams import Stream
from testbed.scenario import Loss, ScriptedLoss, TraceLoss


class FateProcess(Protocol):
    """A packet meets a state, which decides over its fate; then the state moves.

    state: the one that was met last; None before the first. states: how many there are, 0 where none is kept. A process
    goes on from the state of another one with as many.
    """

    state: Any

    @property
    def states(self) -> int: ...

    def next(self, number: int) -> Mask:
        """Arrival mask of packet ``number``: a ``bool`` for one lane, else a boolean array of shape (M,)."""
        ...

    def move(self, number: int) -> Any:
        """State ``number``, from the one before, where states are not counted by packets."""
        ...

    def fate(self, number: int, state: Any) -> Mask:
        """The fate of packet ``number`` in that state."""
        ...


def process_of(loss: Loss, stream_of: Callable[[str], Stream], lanes: int) -> FateProcess:
    """The process of a loss for a block of lanes; ``stream_of`` gives the stream of a purpose.

    The moves of hidden states have a stream of their own, so that the draws that decide over the packets are the same
    for every loss.
    """
    if isinstance(loss, TraceLoss):
        return ReplayProcess(Recorded.of(loss, stream_of("offset"), lanes), lanes)
    if isinstance(loss, ScriptedLoss):
        return ReplayProcess(Scripted(loss, lanes), lanes)
    losses = chain_of(loss)
    if isinstance(losses, GilbertElliott):
        return GilbertElliottProcess(losses, stream_of("state"), stream_of("loss"), lanes)
    if isinstance(losses, Hidden):
        assert isinstance(losses, HiddenChain)
        return HiddenProcess(losses, stream_of("state"), stream_of("loss"), lanes)
    return LossProcess(losses, stream_of("loss"), lanes)


def goes_on(process: FateProcess, before: FateProcess) -> bool:
    """Let a process go on from the state of another with as many states; whether it does."""
    if process.states != before.states:
        return False
    process.state = before.state
    return True


def index_of_state(process: FateProcess) -> NDArray[np.int64] | None:
    """The state of a process as a number for each lane, (M,); None where it has none."""
    return None if process.state is None else np.atleast_1d(np.asarray(process.state, dtype=np.int64))


def set_state(process: FateProcess, index: NDArray[np.int64]) -> None:
    """Let a process go on from what ``index_of_state`` gave. Raises UsageError where it has no such state."""
    if index.min() < 0 or index.max() >= process.states:
        raise UsageError(f"state {index.min()} … {index.max()} of a loss process; allowed: 0 … {process.states - 1}")
    if not isinstance(process, HiddenProcess):
        process.state = mask_of(index)
    else:
        process.state = int(index[0]) if len(index) == 1 else index.astype(np.intp)
