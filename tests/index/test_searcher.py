"""Searching equals brute force under any filter and in any kind of index; plain FAISS opens it."""

from dataclasses import replace
from pathlib import Path

import faiss
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from pipeline.core import storage
from pipeline.core.arrays import Floats, Mask
from pipeline.core.errors import InputError
from pipeline.core.filters import Filter
from pipeline.core.geo import Box, Circle
from pipeline.core.records import Split, View
from pipeline.features.table import open_table
from pipeline.index.build import build_index
from pipeline.index.metadata import SearchParams
from pipeline.index.part import FILTERED_EXACT_ROWS, NO_ROW, filtered_params, hidden_params
from pipeline.index.planning.plan import RERANK_FACTOR
from pipeline.index.searcher import Index, merge_results
from pipeline.index.settings import IndexSettings
from tests.index.index_tables import write_gallery

pytestmark = pytest.mark.slow

FACTORIES = [
    "Flat",
    "SQ8",
    "HNSW16,SQ8",
    "IVF8,SQ8",
    "IVF8,PQ8x4fs",
    "IVF8,RaBitQ",
    "PCA16,IVF8,SQ8",
    "IVF8,PQ8x4,Refine(SQ8)",
]
FILTERS = {
    "view": Filter(view=View.SATELLITE),
    "another view": Filter(view=View.STREET),
    "locations": Filter(locations=frozenset(["00003", "20007", "unheard-of"])),
    "box": Filter(box=Box(south=0.05, north=0.12, west=0, east=1.5)),
    "circle": Filter(near=Circle(lat=0.1, lon=2, radius_m=4_000)),
    "all of them": Filter(
        view=View.SATELLITE,
        box=Box(south=0, north=1, west=-1, east=5),
        near=Circle(lat=0.1, lon=1, radius_m=9_000),
    ),
}


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> str:
    """600 satellite rows of the gallery in three parts and 40 UAV queries, 32 dimensions."""
    return str(write_gallery(tmp_path_factory.mktemp("table")))


def build(table: str, out: Path, **changes: object) -> str:
    given = {"table": table, "out": str(out), "split": Split.GALLERY, "view": View.SATELLITE}
    build_index(IndexSettings(**(given | changes)))  # type: ignore[arg-type]
    return str(out)


def brute_force(table: str, where: Filter | None, k: int) -> tuple[Floats, list[list[str]], Floats]:
    """The queries, and the keys and scores that a loop over all rows finds for each."""
    opened = open_table(table)
    gallery, queries_QD = opened.select(Split.GALLERY), opened.select(Split.QUERY).embeddings()
    scores_QN = queries_QD @ gallery.embeddings().T
    masks = [
        (where or Filter()).mask(rows.combine_chunks().to_batches()[0])
        for _, rows in gallery.numbered_rows(["view", "location", "lat", "lon"])
    ]
    scores_QN[:, ~np.concatenate(masks)] = -np.inf
    best_QK = np.argsort(-scores_QN, axis=1, kind="stable")[
        :, : min(k, int(np.concatenate(masks).sum()))
    ]
    return (
        queries_QD,
        gallery.labels().keys[best_QK].tolist(),
        np.take_along_axis(scores_QN, best_QK, 1),
    )


def test_search_equals_brute_force(table: str, tmp_path: Path) -> None:
    index = Index(build(table, tmp_path / "index"))
    queries_QD, keys, scores = brute_force(table, None, 5)
    found = index.search(queries_QD, k=5)
    assert [[hit.key for hit in hits] for hits in found] == keys
    assert np.allclose([[hit.score for hit in hits] for hits in found], scores, atol=1e-6)
    best = found[0][0]
    assert (best.view, best.location, len(index)) == (
        View.SATELLITE,
        best.key.split("-")[1] + f"{int(best.key.split('-')[2]):04d}",
        600,
    )
    assert best.lat == int(best.key.split("-")[2]) / 1000


