"""Two namespaces with a TUN device each, and the pipelines between them."""

from __future__ import annotations

import errno
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from testbed.channel.kernel.namespaces import inside, new_network
from testbed.channel.kernel.plan import ADDRESSES, Plan, Refused
from testbed.channel.kernel.tun import PATH, join, open_tun, overruns

if TYPE_CHECKING:
    from testbed.channel.kernel.way import Way

DIRECTIONS = ("forward", "backward")


class TunHosts:
    """Made without numpy, whose threads would forbid a user namespace."""

    def __init__(self, plan: Plan) -> None:
        first, self._a = _host(plan, 0)
        second, self._b = _host(plan, 1)
        self.networks = (first, second)
        self._ways: dict[str, Way] = {}
        self._plan = plan
        self._clock: Callable[[], int] = lambda: 0

    def prepare(self, plan: Plan) -> None:
        from testbed.channel.kernel.way import Way, clock_from_now
        from testbed.channel.pipeline import Pipeline
        from testbed.scenario.links import Impairments

        self._clock = clock_from_now()
        for direction, source, sink in (("forward", self._a, self._b), ("backward", self._b, self._a)):
            one = plan[direction]
            pipeline = Pipeline(Impairments.model_validate(one["impairments"]), plan["seed"], one["component"])
            trace = None if one["trace"] is None else open(one["trace"], "w")  # noqa: SIM115
            self._ways[direction] = Way(pipeline, source, sink, plan["mtu"], self._clock, trace)

    def serve(self, others: dict[int, Callable[[], bool]]) -> None:
        from testbed.channel.kernel.switch import serve

        serve({self._a: self._ways["forward"], self._b: self._ways["backward"]}, self._clock, others)

    def change(self, direction: str, impairments: dict[str, Any]) -> None:
        from testbed.scenario.links import Impairments

        self._ways[direction].pipeline.change(Impairments.model_validate(impairments))

    def begin(self, impairments: dict[str, Any]) -> None:
        from testbed.channel.pipeline import Pipeline
        from testbed.scenario.links import Impairments

        for direction, settings in impairments.items():
            component = self._plan[direction]["component"]
            self._ways[direction].pipeline = Pipeline(
                Impairments.model_validate(settings), self._plan["seed"], component
            )

    def books(self) -> dict[str, dict[str, int]]:
        """Of each way. overrun: packets that the sender's own queue had no room for, and that were never sent."""
        out = {}
        for network, (direction, way) in zip(self.networks, self._ways.items(), strict=True):
            with inside(network):
                overrun = overruns()
            out[direction] = {**way.pipeline.books.as_counters(), "overdue": way.overdue, "overrun": overrun}
        return out

    def end(self) -> None:
        for way in self._ways.values():
            way.end()


def _host(plan: Plan, which: int) -> tuple[int, int]:
    """File descriptors of its network namespace and of its device."""
    try:
        network = new_network()
    except OSError as error:
        raise Refused(f"network namespaces: {error.strerror}") from None
    try:
        device = open_tun()
    except OSError as error:
        raise Refused(f"TUN device: {PATH}: {error.strerror}") from None
    congestion = plan["congestion"][which]
    try:
        join(ADDRESSES[which], ADDRESSES[1 - which], plan["mtu"], congestion)
    except OSError as error:
        if congestion is not None and error.errno in (errno.EINVAL, errno.ENOENT):
            raise Refused(f"TCP congestion control: the kernel has no {congestion!r}") from None
        raise Refused(f"TUN device: {error.strerror}") from None
    return network, device
