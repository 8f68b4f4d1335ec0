"""A killed build resumes with the work units that are done, and no work of another plan."""

import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from pipeline.core.errors import InputError
from pipeline.index import build as index_build
from pipeline.index import workspace
from pipeline.index.searcher import Index
from tests.index.index_tables import answers, build, write_gallery

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> str:
    """1,000 satellite rows of the gallery in five parts and 40 UAV queries, of 32 dimensions."""
    return str(write_gallery(tmp_path_factory.mktemp("table"), parts=5, dtype="float16"))


KILLED = """
    import os, signal, sys
    from pipeline.index import workspace as index_work
    from pipeline.index.planning import plan as index_plan
    from pipeline.index.build import build_index
    from pipeline.index.settings import IndexSettings
    from pipeline.core.records import Split, View
    index_plan.MIN_UNIT_ROWS, index_plan.UNIT_SHARE = 250, 0
    calls = 0
    def dying(name):
        original = getattr(index_work, name)
        def call(*arguments):
            global calls
            calls += 1
            if calls == int(sys.argv[4]):
                os.kill(os.getpid(), signal.SIGKILL)
            return original(*arguments)
        setattr(index_work, name, call)
    dying(sys.argv[3])
    build_index(IndexSettings(
        table=sys.argv[1], out=sys.argv[2], split=Split.GALLERY, view=View.SATELLITE,
        target_recall=0.5, factory="IVF8,SQ8",
    ))
"""


@pytest.mark.parametrize(
    ("at", "nth", "left"),
    [("build_unit", 1, 0), ("build_unit", 3, 2), ("merge_units", 1, 4), ("write_ids", 1, 4)],
)
def test_build_killed_resumes_to_the_same_answers(
    table: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at: str, nth: int, left: int
) -> None:
    """SIGKILL before the n-th call; the next run does not repeat finished work."""
    out = tmp_path / "index"
    script = tmp_path / "build.py"
    script.write_text(textwrap.dedent(KILLED))
    root = Path(__file__).parents[2]
    killed = subprocess.run(
        [sys.executable, script, table, out, at, str(nth)],
        env={**os.environ, "PYTHONPATH": str(root)},
        check=False,
        capture_output=True,
    )
    assert killed.returncode == -signal.SIGKILL, killed.stderr.decode()
    with pytest.raises(InputError, match="no index at"):
        Index(str(out))
    done = sorted((out / "_building").glob("unit-*.faiss"))
    assert len(done) == left
    before = {unit: unit.stat().st_mtime_ns for unit in done}
    monkeypatch.setattr("pipeline.index.planning.plan.MIN_UNIT_ROWS", 250)
    monkeypatch.setattr("pipeline.index.planning.plan.UNIT_SHARE", 0)
    monkeypatch.setattr(
        workspace.BuildWorkspace, "clear", lambda self: None
    )  # to look at the units afterwards
    resumed = build(table, out, factory="IVF8,SQ8")
    assert {unit: unit.stat().st_mtime_ns for unit in done} == before
    assert answers(resumed, table) == answers(
        build(table, tmp_path / "calm", factory="IVF8,SQ8"), table
    )


def test_build_does_not_resume_another_plan(
    table: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "index"
    monkeypatch.setattr(index_build, "finish_index", lambda *arguments: pytest.fail("stopped here"))
    with pytest.raises(pytest.fail.Exception):
        build(table, out, factory="IVF8,SQ8")
    monkeypatch.undo()
    assert (out / "_building" / "unit-000000.faiss").exists()
    index = build(table, out, factory="IVF4,Flat")
    assert index.metadata.factory == "IVF4,Flat"
    assert not (out / "_building").exists()
    assert answers(index, table) == answers(
        build(table, tmp_path / "other", factory="IVF4,Flat"), table
    )
