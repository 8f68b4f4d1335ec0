"""Recall where a filter hides a query's place: what exact search finds, and the candidates."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.core.records import Split
from pipeline.features.table import open_table
from pipeline.index.faiss_io import search_faiss
from pipeline.index.metadata import SearchParams
from pipeline.index.part import NO_ROW
from pipeline.index.searcher import Index
from pipeline.index.tuning.ground_truth import RecallQueries, sample_queries
from pipeline.index.tuning.recall import measure_filtered_recall
from pipeline.index.tuning.search_params import MAX_HIDDEN_RERANK_FACTOR, tune_hidden
from pipeline.index.workspace import rows_by_part
from tests.index.index_tables import build, write_gallery


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> str:
    return str(write_gallery(tmp_path_factory.mktemp("filtered") / "table", parts=4, rows=500))


def queries_of(table: str, own: bool) -> RecallQueries:
    whole = open_table(table)
    gallery = whole.select(Split.GALLERY)
    return sample_queries(
        gallery, rows_by_part(gallery), None if own else whole.select(Split.QUERY)
    )


@pytest.mark.parametrize("own", [False, True])
def test_hidden_ground_truth_equals_brute_force(table: str, own: bool) -> None:
    """Half of the locations are left, the nearest row's not among them, nor the query's own row."""
    gallery_ND = open_table(table).select(Split.GALLERY).embeddings()
    queries = queries_of(table, own)
    assert queries.hidden is not None
    assert queries.hidden.half_N.tolist() == [True] * 1000 + [False] * 1000
    scores_QN = queries.queries_QD @ gallery_ND.T
    nearest_first_Q = scores_QN.argmax(axis=1) < 1000
    if own:
        scores_QN[np.arange(len(scores_QN)), queries.own_row_Q] = -np.inf
    assert np.array_equal(queries.exact_QK, np.argsort(-scores_QN, axis=1)[:, :10])
    assert np.array_equal(queries.hidden.within_Q, ~nearest_first_Q)
    assert 0 < nearest_first_Q.sum() < len(nearest_first_Q), "both halves hide some query's place"
    for query, within in enumerate(queries.hidden.within_Q):
        scores_QN[query, queries.hidden.half_N != within] = -np.inf
    assert np.array_equal(queries.hidden.exact_QK, np.argsort(-scores_QN, axis=1)[:, :10])


def test_hidden_ground_truth_of_one_location_is_empty(tmp_path: Path) -> None:
    table = str(write_gallery(tmp_path / "table", parts=1, rows=1))
    queries = queries_of(table, own=False)
    assert queries.hidden is not None
    assert (queries.hidden.exact_QK == NO_ROW).all()
    index = build(table, tmp_path / "index", factory="Flat")
    assert measure_filtered_recall(index, queries, index.metadata.search_params) == 1
    assert index.metadata.measured["filtered_recall_at_10"] == 1


def test_tune_hidden_takes_the_work_it_needs(
    table: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is near a hidden place is not what is near: other lists hold the nearest of the rest,
    and codes of 16 bits hardly order them.
    """
    monkeypatch.setattr("pipeline.index.part.FILTERED_EXACT_ROWS", 0)
    index = build(table, tmp_path / "index", factory="IVF8,PQ4x4fs", refine=True)
    queries = queries_of(table, own=False)
    few = replace(
        index.metadata.search_params,
        nprobe_or_ef=1,
        rerank_factor=2,
        hidden_nprobe_or_ef=None,
        hidden_rerank_factor=1,
    )
    assert measure_filtered_recall(index, queries, few) < 0.9
    params, recall = tune_hidden(index, queries, few, 0.99, most=8)
    assert recall == measure_filtered_recall(index, queries, params) >= 0.99
    assert params.hidden_nprobe_or_ef is not None
    assert params.hidden_nprobe_or_ef > 2
    fewer = replace(params, hidden_nprobe_or_ef=1, hidden_rerank_factor=1)
    assert measure_filtered_recall(index, queries, fewer) < 0.99
    untuned = {"hidden_nprobe_or_ef": None, "hidden_rerank_factor": 1}
    assert replace(params, **untuned) == few, "nothing else has changed"  # type: ignore[arg-type]
    hardest, most = tune_hidden(index, queries, few, 1.01, most=8)
    assert most >= recall
    codes_alone = replace(few, rerank_factor=1)
    assert tune_hidden(index, queries, codes_alone, 1.01, most=8)[0].hidden_rerank_factor == 1
    assert hardest.hidden_rerank_factor < 2 * MAX_HIDDEN_RERANK_FACTOR


def test_only_hidden_queries_are_searched_harder(
    table: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipeline.index.part.FILTERED_EXACT_ROWS", 0)
    index = build(table, tmp_path / "index", factory="IVF8,SQ8")
    queries = queries_of(table, own=False)
    assert queries.hidden is not None
    params = SearchParams(nprobe_or_ef=8, hidden_nprobe_or_ef=8)
    asked: list[tuple[int, int]] = []

    def watched(faiss_index: Any, queries_QD: Any, k: int, least: int, *given: Any) -> Any:
        if k > 1:
            asked.append((len(queries_QD), given[0].nprobe_or_ef))
        return search_faiss(faiss_index, queries_QD, k, least, *given)

    monkeypatch.setattr("pipeline.index.part.search_faiss", watched)
    index.search_rows(queries.queries_QD, 10, queries.hidden.half_N, params)
    hidden = int(queries.hidden.within_Q.sum())
    assert asked == [(len(queries.queries_QD) - hidden, 16), (hidden, 8)]


def test_search_by_mask_returns_only_its_rows(table: str, tmp_path: Path) -> None:
    """The mask is of the whole index, whose parts each take their piece of it."""
    index = build(table, tmp_path / "index", factory="Flat", parts=4)
    assert len(index.parts) > 1
    queries_QD = open_table(table).select(Split.QUERY).embeddings()
    allowed_N = np.arange(2000) % 7 == 3
    scores_QN = queries_QD @ open_table(table).select(Split.GALLERY).embeddings().T
    scores_QN[:, ~allowed_N] = -np.inf
    expected = np.argsort(-scores_QN, axis=1)[:, :10]
    assert np.array_equal(Index(index.path).search_rows(queries_QD, 10, allowed_N)[1], expected)
