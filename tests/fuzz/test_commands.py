"""Random command lines: each job exits with 0, 1 or 2 and one sentence.

No job writes beside its output. The inputs are such that no job can start its work: missing, empty,
files for folders, folders for files, junk of the right name.
"""

import importlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given

from jobs.command_line import cli
from jobs.command_line.config import Choice
from tests.fuzz.bounds import bounded, examples
from tests.fuzz.command_lines import line


def job_of(name: str) -> tuple[Callable[..., Any], Choice | None]:
    module = importlib.import_module(f"jobs.{name}")
    choice = {"make_shards": "SOURCE", "train": "RECIPE"}.get(name)
    return module.main, getattr(module, choice) if choice else None


def call(
    name: str,
    arguments: list[str],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> tuple[int, str]:
    """Exit code, and the text of the error stream."""
    job, choice = job_of(name)
    monkeypatch.setattr("sys.argv", [name, *arguments])
    capsys.readouterr()
    code: Any = 0
    with bounded(megabytes=600, seconds=20):
        try:
            cli.run(job, choice)
        except SystemExit as ended:
            code = ended.code or 0
    return code, capsys.readouterr().err


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with one thing of each kind that an input may wrongly be."""
    inner = tmp_path / "here"
    (inner / "empty").mkdir(parents=True)
    (inner / "junk").mkdir()
    (inner / "file").write_bytes(b"junk" * 100)
    for junk in (
        "manifest.json",
        "index.json",
        "part.parquet",
        "last.pt",
        "evaluation.json",
        "metrics.json",
        "queries.parquet",
        "calibration.json",
        "locations.csv",
        "a.jpg",
        "a.tif",
        "x.tar",
        "simulation.json",
    ):
        (inner / "junk" / junk).write_bytes(b"[]" if junk.endswith("json") else b"junk")
    (inner / "link").symlink_to("junk")
    (inner / "loop").symlink_to("loop")
    monkeypatch.chdir(inner)
    monkeypatch.setenv("RAY_ADDRESS", "nowhere:1")  # none gets as far as to look for it
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    return inner


def test_command_of_any_words_ends_with_a_short_error(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    above = set(folder.parent.iterdir())

    @given(line())
    @examples(120)
    def check(command: tuple[str, list[str]]) -> None:
        code, message = call(*command, capsys, monkeypatch)
        assert code in (0, 1, 2), f"{command}: {code}"
        assert "Traceback" not in message, message
        if code:
            assert message.strip(), command
        assert set(folder.parent.iterdir()) == above, command
        assert (folder / "file").read_bytes() == b"junk" * 100
        assert os.path.islink(folder / "link")

    check()
