"""Building: whatever the units, the workers and the kills, the same index; nothing foreign, nothing
damaged.
"""

import json
import os
import signal
import subprocess
import sys
import textwrap
from dataclasses import replace
from pathlib import Path

import faiss
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.core import json_files, storage
from pipeline.core.errors import InputError
from pipeline.core.records import Split, View
from pipeline.features.table import open_table
from pipeline.index import build as index_build
from pipeline.index import workspace
from pipeline.index.build import build_index
from pipeline.index.faiss_io import read_faiss
from pipeline.index.plan import GallerySpec, IndexPlan, plan_index
from pipeline.index.searcher import Index
from pipeline.index.settings import IndexSettings, parse_bytes
from pipeline.index.units import even_groups, merge_units, plan_units
from tests.index.index_tables import clustered, write_gallery, write_table_part

MERGED = ["Flat", "SQ8", "IVF8,SQ8", "IVF8,PQ8x4fs", "IVF8,RaBitQ", "PCA16,IVF8,SQ8"]


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> str:
    """1,000 satellite rows of the gallery in five parts and 40 UAV queries, 32 dimensions, float16."""
    return str(write_gallery(tmp_path_factory.mktemp("table"), parts=5, dtype="float16"))


def build(source: str, out: Path, **changes: object) -> Index:
    given = {
        "table": source,
        "out": str(out),
        "split": Split.GALLERY,
        "view": View.SATELLITE,
        "target_recall": 0.5,
    }
    build_index(IndexSettings(**(given | changes)))  # type: ignore[arg-type]
    return Index(str(out))


def answers(index: Index, table: str) -> list[list[tuple[str, float]]]:
    found = index.search(open_table(table).select(Split.QUERY).embeddings(), 8)
    return [[(hit.key, round(hit.score, 5)) for hit in hits] for hits in found]


@pytest.mark.parametrize("factory", MERGED)
def test_build_by_units_equals_one_pass(
    table: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, factory: str
) -> None:
    whole = build(table, tmp_path / "whole", factory=factory)
    monkeypatch.setattr("pipeline.index.plan.MIN_UNIT_ROWS", 250)
    monkeypatch.setattr("pipeline.index.plan.UNIT_SHARE", 0)
    units = build(table, tmp_path / "units", factory=factory)
    assert units.metadata.unit_rows == 250
    assert len(units.metadata.parts) == 1
    assert answers(units, table) == answers(whole, table)


def test_build_by_ray_equals_one_process(
    table: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ray_cluster: None
) -> None:
    here = build(table, tmp_path / "here", factory="IVF8,SQ8")
    monkeypatch.setattr("pipeline.index.plan.MIN_UNIT_ROWS", 250)
    monkeypatch.setattr("pipeline.index.plan.UNIT_SHARE", 0)
    there = build(table, tmp_path / "there", factory="IVF8,SQ8", workers=2)
    assert (tmp_path / "there" / "index.faiss").read_bytes() == (
        tmp_path / "here" / "index.faiss"
    ).read_bytes()
    assert answers(there, table) == answers(here, table)


@pytest.mark.parametrize("factory", ["Flat", "HNSW16,SQ8", "IVF8,SQ8"])
def test_build_in_parts_answers_as_one(table: str, tmp_path: Path, factory: str) -> None:
    one, three = (
        build(table, tmp_path / f"{parts}", factory=factory, parts=parts, target_recall=1.0)
        for parts in (1, 3)
    )
    assert [part.rows for part in three.metadata.parts] == [400, 200, 400], (
        "whole parts of the table, about a third each"
    )
    assert (tmp_path / "3" / "index-000001.faiss").exists()
    assert (tmp_path / "3" / "ids-000001.parquet").exists()
    same = [
        len({*a} & {*b}) / 8
        for a, b in zip(answers(one, table), answers(three, table), strict=True)
    ]
    assert np.mean(same) == 1 if factory != "HNSW16,SQ8" else np.mean(same) > 0.95


KILLED = """
    import os, signal, sys
    from pipeline.index import plan as index_plan, workspace as index_work
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
    build_index(IndexSettings(table=sys.argv[1], out=sys.argv[2], split=Split.GALLERY, view=View.SATELLITE, target_recall=0.5,
                              factory="IVF8,SQ8"))
"""


@pytest.mark.parametrize(
    ("at", "nth", "left"),
    [("build_unit", 1, 0), ("build_unit", 3, 2), ("merge_units", 1, 4), ("write_ids", 1, 4)],
)
def test_build_killed_resumes_to_the_same_answers(
    table: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at: str, nth: int, left: int
) -> None:
    """SIGKILL before the n-th call; the next run does not do again what was done."""
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
    monkeypatch.setattr("pipeline.index.plan.MIN_UNIT_ROWS", 250)
    monkeypatch.setattr("pipeline.index.plan.UNIT_SHARE", 0)
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


