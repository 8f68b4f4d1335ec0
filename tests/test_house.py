"""The layout, checked on the source: who may import whom, and how large files, lines and names are.

Rooms are folders of `pipeline/`. A room may import itself, the rooms below all others (`core`,
`images`, `camera`), and what `MAY_IMPORT` lists for it.
"""

import ast
import re
from collections import Counter
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parent.parent
PACKAGES = ("pipeline", "model", "jobs")
SOURCES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
TESTS = sorted((ROOT / "tests").rglob("*.py"))
ROOMS = sorted({path.parent for path in SOURCES})
ALL = [*SOURCES, *TESTS, *sorted((ROOT / "benchmarks").rglob("*.py"))]
TOP = {"pipeline": {"pipeline"}, "model": {"model"}, "jobs": {"jobs", "pipeline", "model"}}
FOREIGN_TO_MODEL = {"ray", "webdataset", "pyarrow", "faiss", "fsspec"}

BELOW_ALL = {"core", "images", "camera"}
MAY_IMPORT: dict[str, set[str]] = {
    "core": set(),
    "images": {"core"},
    "camera": {"core"},
    "sources": BELOW_ALL,
    "simulation": BELOW_ALL | {"sources"},
    "shards": BELOW_ALL | {"sources"},
    "batches": BELOW_ALL | {"shards"},
    "features": BELOW_ALL | {"shards", "batches"},
    "index": BELOW_ALL | {"features"},
    "confidence": BELOW_ALL,
    "matching": BELOW_ALL | {"confidence"},
    "locate": BELOW_ALL | {"index", "matching", "confidence"},
    "service": BELOW_ALL | {"locate", "index", "matching", "simulation"},
    "region": BELOW_ALL | {"locate", "index", "matching", "simulation"},
    "retrieval": BELOW_ALL | {"features"},
    "report": BELOW_ALL | {"retrieval"},
    "evaluation": BELOW_ALL | {"report", "retrieval", "features", "shards"},
}
ONLY_FROM = {
    ("shards", "sources"): {"pack", "pack_tars", "writer", "duplicates", "repair"},
    ("features", "shards"): {"embed", "embed_worker"},
    ("features", "batches"): {"embed", "embed_worker"},
}
"(room, room it imports) -> the only modules that may."

MOST_LINES, MOST_COLUMNS, MOST_FILES, LONGEST_TEST_NAME = 300, 100, 16, 60
MOST_JOBS = 20
"Entry scripts: each is a door of its own, and `pvda --help` lists them."


def module_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


KNOWN = {module_of(path) for path in SOURCES}


@cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


@cache
def imports_of(path: Path) -> tuple[str, ...]:
    """Every module that a file imports, wherever in the file."""
    return tuple(_imports_of(path))


def _imports_of(path: Path) -> Iterator[str]:
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name} imports relatively"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def own_module(name: str) -> str:
    """The longest prefix of a dotted name that is a module of this project, else ""."""
    parts = name.split(".")
    prefixes = (".".join(parts[:end]) for end in range(len(parts), 0, -1))
    return next((prefix for prefix in prefixes if prefix in KNOWN), "")


def room_of(module: str) -> str:
    """The room of a module of `pipeline`, else ""."""
    parts = module.split(".")
    return parts[1] if parts[0] == "pipeline" and len(parts) > 1 else ""


def public_names(path: Path) -> list[str]:
    """The names without an underscore that a module defines at its top."""
    names: list[str] = []
    for node in parsed(path).body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            names.append(node.name)
        elif isinstance(node, ast.Assign):
            targets = [part for target in node.targets for part in ast.walk(target)]
            names += [part.id for part in targets if isinstance(part, ast.Name)]
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            names.append(node.target.id)
    return [name for name in names if not name.startswith("_")]


def test_packages_import_in_one_direction() -> None:
    for path in SOURCES:
        own = path.relative_to(ROOT).parts[0]
        reached = {name.split(".")[0] for name in imports_of(path)}
        assert reached & set(PACKAGES) <= TOP[own], module_of(path)
        assert own != "model" or not reached & FOREIGN_TO_MODEL, module_of(path)


def test_rooms_import_by_the_table() -> None:
    for path in SOURCES:
        own = room_of(module_of(path))
        if not own:
            alone = path.parts[-2] == "pipeline" and path.name != "__init__.py"
            assert not alone, f"{path} is a module outside rooms"
            continue
        reached = {room_of(own_module(name)) for name in imports_of(path)} - {"", own}
        assert reached <= MAY_IMPORT[own], module_of(path)
        for room in reached:
            assert path.stem in ONLY_FROM.get((own, room), {path.stem}), module_of(path)


def test_there_is_no_import_cycle() -> None:
    graph = {
        module_of(path): {own_module(name) for name in imports_of(path)} - {"", module_of(path)}
        for path in SOURCES
    }
    # A package's own __init__ stands for its modules where names are imported from it.
    assert list(TopologicalSorter(graph).static_order())


def test_rooms_depend_on_each_other_without_a_cycle() -> None:
    assert list(TopologicalSorter(MAY_IMPORT).static_order())


def test_a_file_fits_one_sitting() -> None:
    for path in ALL:
        text = path.read_text()
        assert text.count("\n") <= MOST_LINES, path
        assert max(map(len, text.split("\n"))) <= MOST_COLUMNS, path
        assert path.name not in {"utils.py", "common.py", "helpers.py"}
        if path.name != "__init__.py" or path in SOURCES:
            assert ast.get_docstring(parsed(path)), f"{path} has no module docstring"


def test_a_room_has_a_door_and_no_crowd() -> None:
    for room in ROOMS:
        files = [path for path in room.glob("*.py") if path.name != "__init__.py"]
        assert len(files) <= (MOST_JOBS if room.name == "jobs" else MOST_FILES), room
        door = ast.get_docstring(parsed(room / "__init__.py")) or ""
        assert len(door.splitlines()) >= (5 if room.parent.name == "pipeline" else 1), room


def test_a_public_name_is_unique_within_its_room() -> None:
    for room in ROOMS:
        if room.name == "jobs":  # each entry script has its own main and Settings
            continue
        files = sorted(room.glob("*.py"))
        names = Counter(name for path in files for name in set(public_names(path)))
        assert not [name for name, count in names.items() if count > 1], room


def test_a_test_name_is_short() -> None:
    for path in TESTS:
        names = [name for name in public_names(path) if name.startswith("test_")]
        assert not [name for name in names if len(name) > LONGEST_TEST_NAME], path
        assert len(names) == len(set(names)), f"a test of {path} hides another of the same name"


def test_importing_a_job_does_nothing() -> None:
    """At a module's top stand imports, definitions, constants and the guard: no bare call."""
    for path in (ROOT / "jobs").glob("*.py"):
        for node in parsed(path).body:
            call = isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)
            assert not call, path


def test_every_dependency_says_why() -> None:
    text = (ROOT / "pyproject.toml").read_text()
    lines = [
        line for line in text.splitlines() if re.match(r'\s+"[a-z0-9-]+(\[[a-z,]+\])?>=', line)
    ]
    assert len(lines) > 10
    assert all("#" in line for line in lines)


def test_every_dependency_is_pinned() -> None:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pinned = {line.split("==")[0].lower() for line in lines if "==" in line}
    text = (ROOT / "pyproject.toml").read_text()
    wanted = set(re.findall(r'^\s+"([a-z0-9-]+)(?:\[[a-z,]+\])?>=', text, re.MULTILINE))
    assert wanted - {"setuptools"} <= pinned
