"""Two runs on one output: the second is refused while the first lives, and not a moment longer."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from pipeline.core.errors import InputError
from pipeline.core.lock import locks_output, output_lock

ROOT = Path(__file__).parents[2]
HOLDER = """
import sys, time
from pipeline.core.lock import output_lock
with output_lock(sys.argv[1]):
    print("locked", flush=True)
    time.sleep(60)
"""


@contextmanager
def locked_elsewhere(out: Path) -> Iterator["subprocess.Popen[str]"]:
    """Another process that holds the lock of a folder."""
    with subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(out)], cwd=ROOT, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "locked\n"
        try:
            yield other
        finally:
            other.kill()


def test_lock_refuses_a_second_run_and_names_the_first(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with locked_elsewhere(out) as other:
        sentence = rf"is being written by process {other.pid}, since 2.*wait until it has ended"
        with pytest.raises(InputError, match=sentence), output_lock(str(out)):
            pass
        with output_lock(str(tmp_path / "another")):
            assert not out.exists()


def test_lock_of_a_killed_run_is_free(tmp_path: Path) -> None:
    with locked_elsewhere(tmp_path) as other:
        os.kill(other.pid, signal.SIGKILL)
        other.wait()
        with output_lock(str(tmp_path)):
            pass


def test_lock_knows_a_folder_by_all_its_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "out")
    monkeypatch.chdir(tmp_path)
    with output_lock("out"):
        for name in (f"{tmp_path}/out/", f"file://{tmp_path}/out", f"{tmp_path}/link"):
            with pytest.raises(InputError, match="one run at a time"), output_lock(name):
                pass
    with output_lock(f"{tmp_path}/link"):
        pass


def test_stage_holds_the_lock_only_while_it_runs(tmp_path: Path) -> None:
    @locks_output(lambda number, out: out)
    def stage(number: int, out: str) -> int:
        with pytest.raises(InputError, match="one run at a time"), output_lock(out):
            pass
        if number < 0:
            raise ValueError
        return number

    assert stage(3, str(tmp_path)) == 3
    with pytest.raises(ValueError):  # noqa: PT011
        stage(-1, str(tmp_path))
    assert stage(4, out=str(tmp_path)) == 4


def test_object_stores_have_no_locks() -> None:
    with output_lock("memory://out"), output_lock("memory://out"):
        pass
