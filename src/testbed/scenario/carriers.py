"""What carries the messages of a link: datagrams, or a connection that retransmits. See testbed.channel.carriers."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from testbed.scenario.base import COUNT_MAX, Count, Part, problem, shown
from testbed.scenario.durations import Duration, DurationOrZero, parse_duration

UDP_HEADER_BYTES = 8
IP_HEADER_BYTES = 20
MTU_LEAST = 68
"""Of IPv4 (RFC 791)."""


class UdpTransport(Part):
    """Datagrams: best effort. A message of more than the MTU is cut into IP fragments, and all of them must arrive."""

    kind: Literal["udp"] = Field(default="udp", description="Kind of transport.")
    mtu: int = Field(default=1500, ge=MTU_LEAST, le=65535, description="Largest IP packet, bytes.")
    late: Literal["drop", "deliver"] = Field(
        default="drop",
        description="What becomes of a message that a newer one has overtaken; drop: it is lost, as zenoh does.",
    )
    framing_bytes: int = Field(
        default=13, ge=0, le=65535, description="Bytes that the application's protocol adds to a message; zenoh: 13."
    )


class TcpTransport(Part):
    """A connection: in order and reliable by retransmission, as the Linux kernel does it.

    It is open at the start. It closes when a message has waited `blocked_limit` for room in the buffer, or when
    nothing was acknowledged for `lease`; what was not delivered is lost then. Opening it again takes
    `handshake_round_trips`, each repeated until it succeeds; after `open_limit` the attempt is given up, and the next
    one begins `retry` later. The defaults are those of Linux and of zenoh.
    """

    kind: Literal["tcp"] = Field(default="tcp", description="Kind of transport.")
    mss: int = Field(default=1448, ge=16, le=65495, description="Most bytes of the stream in a segment.")
    congestion: Literal["cubic", "reno"] = Field(default="cubic", description="Congestion control.")
    delayed_ack: DurationOrZero = Field(
        default="0 s",
        description="How long an acknowledgement may wait for a second segment; 0: each segment is acknowledged at "
        "once, as Linux does when the application reads it at once and sends nothing back.",
    )
    keep_alive: DurationOrZero = Field(
        default="0 s",
        description="With delayed_ack: how often the receiving end sends something of its own. Linux delays "
        "acknowledgements only from then on until a segment comes twice; 0: it always does. For zenoh, "
        "delayed_ack = '40 ms' and keep_alive = '2.5 s'.",
    )
    framing_bytes: int = Field(
        default=13, ge=0, le=65535, description="Bytes that the application's protocol adds to a message; zenoh: 13."
    )
    buffer_bytes: Count = Field(
        default=131072, description="Bytes that the sender holds: not yet sent, or not yet acknowledged."
    )
    when_full: Literal["block", "drop"] = Field(
        default="block", description="What a message does that finds the buffer full: it waits, or it is dropped."
    )
    waiting_max: int = Field(
        default=65536, ge=0, le=COUNT_MAX, description="Messages that may wait for room; further ones are dropped."
    )
    blocked_limit: Duration = Field(
        default="5 s", description="A message that has waited so long for room closes the connection."
    )
    lease: Duration = Field(default="10 s", description="So long without an acknowledgement closes the connection.")
    handshake_round_trips: Annotated[int, Field(ge=1, le=16)] = Field(
        default=3, description="Round trips to open the connection: one of TCP, two of zenoh."
    )
    open_limit: Duration = Field(default="10 s", description="An attempt to open that takes longer is given up.")
    retry: DurationOrZero = Field(default="1 s", description="Pause before the next attempt.")

    @model_validator(mode="after")
    def _message_fits(self) -> "TcpTransport":
        if self.buffer_bytes < self.mss:
            raise problem(
                f"got {shown(self.buffer_bytes)}; allowed: at least mss, which is {shown(self.mss)}", "buffer_bytes"
            )
        return self

    @model_validator(mode="after")
    def _delayed_with_keep_alive(self) -> "TcpTransport":
        if parse_duration(self.keep_alive, zero=True) and not parse_duration(self.delayed_ack, zero=True):
            raise problem(f"got {shown(self.keep_alive)} without delayed_ack; allowed: only with it", "keep_alive")
        return self


LinkTransport = Annotated[UdpTransport | TcpTransport, Field(discriminator="kind")]
"""The key `transport` of a link's table."""
