"""Key expressions: the one place that knows them."""

from __future__ import annotations

from typing import Literal

LinkName = Literal["control", "observation", "ack"]

ROOT = "testbed"


class Keys:
    """The keys of one run: ``testbed/RUN/…``."""

    def __init__(self, run: str) -> None:
        self.prefix = f"{ROOT}/{run}"

    @property
    def clock(self) -> str:
        return f"{self.prefix}/clock"

    @property
    def command(self) -> str:
        return f"{self.prefix}/command"

    @property
    def truth(self) -> str:
        return f"{self.prefix}/truth"

    @property
    def bounds(self) -> str:
        return f"{self.prefix}/bounds"

    @property
    def scenario(self) -> str:
        """Ask here for the run's resolved scenario."""
        return f"{self.prefix}/scenario"

    def sent(self, link: LinkName) -> str:
        """Where the sender of a link publishes."""
        return f"{self.prefix}/{link}/sent"

    def delivered(self, link: LinkName) -> str:
        """Where the link publishes what it delivers."""
        return f"{self.prefix}/{link}/delivered"

    def tap(self, key: str) -> str:
        """Where the recorded lanes of what goes over ``key`` are copied to."""
        return f"{self.prefix}/tap/{key[len(self.prefix) + 1 :]}"

    def change(self, part: str) -> str:
        """Where the orchestrator tells a link, the plant or the controller of a change."""
        return f"{self.prefix}/{part}/change"

    @property
    def ask(self) -> str:
        """Ask here for something to be done while the run goes."""
        return f"{self.prefix}/ask"

    def estimate(self, name: str) -> str:
        return f"{self.prefix}/estimate/{name}"

    def handover(self, role: str) -> str:
        """Ask an estimator's service here to give or take a state, to give the estimates of a name, or to leave."""
        return f"{self.prefix}/handover/{role}"

    def history(self, key: str) -> str:
        """Ask the sender on ``key`` here for what it has sent since a number."""
        return f"{self.prefix}/history/{key[len(self.prefix) + 1 :]}"

    def earlier(self, key: str) -> str:
        """Ask the orchestrator here for what it has taken on ``key``, also from senders that have left, as above."""
        return f"{self.prefix}/earlier/{key[len(self.prefix) + 1 :]}"

    @property
    def begin(self) -> str:
        """Ask the orchestrator here, with the name of a role, where it begins."""
        return f"{self.prefix}/begin"

    def state(self, role: str) -> str:
        """Where a role gives its state now and then."""
        return f"{self.prefix}/state/{role}"

    def told(self, role: str) -> str:
        """Where the orchestrator tells an estimator's service, in real time, what to do after a step to come."""
        return f"{self.handover(role)}/told"

    def said(self, role: str) -> str:
        """What the service says to that."""
        return f"{self.handover(role)}/said"

    def handed(self, role: str) -> str:
        """Where another service hands its state to this one."""
        return f"{self.handover(role)}/state"

    def status(self, role: str) -> str:
        return f"{self.prefix}/status/{role}"

    def warm(self, role: str) -> str:
        """Where a role publishes once, before it is present, what nobody reads: so that the transport is made ready."""
        return f"{self.prefix}/warm/{role}"

    def presence(self, role: str) -> str:
        """Liveliness token of a role."""
        return f"{self.prefix}/presence/{role}"
