"""Two namespaces and one between them that forwards, joined by veth pairs; what netem does, it does in the middle.

There, on the way out to the receiver, a drop is one that the sender's TCP does not learn of. Needs iproute2.
"""

from __future__ import annotations

import json
import os
import select
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

from testbed.channel.kernel.namespaces import inside, new_network
from testbed.channel.kernel.plan import ADDRESSES, Plan, Refused
from testbed.channel.kernel.rtnetlink import add_address, add_route, bring_up, only_ipv4
from testbed.channel.kernel.tun import DEVICE

_OUT = {"forward": "tob", "backward": "toa"}
"""The devices of the middle through which each direction leaves."""
_IN = {"forward": "toa", "backward": "tob"}

_SAME = ("address", "02:00:00:00:00:01")
"""Of both ends of each pair: without ARP, which would count as packets, a frame goes to its sender's own address."""


class NetemHosts:
    def __init__(self, plan: Plan) -> None:
        for tool in ("ip", "tc"):
            if shutil.which(tool) is None:
                raise Refused(f"netem: there is no command {tool!r}, of iproute2")
        try:
            a, self._middle, b = new_network(), new_network(), new_network()
        except OSError as error:
            raise Refused(f"network namespaces: {error.strerror}") from None
        self.networks = (a, b)
        with inside(self._middle):
            only_ipv4()
            Path("/proc/sys/net/ipv4/ip_forward").write_text("1")
            for which, (network, device) in enumerate(((a, "toa"), (b, "tob"))):
                there = f"/proc/{os.getpid()}/fd/{network}"
                _tool(
                    "ip", "link", "add", device, *_SAME, "type", "veth", "peer", "name", DEVICE, *_SAME, "netns", there
                )
                _only_packets(device)
                bring_up(device, mtu=plan["mtu"])
                add_route(device, ADDRESSES[which])
        for which, network in enumerate(self.networks):
            with inside(network):
                _host(which, plan)

    def prepare(self, plan: Plan) -> None:
        from testbed.channel.kernel.netem import netem_arguments
        from testbed.scenario.links import Impairments

        with inside(self._middle):
            for direction, device in _OUT.items():
                words = netem_arguments(Impairments.model_validate(plan[direction]["impairments"]))
                if words:
                    _tool("tc", "qdisc", "add", "dev", device, "root", "netem", *words)

    def serve(self, others: dict[int, Callable[[], bool]]) -> None:
        while all(others[fd]() for fd in select.select([*others], (), ())[0]):
            pass

    def change(self, direction: str, impairments: dict[str, Any]) -> None:
        raise NotImplementedError  # refused by the owner

    def begin(self, impairments: dict[str, Any]) -> None:
        raise NotImplementedError  # refused by the owner

    def books(self) -> dict[str, dict[str, int]]:
        """Of each way, from the counters of devices and queues; netem does not tell which packets it corrupted."""
        with inside(self._middle):
            links = {link["ifname"]: link for link in json.loads(_tool("ip", "-s", "-j", "link", "show"))}
            queues = {queue["dev"]: queue for queue in json.loads(_tool("tc", "-s", "-j", "qdisc", "show"))}
        return {direction: _books(links, queues.get(_OUT[direction]), direction) for direction in _OUT}

    def end(self) -> None:
        """The kernel takes all of it back with the last of this process' file descriptors."""


def _host(which: int, plan: Plan) -> None:
    only_ipv4()
    _only_packets(DEVICE)
    bring_up("lo")
    bring_up(DEVICE, mtu=plan["mtu"])
    add_address(DEVICE, ADDRESSES[which])
    add_route(DEVICE, ADDRESSES[1 - which], plan["congestion"][which])


def _only_packets(device: str) -> None:
    """No ARP; no segmentation offload, which would let netem lose many packets at once."""
    _tool("ip", "link", "set", device, "arp", "off", "gso_max_segs", "1")


def _tool(*command: str) -> str:
    done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
    if done.returncode:
        raise Refused(f"netem: {' '.join(command[:3])}: {' '.join(done.stderr.split())}")
    return done.stdout


def _books(links: dict[str, Any], queue: dict[str, Any] | None, direction: str) -> dict[str, int]:
    sent = links[_IN[direction]]["stats64"]["rx"]["packets"]
    delivered = links[_OUT[direction]]["stats64"]["tx"]["packets"]
    dropped, waiting = (queue["drops"], queue["qlen"]) if queue is not None else (0, 0)
    return {
        "sent": sent,
        "delivered": delivered,
        "dropped": dropped,
        "duplicated": delivered + dropped + waiting - sent,
        "in_flight": waiting,
    }
