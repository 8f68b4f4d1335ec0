"""Work units and parts: the same answers however the rows are divided, and by any worker."""

from pathlib import Path

import faiss
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.index import workspace
from pipeline.index.faiss_io import read_faiss
from pipeline.index.units import even_groups, merge_units, plan_units
from tests.index.index_tables import answers, build, write_gallery

pytestmark = pytest.mark.slow

MERGED = ["Flat", "SQ8", "IVF8,SQ8", "IVF8,PQ8x4fs", "IVF8,RaBitQ", "PCA16,IVF8,SQ8"]


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> str:
    """1,000 satellite rows of the gallery in five parts and 40 UAV queries, of 32 dimensions."""
    return str(write_gallery(tmp_path_factory.mktemp("table"), parts=5, dtype="float16"))


@pytest.mark.parametrize("factory", MERGED)
def test_build_by_units_equals_one_pass(
    table: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, factory: str
) -> None:
    whole = build(table, tmp_path / "whole", factory=factory)
    monkeypatch.setattr("pipeline.index.planning.plan.MIN_UNIT_ROWS", 250)
    monkeypatch.setattr("pipeline.index.planning.plan.UNIT_SHARE", 0)
    units = build(table, tmp_path / "units", factory=factory)
    assert units.metadata.unit_rows == 250
    assert len(units.metadata.parts) == 1
    assert answers(units, table) == answers(whole, table)


def test_build_by_ray_equals_one_process(
    table: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ray_cluster: None
) -> None:
    here = build(table, tmp_path / "here", factory="IVF8,SQ8")
    monkeypatch.setattr("pipeline.index.planning.plan.MIN_UNIT_ROWS", 250)
    monkeypatch.setattr("pipeline.index.planning.plan.UNIT_SHARE", 0)
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
    monkeypatch.setattr("pipeline.index.planning.plan.MIN_UNIT_ROWS", 250)
    monkeypatch.setattr("pipeline.index.planning.plan.UNIT_SHARE", 0)
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
