"""From files and the user's words to an import: which format, which way to tell what was lost."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from testbed.channel.capture.flows import Filter, read_capture
from testbed.channel.capture.frames import is_capture
from testbed.channel.capture.imported import Imported
from testbed.channel.capture.numbered import Numbering, echoes, matched, received
from testbed.channel.capture.pairing import Match, paired
from testbed.channel.capture.ping import ping_log
from testbed.errors import UsageError

Format = Literal["auto", "capture", "ping"]
_LINE_MAX = 1000


@dataclass(frozen=True)
class Wish:
    """How to read it. receiver: a second capture, of where the packets arrive. interval_ns: of a ping without times."""

    format: Format = "auto"
    receiver: Path | None = None
    wanted: Filter = field(default_factory=Filter)
    numbering: Numbering | None = None
    match: Match = "packet"
    interval_ns: int | None = None


def import_trace(path: Path, wish: Wish) -> Imported:
    """The rows of a capture, of a pair of them, or of a ping's log. Raises UsageError."""
    if _format(path, wish.format) == "ping":
        if wish.receiver is not None or wish.numbering is not None or wish.wanted != Filter():
            raise UsageError(f"{path}: got a log of ping; allowed with it: --interval and no other option")
        try:
            with path.open(encoding=_encoding(path), errors="replace") as file:
                lines = iter(lambda: file.readline(_LINE_MAX), "")
                return ping_log(lines, str(path), wish.interval_ns)
        except OSError as error:
            raise _unreadable(path, error) from None
    if wish.interval_ns is not None:
        raise UsageError(f"--interval: {path} is a capture, which has times; allowed: only with a log of ping")
    sender = read_capture(path, wish.wanted)
    if wish.receiver is not None:
        receiver = read_capture(wish.receiver, Filter() if wish.match == "payload" else wish.wanted)
        if wish.numbering is not None:
            return matched(sender, receiver, wish.numbering)
        return paired(sender, receiver, wish.match)
    if wish.numbering is not None:
        return received(sender, wish.numbering)
    found = echoes(sender)
    if found is None:
        raise UsageError(
            f"{path}: got one capture without pings, which does not show what was lost; allowed: a second one with "
            "--receiver FILE, or a number in the packets with --rtp or --sequence OFFSET:BYTES"
        )
    return found


def _format(path: Path, asked: Format) -> Format:
    if asked != "auto":
        return asked
    try:
        with path.open("rb") as file:
            return "capture" if is_capture(file.read(4)) else "ping"
    except OSError as error:
        raise _unreadable(path, error) from None


def _encoding(path: Path) -> str:
    """UTF-8, but for the files that PowerShell's redirection writes."""
    with path.open("rb") as file:
        return "utf-16" if file.read(2) in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"


def _unreadable(path: Path, error: OSError) -> UsageError:
    return UsageError(f"cannot read {path}: {(error.strerror or str(error)).lower()}")
