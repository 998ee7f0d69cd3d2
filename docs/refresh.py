"""Write anew, in the pages, what the commands and the Python of their blocks print: after a change that moves figures.

    PYTHONPATH=tests python docs/refresh.py

What stands for any text stays so. Read what it changed before you commit it: the words around a figure may not fit it
any more.
"""

from __future__ import annotations

import os
import re
import shutil
import tempfile
from pathlib import Path
from typing import Any

from docs.blocks import PAGES, ROOT, Block, blocks_of, matches
from docs.test_docs import execute, run_python


def refreshed(shown: str, actual: str) -> str:
    """``shown`` with the lines of ``actual``, and "…" where it was."""
    if matches(shown, actual):
        return shown
    rest, out, skipping = actual.replace("\u2009", " ").splitlines(), [], False
    for line in shown.splitlines():
        if line.strip() == "…":
            out.append(line)
            skipping = True
            continue
        word = line.split("…")[0].split(" ")[0]
        while skipping and rest and not (word and rest[0].startswith(word)):
            rest.pop(0)
        found, skipping = (rest.pop(0).rstrip() if rest else ""), False
        out.append(line if matches(line, found) else _with_gaps(line, found))
    if not skipping and (not out or out[-1].strip() != "…"):
        out += [line.rstrip() for line in rest]
    return "".join(f"{line}\n" for line in out)


def _with_gaps(shown: str, found: str) -> str:
    """A new line with "…" in place of the words that had it."""
    gaps = [i for i, word in enumerate(shown.split()) if "…" in word]
    words = re.split(r"( +)", found)
    for gap in gaps:
        if 2 * gap < len(words):
            words[2 * gap] = "…"
    return "".join(words)


def refresh(page: Path) -> bool:
    """Whether the page changed; its commands run in the current folder."""
    text = before = page.read_text(encoding="utf-8")
    namespace: dict[str, Any] = {"__name__": page.stem}
    printed = ""
    for block in blocks_of(page):
        verb, _, rest = block.directive.partition(" ")
        if verb == "file:":
            Path(rest).write_text(block.text)
        elif verb == "copy:":
            Path(Path(rest).name).write_text(block.text)
        elif verb == "run" and block.language == "python":
            printed = run_python(block, namespace, page.name)
        elif verb == "output":
            text = text.replace(block.text, refreshed(block.text, printed))
        elif verb == "run":
            text = text.replace(block.text, _console(block))
    page.write_text(text, encoding="utf-8")
    return text != before


def _console(block: Block) -> str:
    head, *commands = block.text.split("$ ")
    out = head
    for text in commands:
        command, _, shown = text.partition("\n")
        out += f"$ {command}\n{refreshed(shown, execute(command)[1])}"
    return out


def main() -> None:
    os.environ["COLUMNS"] = "80"
    for page in PAGES:
        with tempfile.TemporaryDirectory() as folder:
            shutil.copytree(ROOT / "scenarios", Path(folder) / "scenarios")
            os.chdir(folder)
            if refresh(page):
                print(f"changed: {page.relative_to(ROOT)}")
            os.chdir(ROOT)


if __name__ == "__main__":
    main()