def test_lists_on_disk_answer_as_in_memory(
    table: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def on_disk(gallery: object, on_disk: bool = True) -> IndexPlan:
        return IndexPlan(
            factory="IVF8,RaBitQ",
            refine="table",
            on_disk=on_disk,
            training_rows=500,
            unit_rows=250,
            part_rows=500,
            search_bytes=1,
            build_bytes=1,
            expected_recall=0.9,
            reason="",
        )

    monkeypatch.setattr(index_build, "plan_index", on_disk)
    mapped = build(table, tmp_path / "mapped")
    assert (mapped.metadata.on_disk, len(mapped.metadata.parts)) == (True, 2)
    monkeypatch.setattr(index_build, "plan_index", lambda gallery: on_disk(gallery, on_disk=False))
    read = build(table, tmp_path / "read")
    assert answers(mapped, table) == answers(read, table)
    kinds = [
        type(faiss.downcast_InvertedLists(index._parts[0].index.invlists)).__name__
        for index in (mapped, read)
    ]
    assert kinds == ["OnDiskInvertedLists", "ArrayInvertedLists"]


def test_build_passes_strong_directions_to_planner(tmp_path: Path) -> None:
    """Vectors in 16 of 64 directions: the projection keeps all of them, and inner products as they
    were.
    """
    vectors = np.zeros((3_000, 64), np.float32)
    vectors[:, 10:26] = clustered(3_000, 16, 5)
    write_table_part(tmp_path / "table", 0, vectors)
    told: list[int | None] = []

    def noted(gallery: GallerySpec) -> IndexPlan:
        told.append(gallery.effective_dimension)
        return plan_index(replace(gallery, rows=10**6))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(index_build, "plan_index", noted)
        index = build(
            str(tmp_path / "table"),
            tmp_path / "index",
            split=None,
            view=None,
            memory_budget="2GB",
            target_recall=0.9,
        )
    assert told == [None, 32]
    assert index.metadata.factory.startswith("PCA32,")
    assert index.metadata.measured["recall_at_10"] >= 0.9


def test_index_metadata_describes_the_build(table: str, tmp_path: Path) -> None:
    index = build(table, tmp_path / "index", factory="IVF8,SQ8", target_recall=0.9)
    facts = json.loads((tmp_path / "index" / "index.json").read_text())
    assert facts["rows"] == 1000
    assert facts["training_sample"] == 1000
    assert facts["recall_at_10"] >= 0.9
    assert facts["recall_queries"] == 40
    assert facts["recall_queries_from"] == "rows of the table that are not indexed"
    assert facts["queries_per_second"] > 0
    assert facts["build_seconds"] > 0
    assert 40 < facts["bytes_per_vector"] < 80
    assert facts["parts"][0]["table_parts"]["gallery-satellite-000000.parquet"] == "shard 0"
    assert index.metadata.search_params.nprobe_or_ef < 8, "no more lists than it takes"


def test_build_reports_unreachable_recall(
    table: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    index = build(table, tmp_path / "index", factory="IVF8,PQ2x4", target_recall=0.99)
    assert index.metadata.measured["recall_at_10"] < 0.99
    assert "with the most thorough search, below the target of 0.99" in capsys.readouterr().err


def test_build_of_all_rows_excludes_own_row_from_recall(table: str, tmp_path: Path) -> None:
    index = build(
        table, tmp_path / "index", factory="IVF8,PQ2x4", split=None, view=None, target_recall=0.99
    )
    assert (
        index.metadata.measured["recall_queries_from"]
        == "rows of the index, each looking for others"
    )
    assert index.metadata.measured["recall_at_1"] < 0.9


def test_build_finished_index_is_a_no_op(
    table: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "index"
    build(table, out)
    before = (out / "index.faiss").stat().st_mtime_ns
    build(table, out)
    assert "nothing to do" in capsys.readouterr().err
    assert (out / "index.faiss").stat().st_mtime_ns == before
    for changes in ({"split": Split.QUERY, "view": None}, {"factory": "SQ8"}):
        with pytest.raises(InputError, match="holds an index of other rows or settings"):
            build(table, out, **changes)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        (
            {"view": View.STREET},
            "holds 1000 gallery satellite, 40 query drone and none of it was asked for",
        ),
        ({"factory": "Nonsense"}, "which FAISS cannot build over 32 dimensions"),
        ({"factory": "IVF4096,SQ8"}, "which FAISS cannot train on 1000 rows"),
        ({"memory_budget": "1MB"}, "raise --memory-budget"),
        ({"memory_budget": "lots"}, "expected a number with KB, MB, GB or TB"),
        ({"target_recall": 1.5}, "expected a fraction"),
        ({"parts": 0}, "--parts is 0, expected at least 1"),
        ({"refine": True}, "found --refine without --factory"),
        ({"table": "/nowhere"}, "no feature table at /nowhere"),
    ],
)
def test_build_invalid_settings_get_one_sentence(
    table: str, tmp_path: Path, changes: dict[str, object], sentence: str
) -> None:
    with pytest.raises(InputError, match=sentence):
        build(table, tmp_path / "index", **changes)
    assert not (tmp_path / "index" / "index.json").exists()


@pytest.mark.parametrize("name", ["index.faiss", "ids.arrow", "ids.parquet"])
def test_open_index_names_torn_or_missing_file(table: str, tmp_path: Path, name: str) -> None:
    out = tmp_path / "index"
    build(table, out)
    whole = (out / name).read_bytes()
    (out / name).write_bytes(whole[:-7])
    with pytest.raises(InputError, match=f"{name} has .* bytes, expected .*build the index again"):
        Index(str(out))
    (out / name).unlink()
    with pytest.raises(InputError, match=f"{name} is missing"):
        Index(str(out))
    (out / name).write_bytes(os.urandom(len(whole)))
    if name != "ids.parquet":  # which searching does not read
        with pytest.raises(InputError, match="is damaged"):
            Index(str(out))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda facts: facts | {"schema_version": 1}, "is of version 1, expected 3"),
        (lambda facts: {k: v for k, v in facts.items() if k != "parts"}, "is damaged"),
        (lambda facts: facts | {"parts": [{"faiss": 3}]}, "is damaged"),
        (lambda facts: [facts], "is damaged"),
    ],
)
def test_build_rejects_index_of_other_settings(
    table: str, tmp_path: Path, change: object, sentence: str
) -> None:
    out = tmp_path / "index"
    build(table, out)
    changed = change(json_files.read_checksummed(str(out / "index.json")))  # type: ignore[operator]
    if isinstance(changed, dict):
        json_files.write_checksummed(str(out / "index.json"), changed)
    else:
        storage.write_json(str(out / "index.json"), changed)
    with pytest.raises(InputError, match=sentence):
        Index(str(out))


