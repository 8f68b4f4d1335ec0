"""The rules of the house, read off the source: who may import whom, and that the README's tree is the real one."""

import ast
import re
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("pipeline", "model", "jobs")
SOURCES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
ALLOWED = {"pipeline": {"pipeline"}, "model": {"model"}, "jobs": {"jobs", "pipeline", "model"}}
FOREIGN_TO_MODEL = {"ray", "webdataset", "pyarrow", "faiss", "fsspec"}
LONGEST = 300


def module_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def imports_of(path: Path) -> Iterator[str]:
    """Every module that a file imports, wherever in the file."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name} imports relatively"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def named(module: str) -> str:
    """The longest prefix of a dotted name that is a module of ours."""
    known = {module_of(path) for path in SOURCES}
    parts = module.split(".")
    return next((name for end in range(len(parts), 0, -1) if (name := ".".join(parts[:end])) in known), "")


@pytest.mark.parametrize("path", SOURCES, ids=module_of)
def test_arrows_run_from_jobs_to_pipeline_and_model_and_nowhere_else(path: Path) -> None:
    own = path.relative_to(ROOT).parts[0]
    reached = {name.split(".")[0] for name in imports_of(path)}
    assert reached & set(PACKAGES) <= ALLOWED[own]
    if own == "model":
        assert not reached & FOREIGN_TO_MODEL


def test_there_is_no_import_cycle() -> None:
    graph = {module_of(path): {named(name) for name in imports_of(path)} - {"", module_of(path)} for path in SOURCES}
    # A package's own __init__ stands for its modules where names are taken from it.
    assert list(TopologicalSorter(graph).static_order())


@pytest.mark.parametrize("path", SOURCES, ids=module_of)
def test_a_file_fits_one_sitting_and_says_what_it_is(path: Path) -> None:
    text = path.read_text()
    assert text.count("\n") <= LONGEST
    assert path.name not in {"utils.py", "common.py", "helpers.py"}
    assert ast.get_docstring(ast.parse(text)), "no module docstring"


@pytest.mark.parametrize("path", [path for path in SOURCES if path.parts[-2] == "jobs"], ids=module_of)
def test_importing_a_job_does_nothing(path: Path) -> None:
    """At a module's top stand imports, definitions, constants and the guard: no bare call."""
    calls = [
        node
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)
    ]
    assert not calls


def tree_of_readme() -> dict[str, str]:
    """Path -> its line in the README's file tree, folders with a slash at the end."""
    block = re.search(r"```tree\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert block, "README.md has no ```tree block"
    folders: list[str] = []
    listed = {}
    for line in block[1].splitlines():
        if not line.strip():
            continue
        depth = (len(line) - len(line.lstrip())) // 2
        name, _, what = line.strip().partition(" ")
        folders[depth:] = [name]
        listed["".join(folders[: depth + 1])] = what.strip()
    return listed


def test_the_readmes_tree_is_the_real_one() -> None:
    listed = tree_of_readme()
    folders = ("benchmarks", "docs")
    real = {path for path in SOURCES if path.name != "__init__.py"}
    real |= {path for folder in folders for path in (ROOT / folder).iterdir() if path.is_file()}
    said = {ROOT / path for path in listed if not path.endswith("/")}
    assert said - real == set(), "the README lists what is not there"
    assert real - said == set(), "the README leaves out what is there"
    assert all(listed.values()), "each line says what the file is"


def test_every_dependency_says_why() -> None:
    text = (ROOT / "pyproject.toml").read_text()
    lines = [line for line in text.splitlines() if re.match(r'\s+"[a-z0-9-]+(\[[a-z,]+\])?>=', line)]
    assert len(lines) > 10
    assert all("#" in line for line in lines)


def test_every_dependency_is_pinned() -> None:
    pinned = {
        line.split("==")[0].lower() for line in (ROOT / "constraints.txt").read_text().splitlines() if "==" in line
    }
    wanted = set(
        re.findall(r'^\s+"([a-z0-9-]+)(?:\[[a-z,]+\])?>=', (ROOT / "pyproject.toml").read_text(), re.MULTILINE)
    )
    assert wanted - {"setuptools"} <= pinned
