"""What became of the messages that did not arrive, as far as the books of the packets tell."""

from __future__ import annotations

from collections.abc import Mapping


def accounted(
    missing: int, each: int, packets: Mapping[str, int], *, refused: int, in_flight: int | None
) -> dict[str, int]:
    """Lane-packets that are missing, by "in_flight" and "dropped_CAUSE".

    each: lanes of a message. packets: books of the forward direction. refused: messages that were never sent.
    in_flight: messages that are under way, where that is known; None: as many as packets are. A packet is taken for a
    message: what is left over, such as losses in the sessions or the system, has the cause "elsewhere".
    """
    out: dict[str, int] = {}
    rest = missing

    def take(name: str, messages: int) -> None:
        nonlocal rest
        taken = min(rest, each * messages)
        rest -= taken
        if taken:
            out[name] = out.get(name, 0) + taken

    take("dropped_full", refused)
    take("in_flight", packets.get("in_flight", 0) if in_flight is None else in_flight)
    if in_flight is None:
        for key, count in sorted(packets.items()):
            if key.startswith("dropped_"):
                take(key, count)
        if "dropped_corrupt" not in packets:
            take("dropped_corrupt", packets.get("corrupted", 0))
    take("dropped_elsewhere", rest)
    return out