@pytest.mark.slow
@pytest.mark.parametrize("factory", FACTORIES)
@pytest.mark.parametrize("name", FILTERS)
def test_search_filter_equals_brute_force(
    table: str, tmp_path_factory: pytest.TempPathFactory, factory: str, name: str
) -> None:
    """Few rows match, so each is scored by the table's own vectors, however coarse the index's
    codes are.
    """
    out = tmp_path_factory.getbasetemp() / f"filtered-{factory}"
    index = (
        Index(str(out))
        if (out / "index.json").exists()
        else Index(build(table, out, factory=factory, target_recall=0.01))
    )
    queries_QD, keys, scores = brute_force(table, FILTERS[name], 7)
    found = index.search(queries_QD, 7, FILTERS[name])
    assert [[hit.key for hit in hits] for hits in found] == keys
    assert np.allclose([[hit.score for hit in hits] for hits in found], scores, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("factory", ["Flat", "HNSW16,SQ8", "IVF8,SQ8", "IVF8,PQ16x4fs"])
def test_search_wide_filter_still_finds_k(
    table: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, factory: str
) -> None:
    """A third of the rows match, and the search parameters are those for all rows: three times as
    many lists are searched.
    """
    out = build(table, tmp_path / "index", factory=factory, refine=True, target_recall=0.9)
    monkeypatch.setattr("pipeline.index.part.FILTERED_EXACT_ROWS", 0)
    where = Filter(box=Box(south=0, north=1, west=0.5, east=1.5))
    queries_QD, keys, _ = brute_force(table, where, 10)
    found = [[hit.key for hit in hits] for hits in Index(out).search(queries_QD, 10, where)]
    assert all(key.startswith("gallery-1-") for hits in found for key in hits)
    assert np.mean([len({*a} & {*b}) / 10 for a, b in zip(found, keys, strict=True)]) >= 0.9


@pytest.mark.parametrize("factory", ["HNSW16,SQ8", "IVF8,SQ8"])
def test_search_without_the_table_uses_codes(
    table: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, factory: str
) -> None:
    """An object store gives no single vectors: a narrow filter then compares all codes."""
    out = build(table, tmp_path / "index", factory=factory)
    monkeypatch.setattr("pipeline.index.searcher.supports_row_reads", lambda path: False)
    where = FILTERS["locations"]
    queries_QD, keys, scores = brute_force(table, where, 2)
    found = Index(out).search(queries_QD, 2, where)
    assert [[hit.key for hit in hits] for hits in found] == keys
    assert np.allclose([[hit.score for hit in hits] for hits in found], scores, atol=0.02)


def test_search_reranked_scores_are_exact(table: str, tmp_path: Path) -> None:
    out = build(table, tmp_path / "index", factory="IVF4,PQ4x4fs", refine=True, target_recall=0.01)
    queries_QD, keys, scores = brute_force(table, None, 10)
    rough = Index(out).search(queries_QD, 10, params=SearchParams(nprobe_or_ef=4))
    refined = Index(out).search(
        queries_QD, 10, params=SearchParams(nprobe_or_ef=4, rerank_factor=30)
    )
    right = [
        np.mean(
            [
                len({hit.key for hit in hits} & {*best}) / 10
                for hits, best in zip(found, keys, strict=True)
            ]
        )
        for found in (rough, refined)
    ]
    assert right[0] < 0.7
    assert right[1] > 0.95
    for hits, best, exact in zip(refined, keys, scores, strict=True):
        for hit in hits:
            if hit.key in best:
                assert hit.score == pytest.approx(exact[best.index(hit.key)], abs=1e-6)


def test_index_is_opened_by_plain_faiss(table: str, tmp_path: Path) -> None:
    out = build(table, tmp_path / "index")
    plain = faiss.read_index(storage.join(out, "index.faiss"))
    vectors = open_table(table).select(Split.GALLERY).embeddings()
    assert plain.ntotal == 600
    assert plain.search(vectors[7:8], 1)[1][0, 0] == 7
    rows = pq.read_table(storage.join(out, "ids.parquet")).to_pylist()
    assert rows[205] == {
        "row": 205,
        "side_m": None,
        "key": "gallery-1-5",
        "location": "10005",
        "view": "satellite",
        "lat": 0.005,
        "lon": None,
        "table_part": 1,
        "part_row": 5,
    }
    facts = storage.read_json(storage.join(out, "index.json"))
    assert (facts["factory"], facts["rows"], facts["recall_at_1"], facts["recall_at_10"]) == (
        "Flat",
        600,
        1.0,
        1.0,
    )


def test_merge_orders_by_score_then_row() -> None:
    one = np.array([[0.9, 0.5, -np.inf]], np.float32), np.array([[4, 2, NO_ROW]])
    other = np.array([[0.9, 0.7, 0.5]], np.float32), np.array([[3, 9, 1]])
    scores, rows = merge_results([one, other], 5)
    assert rows.tolist() == [[3, 4, 9, 1, 2]]
    assert scores.tolist() == [[np.float32(s) for s in (0.9, 0.9, 0.7, 0.5, 0.5)]]
    assert merge_results([one], 3)[1].tolist() == [[4, 2, NO_ROW]]


def test_search_k_beyond_rows_returns_all(table: str, tmp_path: Path) -> None:
    index = Index(build(table, tmp_path / "index"))
    queries_QD = open_table(table).select(Split.QUERY).embeddings()
    assert [len(hits) for hits in index.search(queries_QD[:3], 1000)] == [600, 600, 600]
    assert index.search(queries_QD[:2], 3, Filter(locations=frozenset(["nowhere"]))) == [[], []]
    assert index.search(queries_QD[:0], 3) == []
    assert FILTERED_EXACT_ROWS > 600, "the filters above are to be searched exactly"


@pytest.mark.parametrize("shape", [(32,), (1, 31), (2, 3, 32)])
def test_search_rejects_queries_of_another_network(
    table: str, tmp_path: Path, shape: tuple[int, ...]
) -> None:
    index = Index(build(table, tmp_path / "index"))
    with pytest.raises(InputError, match=r"expected \(queries, 32\)"):
        index.search(np.zeros(shape, np.float32))


def test_open_index_absent_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no index at"):
        Index(str(tmp_path))


def test_filtered_params_widen_as_fewer_rows_match() -> None:
    usual = SearchParams(nprobe_or_ef=8, rerank_factor=2)
    assert filtered_params(usual, 1.0) == usual
    few_removed = filtered_params(usual, 0.96)
    assert (few_removed.nprobe_or_ef, few_removed.rerank_factor) == (9, 3)  # 2 / sqrt(0.96): 2.04
    quarter = filtered_params(usual, 0.25)
    assert (quarter.nprobe_or_ef, quarter.rerank_factor) == (32, 4)
    many = SearchParams(nprobe_or_ef=8, rerank_factor=20)
    assert filtered_params(many, 0.25).rerank_factor == 40
    # Without candidates that are scored again, more of them would change nothing.
    assert filtered_params(SearchParams(nprobe_or_ef=8, rerank_factor=1), 0.25).rerank_factor == 1


def test_hidden_params_are_those_of_a_half_and_widen() -> None:
    untuned = SearchParams(nprobe_or_ef=8, rerank_factor=2)
    half = hidden_params(untuned, 0.5)
    assert (half.nprobe_or_ef, half.rerank_factor) == (16, RERANK_FACTOR)
    tuned = replace(untuned, hidden_nprobe_or_ef=100, hidden_rerank_factor=40)
    half, eighth = hidden_params(tuned, 0.5), hidden_params(tuned, 0.125)
    assert (half.nprobe_or_ef, half.rerank_factor) == (100, 40)
    assert (eighth.nprobe_or_ef, eighth.rerank_factor) == (400, 80)
    assert hidden_params(replace(tuned, rerank_factor=1), 0.125).rerank_factor == 1
    assert hidden_params(replace(tuned, rerank_factor=60), 0.5).rerank_factor == 60


def test_mask_looks_only_at_batches_that_may_match(
    table: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each part of the table lies on a meridian of its own, and here is a batch of its own."""
    monkeypatch.setattr("pipeline.index.ids.BATCH_ROWS", 200)
    ids = Index(build(table, tmp_path / "index", factory="Flat")).parts[0].ids
    looked_at: list[int] = []
    mask_of = Filter.mask

    def mask(where: Filter, rows: pa.RecordBatch) -> Mask:
        looked_at.append(len(rows))
        return mask_of(where, rows)

    monkeypatch.setattr(Filter, "mask", mask)
    for where in FILTERS.values():
        expected_N = mask_of(where, ids.take(np.arange(len(ids))))
        assert np.array_equal(ids.mask(where), expected_N)
    looked_at.clear()
    ids.mask(Filter(box=Box(south=0, north=1, west=0.5, east=1.5)))
    assert looked_at == [200]
