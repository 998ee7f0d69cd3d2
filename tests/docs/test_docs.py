"""The blocks of the documentation do what the pages say."""

from __future__ import annotations

import contextlib
import io
import shlex
import shutil
import signal
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from docs.blocks import PAGES, ROOT, Block, blocks_of, matches
from testbed.cli.main import run_command
from testbed.scenario import parse_scenario

SMALLEST = """
[system]
A = [[1.0]]
C = [[1.0]]
Q = [[1.0]]
R = [[1.0]]
"""
_NAMESPACES = ("kernel-links",)
"""Pages that make network namespaces."""
RUNNABLE = [
    pytest.param(page, marks=[pytest.mark.root] if page.stem in _NAMESPACES else [])
    for page in PAGES
    if any(b.directive.startswith(("run", "file", "copy", "part")) for b in blocks_of(page))
]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with the scenarios, searched for modules, a terminal of 80 columns; signal handlers as they were."""
    shutil.copytree(ROOT / "scenarios", tmp_path / "scenarios")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.syspath_prepend(tmp_path)
    modules = set(sys.modules)
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield tmp_path
    for name in set(sys.modules) - modules:
        if str(getattr(sys.modules[name], "__file__", None)).startswith(str(tmp_path)):
            del sys.modules[name]
    for number, handler in handlers.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("page", RUNNABLE, ids=lambda page: page.stem)
def test_blocks_run_as_shown(page: Path) -> None:
    namespace: dict[str, Any] = {"__name__": page.stem}
    printed = ""
    for block in blocks_of(page):
        where = f"{page.name}:{block.line}"
        verb, _, rest = block.directive.partition(" ")
        if verb == "file:":
            Path(rest).write_text(block.text)
            if "[system]" in block.text:
                parse_scenario(block.text, source=where)
        elif verb == "copy:":
            Path(Path(rest).name).write_text(block.text)
        elif verb == "part:":
            parse_scenario(SMALLEST + block.text, source=where)
        elif verb == "run" and block.language == "python":
            printed = run_python(block, namespace, where)
        elif verb == "run":
            run_console(block, int(rest.removeprefix("exit ") or 0), where)
        elif verb == "output":
            assert matches(block.text, printed), f"{where}: printed\n{printed}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_blocks_are_what_they_say(page: Path) -> None:
    for block in blocks_of(page):
        where = f"{page.name}:{block.line}"
        if block.language == "toml":
            tomllib.loads(block.text)
        if block.directive.startswith("same as: "):
            other = ROOT / block.directive.removeprefix("same as: ")
            assert block.text in other.read_text(encoding="utf-8"), f"{where} differs from {other.name}"
        if block.directive.startswith("copy: "):
            other = ROOT / block.directive.removeprefix("copy: ")
            assert block.text == other.read_text(encoding="utf-8"), f"{where} differs from {other.name}"
        known = ("", "run", "file:", "copy:", "part:", "output", "same")
        assert block.directive.partition(" ")[0] in known, f"{where}: unknown {block.directive!r}"


def run_python(block: Block, namespace: dict[str, Any], where: str) -> str:
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        exec(compile(block.text, where, "exec"), namespace)
    return out.getvalue()


def run_console(block: Block, last_code: int, where: str) -> None:
    """Run the lines that begin with "$"; what stands below each is its output."""
    commands = block.text.split("$ ")[1:]
    for number, text in enumerate(commands, 1):
        command, _, shown = text.partition("\n")
        code, output = execute(command)
        assert code == (last_code if number == len(commands) else 0), f"{where}: {command}: exit code {code}\n{output}"
        assert matches(shown, output), f"{where}: {command}: printed\n{output}"


def execute(command: str) -> tuple[int, str]:
    """Exit code and output of a command; those of the testbed run in this process, runs on the in-process bus.

    pip only notes the entry points of the package in the folder, as an editable installation does.
    """
    words = shlex.split(command)
    if command == "pip install --editable .":
        install()
        return 0, ""
    if words[0] != "testbed":
        done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, timeout=20, check=False)
        return done.returncode, done.stdout + done.stderr
    arguments = words[1:]
    if arguments[0] == "run" and not {"--external", "--in-process"} & set(arguments):
        arguments.append("--in-process")
    output = io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
        code = run_command(arguments)
    return code, output.getvalue()


def install() -> None:
    """The metadata that pip makes of pyproject.toml."""
    project = tomllib.loads(Path("pyproject.toml").read_text())["project"]
    info = Path(f"{project['name'].replace('-', '_')}-{project['version']}.dist-info")
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n")
    lines = []
    for group, points in project["entry-points"].items():
        lines += [f"[{group}]", *(f"{name} = {value}" for name, value in points.items())]
    (info / "entry_points.txt").write_text("\n".join(lines) + "\n")
