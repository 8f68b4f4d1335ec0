"""Recall by hand-worked numbers, and the search parameters that reach a target."""

from itertools import pairwise

import numpy as np
import pytest

from pipeline.core.records import Split
from pipeline.features.table import open_table
from pipeline.index.build import build_index
from pipeline.index.metadata import SearchParams
from pipeline.index.searcher import Index
from pipeline.index.settings import IndexSettings
from pipeline.index.train import effective_dimension, new_index, sample_rows
from pipeline.index.tuning.ground_truth import RecallQueries, exact_search, without_own_row
from pipeline.index.tuning.recall import measure_recall
from pipeline.index.tuning.search_params import search_param_grid, tune
from pipeline.index.workspace import rows_by_part
from tests.index.index_tables import clustered, write_gallery


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Index]:
    folder = tmp_path_factory.mktemp("measured")
    table = str(write_gallery(folder / "table"))
    build_index(
        IndexSettings(
            table=table,
            out=str(folder / "index"),
            split=Split.GALLERY,
            factory="IVF16,PQ4x4fs",
            refine=True,
        )
    )
    return table, Index(str(folder / "index"))


def test_recall_excludes_the_querys_own_row() -> None:
    found = np.array([[5, 7, 9], [1, 2, 3], [4, 0, 6]])
    assert without_own_row(found, np.array([7, -1, 4])).tolist() == [[5, 9], [1, 2], [0, 6]]
    short = np.array([[5, -1, -1], [7, -1, -1]])
    assert without_own_row(short, np.array([-1, 7])).tolist() == [[5, -1], [-1, -1]]


def test_exact_search_equals_brute_force_for_any_blocks(
    built: tuple[str, Index], monkeypatch: pytest.MonkeyPatch
) -> None:
    table = open_table(built[0])
    queries, gallery = (table.select(split).embeddings() for split in (Split.QUERY, Split.GALLERY))
    best = np.argsort(-(queries @ gallery.T), axis=1)[:, :5]
    assert np.array_equal(exact_search(queries, table.select(Split.GALLERY), 5), best)
    monkeypatch.setattr("pipeline.features.table.BLOCK_BYTES", 4 * 32 * 7)
    assert np.array_equal(exact_search(queries, table.select(Split.GALLERY), 5), best)


def test_recall_by_hand(built: tuple[str, Index]) -> None:
    """Of ten rows that are given as exact search's, the index finds those that are the nearest."""
    table, index = built
    queries = open_table(table).select(Split.QUERY).embeddings()[:2]
    most = SearchParams(nprobe_or_ef=16, rerank_factor=60)
    nearest = index.search_rows(queries, 10, params=most)[1]
    wrong = nearest.copy()
    wrong[0, :4] = [10_000, 10_001, 10_002, 10_003]
    held = RecallQueries(
        queries_QD=queries, exact_QK=wrong, own_row_Q=np.array([-1, -1]), source=""
    )
    assert measure_recall(index, held, most) == (0.5, 0.8)


def test_search_param_grid_grows() -> None:
    lists = list(search_param_grid(new_index("IVF12,SQ8", 32), "none"))
    assert [effort.nprobe_or_ef for effort in lists] == [1, 2, 4, 8, 12]
    graph = list(search_param_grid(new_index("HNSW8,SQ8", 32), "none"))
    assert graph[0].nprobe_or_ef == 16
    assert all(later.nprobe_or_ef > earlier.nprobe_or_ef for earlier, later in pairwise(graph))
    assert len(list(search_param_grid(new_index("Flat", 32), "none"))) == 1
    refined = list(search_param_grid(new_index("PCA16,IVF4,SQ8", 32), "table"))
    assert [(e.nprobe_or_ef, e.rerank_factor) for e in refined] == [
        (1, 10),
        (2, 10),
        (4, 10),
        (4, 20),
        (4, 40),
        (4, 80),
    ]


def test_tune_takes_the_least_params_at_target(built: tuple[str, Index]) -> None:
    table, index = built
    queries, gallery = (
        open_table(table).select(Split.QUERY).embeddings(),
        open_table(table).select(Split.GALLERY),
    )
    exact = exact_search(queries, gallery, 10)
    held = RecallQueries(
        queries_QD=queries, exact_QK=exact, own_row_Q=np.full(len(queries), -1), source=""
    )
    ladder = list(search_param_grid(new_index("IVF16,PQ4x4fs", 32), "table"))
    effort, _, at_10 = tune(index, held, iter(ladder), 0.9)
    assert at_10 >= 0.9
    less = [step for step in ladder if step.nprobe_or_ef < effort.nprobe_or_ef]
    assert all(measure_recall(index, held, step)[1] < 0.9 for step in less)
    assert (
        effort.rerank_factor == 1
        or measure_recall(
            index,
            held,
            SearchParams(nprobe_or_ef=effort.nprobe_or_ef, rerank_factor=effort.rerank_factor // 2),
        )[1]
        < 0.9
    )
    best, _, most = tune(index, held, iter(ladder), 1.01)
    assert most == max(measure_recall(index, held, step)[1] for step in ladder)
    assert best in ladder


def test_sample_takes_a_share_of_each_part(built: tuple[str, Index]) -> None:
    table = open_table(built[0]).select(Split.GALLERY)
    numbers, vectors = sample_rows(table, rows_by_part(table), 30)
    assert numbers.tolist() == [*range(10), *range(200, 210), *range(400, 410)]
    assert np.array_equal(vectors, table.embeddings()[numbers])
    assert len(sample_rows(table, rows_by_part(table), 10**6)[0]) == 600


def test_strong_directions_counts_by_length() -> None:
    flat = np.zeros((2_000, 128), np.float32)
    flat[:, 5:20] = clustered(2_000, 15, 3)
    assert effective_dimension(flat) == 32, "15 directions, rounded up"
    assert effective_dimension(np.eye(128, dtype=np.float32)) == 128


def test_tune_leaves_out_what_is_too_slow(built: tuple[str, Index]) -> None:
    table, index = built
    queries = open_table(table).select(Split.QUERY).embeddings()
    exact = exact_search(queries, open_table(table).select(Split.GALLERY), 10)
    held = RecallQueries(
        queries_QD=queries, exact_QK=exact, own_row_Q=np.full(len(queries), -1), source=""
    )
    grid = list(search_param_grid(new_index("IVF16,PQ4x4fs", 32), "table"))
    limited = tune(index, held, iter(grid), 1.01, lambda params: params.nprobe_or_ef <= 2)[0]
    assert limited.nprobe_or_ef <= 2
    assert tune(index, held, iter(grid), 1.01, lambda params: False)[0] == grid[0]