def test_build_on_any_storage(table: str, tmp_path: Path) -> None:
    settings = IndexSettings(
        table=table,
        out="memory://index-of-tests",
        split=Split.GALLERY,
        factory="IVF8,SQ8",
        target_recall=0.5,
    )
    try:
        build_index(settings)
        assert answers(Index(settings.out), table) == answers(
            build(table, tmp_path / "disk", factory="IVF8,SQ8"), table
        )
    finally:
        storage.remove_folder(settings.out)


def test_parse_bytes_reads_usual_notations() -> None:
    assert [parse_bytes(text) for text in ("4GB", "512 mb", "1.5G", "100")] == [
        4 * 10**9,
        512 * 10**6,
        15 * 10**8,
        100,
    ]


def test_work_units_are_table_parts_in_order() -> None:
    units = plan_units({"a": 3, "b": 4, "c": 9, "d": 1}, 8)
    assert [(unit.table_parts, unit.rows) for unit in units] == [
        (("a", "b"), 7),
        (("c",), 9),
        (("d",), 1),
    ]
    assert plan_units({}, 8) == []


@given(st.lists(st.integers(1, 50), max_size=40), st.integers(1, 200))
def test_groups_are_consecutive_and_even(sizes: list[int], wanted: int) -> None:
    groups = even_groups(sizes, wanted)
    assert [number for group in groups for number in group] == list(range(len(sizes)))
    for group in groups:
        assert sum(sizes[number] for number in group) < wanted + max(
            sizes[number] for number in group
        )


def test_merged_lists_have_exact_size(
    table: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipeline.index.plan.MIN_UNIT_ROWS", 250)
    monkeypatch.setattr("pipeline.index.plan.UNIT_SHARE", 0)
    monkeypatch.setattr(workspace.BuildWorkspace, "clear", lambda self: None)
    out = tmp_path / "index"
    build(table, out, factory="IVF8,SQ8")
    units = sorted(str(unit) for unit in (out / "_building").glob("unit-*.faiss"))
    merged = merge_units(str(out / "trained.faiss"), units)
    assert merged.ntotal == 1000
    assert sum(merged.invlists.list_size(number) for number in range(8)) == 1000
    numbers = np.concatenate([_ids(merged, number) for number in range(8)])
    assert sorted(numbers.tolist()) == list(range(1000))
    assert read_faiss(units[0], on_disk=False).ntotal < 1000


def _ids(index: object, number: int) -> object:
    lists = index.invlists  # type: ignore[attr-defined]
    return faiss.rev_swig_ptr(lists.get_ids(number), lists.list_size(number)).copy()
