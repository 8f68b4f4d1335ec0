"""Building an index: its settings, its plan, its recall, and a finished one that is built again."""

from dataclasses import replace
from pathlib import Path

import faiss
import numpy as np
import pytest

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.records import Split, View
from pipeline.index.build import build_index
from pipeline.index.planning import planner
from pipeline.index.planning.plan import GallerySpec, IndexPlan, candidate_plans
from pipeline.index.searcher import Index
from pipeline.index.settings import IndexSettings, parse_bytes
from tests.index.index_tables import answers, build, clustered, write_gallery, write_table_part

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> str:
    """1,000 satellite rows of the gallery in five parts and 40 UAV queries, of 32 dimensions."""
    return str(write_gallery(tmp_path_factory.mktemp("table"), parts=5, dtype="float16"))


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

    monkeypatch.setattr(planner, "candidate_plans", lambda gallery: [on_disk(gallery)])
    mapped = build(table, tmp_path / "mapped")
    assert (mapped.metadata.on_disk, len(mapped.metadata.parts)) == (True, 2)
    in_memory = [on_disk(None, on_disk=False)]
    monkeypatch.setattr(planner, "candidate_plans", lambda gallery: in_memory)
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
    dimensions: list[int | None] = []

    def recording(gallery: GallerySpec) -> list[IndexPlan]:
        dimensions.append(gallery.effective_dimension)
        return candidate_plans(replace(gallery, rows=10**6))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(planner, "candidate_plans", recording)
        patch.setattr("pipeline.index.planning.plan.EXACT_ROWS", 1_000)
        index = build(
            str(tmp_path / "table"),
            tmp_path / "index",
            split=None,
            view=None,
            memory_budget="2GB",
            target_recall=0.9,
        )
    assert dimensions == [32]
    assert index.metadata.factory.startswith("PCA32,")
    assert index.metadata.measured["recall_at_10"] >= 0.9


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
