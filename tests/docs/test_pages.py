"""Links lead somewhere, generated pages are up to date, scenarios and examples are as described."""

from __future__ import annotations

import ast
import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest

from docs.blocks import PAGES, ROOT
from testbed.orchestrator.preflight import check_parts
from testbed.scenario import load_scenario

LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")


def prose_of(page: Path) -> str:
    return re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)


def anchors_of(page: Path) -> set[str]:
    headings = re.findall(r"^#+ (.*)$", prose_of(page), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    for target in LINK.findall(prose_of(page)):
        if target.startswith("https://"):
            continue
        path, _, anchor = target.partition("#")
        linked = (page.parent / path).resolve() if path else page
        assert linked.exists(), target
        assert not anchor or anchor in anchors_of(linked), target


def test_every_page_is_in_the_index_and_the_contents() -> None:
    index, contents = ((ROOT / "docs" / name).read_text() for name in ("index.md", "contents.md"))
    for page in (ROOT / "docs").rglob("*.md"):
        name = page.relative_to(ROOT / "docs").as_posix()
        if name not in ("index.md", "contents.md"):
            assert f"({name})" in index, name
            assert f"\n{name.removesuffix('.md')}\n" in contents, name


def test_generated_pages_are_up_to_date(capsys: pytest.CaptureFixture[str]) -> None:
    assert load(ROOT / "docs" / "generate.py").main(["--check"]) == 0, (
        f"{capsys.readouterr().out.strip()}; python docs/generate.py writes them anew"
    )


@pytest.mark.parametrize("path", sorted((ROOT / "scenarios").glob("*.toml")), ids=lambda path: path.stem)
def test_scenarios_can_run(path: Path) -> None:
    scenario = load_scenario(path)
    check_parts(scenario)
    assert scenario.name == path.stem


def test_every_reason_for_a_refusal_is_explained() -> None:
    text = "".join(path.read_text() for path in (ROOT / "src" / "testbed" / "wire").glob("*.py"))
    page = (ROOT / "docs" / "reference" / "errors.md").read_text()
    reasons = set(re.findall(r'Rejected\("(\w+)"', text))
    assert reasons
    assert [reason for reason in sorted(reasons) if f"`{reason}`" not in page] == []


def test_the_example_needs_zenoh_and_the_standard_library_only() -> None:
    source = (ROOT / "examples" / "print_estimates.py").read_text()
    names = {name.name.split(".")[0] for node in ast.walk(ast.parse(source)) for name in getattr(node, "names", ())}
    assert names - set(sys.stdlib_module_names) == {"zenoh"}
    assert len(source.splitlines()) <= 60


def load(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_estimator_of_the_tutorial_is_short() -> None:
    assert len((ROOT / "examples" / "own_estimator" / "fixed_gain.py").read_text().splitlines()) <= 40
