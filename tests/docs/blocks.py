"""The blocks of a Markdown page, with the comments that say what to do with them; see CONTRIBUTING.md."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])


@dataclass(frozen=True)
class Block:
    """One fenced block. ``directive``: the words of the comment right before it, "" if there is none."""

    language: str
    directive: str
    text: str
    line: int


def blocks_of(page: Path) -> Iterator[Block]:
    lines = page.read_text(encoding="utf-8").splitlines()
    start = None
    for number, line in enumerate(lines):
        if not line.startswith("```"):
            continue
        if start is None:
            start = number
            continue
        comment = re.fullmatch(r"<!-- (.*) -->", lines[start - 1]) if start else None
        text = "".join(f"{inner}\n" for inner in lines[start + 1 : number])
        yield Block(lines[start].removeprefix("```"), comment[1] if comment else "", text, start + 1)
        start = None


def matches(shown: str, actual: str) -> bool:
    """Whether an output is as shown: "…" alone on a line stands for any lines, within a line for any text.

    Thin spaces count as spaces, and those at the end of a line do not count.
    """
    pattern, actual = "", actual.replace("\u2009", " ")
    for line in shown.splitlines():
        if line.strip() == "…":
            pattern += r"(?:.*\n)*?"
        else:
            pattern += ".*?".join(re.escape(part) for part in line.rstrip().split("…")) + r" *\n"
    return re.fullmatch(pattern, actual.rstrip("\n") + "\n" if actual.strip() else "") is not None
