"""Lists far from a query are skipped: as many hits, the recall that was asked for, fewer codes."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.core.records import Split
from pipeline.features.table import open_table
from pipeline.index.balance import imbalance, lost_balance
from pipeline.index.faiss_io import FAISS, search_faiss
from pipeline.index.metadata import SearchParams
from pipeline.index.searcher import Index
from pipeline.index.train import new_index, train_index
from pipeline.index.tuning.ground_truth import RecallQueries, exact_search
from pipeline.index.tuning.recall import measure_recall
from pipeline.index.tuning.search_params import cheaper_params
from pipeline.index.update import extend_index
from tests.index.index_tables import build, clustered, write_gallery, write_table_part


def codes_read() -> int:
    return int(FAISS.cvar.indexIVF_stats.ndis)


@pytest.mark.parametrize("factory", ["IVF16,SQ8", "PCA24,IVF16,SQ8", "IVF16,RaBitQ"])
def test_skipping_reads_fewer_codes_and_fills_k(factory: str) -> None:
    rows_SD, queries_QD = clustered(600, 32, 0), clustered(20, 32, 1)
    index = new_index(factory, 32)
    train_index(index, factory, rows_SD)
    index.add(rows_SD)
    read, found = {}, {}
    for ratio in (0.0, 0.7):
        FAISS.cvar.indexIVF_stats.reset()
        params = SearchParams(nprobe_or_ef=16, list_ratio=ratio)
        found[ratio] = search_faiss(index, queries_QD, 5, 5, params)[1]
        read[ratio] = codes_read()
    assert read[0.7] < read[0.0] / 2
    assert np.mean(found[0.7][:, 0] == found[0.0][:, 0]) > 0.8
    most = search_faiss(index, queries_QD, 300, 300, params)[1]
    assert (most >= 0).all(), "where near lists hold too few rows, all are searched"


def test_cheaper_params_keep_the_recall(tmp_path: Path) -> None:
    table = str(write_gallery(tmp_path / "table"))
    index = build(table, tmp_path / "index", factory="IVF16,SQ8")
    queries_QD = open_table(table).select(Split.QUERY).embeddings()
    queries = RecallQueries(
        queries_QD=queries_QD,
        exact_QK=exact_search(queries_QD, open_table(table).select(Split.GALLERY), 10),
        own_row_Q=np.full(len(queries_QD), -1),
        source="",
    )
    full = SearchParams(nprobe_or_ef=16)
    tuned = full, *measure_recall(index, queries, full)
    cheaper = cheaper_params(index, queries, tuned, 0.9)
    assert cheaper[0].list_ratio > 0
    assert measure_recall(index, queries, cheaper[0]) == cheaper[1:]
    assert cheaper[2] >= 0.9


def test_lost_balance_names_the_lists() -> None:
    even = np.full(10, 100)
    assert imbalance(even) == 1
    assert lost_balance(even, 2 * even) is None
    after = even + np.eye(10, dtype=np.int64)[3] * 2_000
    sentence = lost_balance(even, after)
    assert sentence is not None
    assert "3 with 2,100 rows" in sentence
    assert "build the index again" in sentence


def test_extend_names_lists_that_lost_balance(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = write_gallery(tmp_path / "table", parts=2)
    index = build(str(table), tmp_path / "index", factory="IVF8,SQ8")
    one_place = np.repeat(clustered(1, 32, 5), 900, axis=0)
    write_table_part(table, 7, one_place)
    extend_index(str(table), str(tmp_path / "index"))
    printed = capsys.readouterr().err
    assert "the lists lost their balance" in printed
    before = index.metadata.measured["recall_at_10"]
    assert f"recall@10 was {before:.3f} before the extension" in printed
    assert len(Index(str(tmp_path / "index")).parts) == 2
