"""The documentation names files, modules and jobs that exist, and its Python examples import."""

import ast
import importlib
import re
import shlex
from pathlib import Path

import pytest

from jobs.command_line.cli import parse

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
JOBS = {path.stem for path in (ROOT / "jobs").glob("*.py")} - {"__init__"}
MOST_README_LINES = 160


def blocks(page: Path, language: str) -> list[str]:
    """The code blocks of a page."""
    return re.findall(rf"```{language}\n(.*?)```", page.read_text(), re.DOTALL)


def test_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text().splitlines()) <= MOST_README_LINES


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_docs_links_exist(page: Path) -> None:
    targets = re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text())
    assert not [target for target in targets if not (page.parent / target).exists()]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_docs_paths_exist(page: Path) -> None:
    """Paths that begin with a package's folder."""
    pattern = r"\b((?:pipeline|model|jobs|tests|benchmarks)/[a-z0-9_/]+\.py)\b"
    assert not [
        path for path in re.findall(pattern, page.read_text()) if not (ROOT / path).exists()
    ]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_docs_jobs_exist(page: Path) -> None:
    assert set(re.findall(r"^pvda (\w+)", page.read_text(), re.MULTILINE)) <= JOBS


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_docs_examples_import(page: Path) -> None:
    for code in blocks(page, "python"):
        for node in ast.walk(ast.parse(code)):
            if isinstance(node, ast.ImportFrom) and node.module:
                module = importlib.import_module(node.module)
                assert not [one.name for one in node.names if not hasattr(module, one.name)]


def test_makefile_commands_parse() -> None:
    """Those of `make region`, by the jobs' own parsers."""
    calls = re.findall(
        r"^\t\$\(BIN\)/pvda (\w+) (.*)", (ROOT / "Makefile").read_text(), re.MULTILINE
    )
    assert [job for job, _ in calls] == ["town", "fly", "adapt", "locate"]
    for job, words in calls:
        assert parse(importlib.import_module(f"jobs.{job}").main, shlex.split(words))


def test_map_names_every_room_and_its_files() -> None:
    rows = re.findall(
        r"^\| `(\w+)` \|.*\| (.*) \|$", (ROOT / "docs/map.md").read_text(), re.MULTILINE
    )
    rooms = {path.parent.name for path in (ROOT / "pipeline").glob("*/__init__.py")}
    assert {room for room, _ in rows} == rooms
    for room, begin in rows:
        for name in re.findall(r"`([\w/]+\.py)`", begin):
            assert (ROOT / "pipeline" / room / name).exists()
