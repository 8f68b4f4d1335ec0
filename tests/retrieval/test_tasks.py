"""Exact ranking against a brute-force twin, its independence of how the work is cut, and what the
tasks are.
"""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.core.errors import InputError
from pipeline.core.records import Split, View
from pipeline.features.table import (
    FeatureTable,
    Floats,
    PartFooter,
    PartRows,
    open_table,
    write_part,
)
from pipeline.retrieval import exact_scores, metrics
from pipeline.retrieval.embedding_set import (
    EmbeddingSet,
    embedding_set_from_array,
    filter_locations,
)
from pipeline.retrieval.exact_scores import error_bound, round_to_grid
from pipeline.retrieval.ranking import BlockSizes, Ranking, rank, rank_distributed
from pipeline.retrieval.subsets import mean_by_location
from pipeline.retrieval.tasks import Task, possible_tasks, retrieve


def unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True), np.float32)


def side(vectors: Floats, locations: list[str]) -> EmbeddingSet:
    return embedding_set_from_array(
        np.array([f"k{i}" for i in range(len(locations))]), np.array(locations), unit(vectors)
    )


@st.composite
def sides(draw: st.DrawFn) -> tuple[EmbeddingSet, EmbeddingSet]:
    """Queries and a gallery with few locations and, often, so few distinct vectors that most scores
    tie.
    """
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    distinct, dimension = draw(st.sampled_from([1, 2, 5, 1000])), draw(st.integers(1, 9))
    pool = unit(rng.standard_normal((distinct, dimension)).astype(np.float32))

    def one(rows: int) -> EmbeddingSet:
        return side(
            pool[rng.integers(0, distinct, rows)], [f"L{i}" for i in rng.integers(0, 4, rows)]
        )

    return one(draw(st.integers(1, 12))), one(draw(st.integers(1, 60)))


cuts = st.builds(
    BlockSizes,
    queries_in_memory=st.integers(1, 13),
    query_rows=st.integers(1, 13),
    gallery_rows=st.integers(1, 61),
)


def brute(
    queries: EmbeddingSet, gallery: EmbeddingSet, top: int
) -> list[tuple[list[int], list[int], list[float]]]:
    """For each query: the ranks of its true matches, its top rows and their scores, by sorting the
    whole gallery.
    """
    query_QD, gallery_GD = (
        round_to_grid(next(s.blocks(10**6))).astype(np.float64) for s in (queries, gallery)
    )
    found = []
    for vector, location in zip(query_QD, queries.locations, strict=True):
        scores = [float(np.float32(math.fsum(vector * other))) for other in gallery_GD]
        right = [bool(other == location) for other in gallery.locations]
        order = sorted(range(len(scores)), key=lambda row: (-scores[row], right[row], row))
        ranks = [place for place, row in enumerate(order, 1) if right[row]]
        found.append((ranks, order[:top], [scores[row] for row in order[:top]]))
    return found


FEW = (-1, math.inf)  # never and always the way that picks the few entries that matter


@given(sides(), cuts, st.integers(1, 12), st.sampled_from(FEW))
@settings(max_examples=150)
def test_ranking_equals_the_brute_force_twin_however_the_work_is_cut(
    pair: tuple[EmbeddingSet, EmbeddingSet], cut: BlockSizes, top: int, few: float
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(exact_scores, "MAX_SPARSE_SHARE", few)
        found = rank(*pair, top, cut)
    for q, (ranks, rows, scores) in enumerate(brute(*pair, top)):
        assert found.matches_Q[q] == len(ranks)
        assert found.first_rank_Q[q] == (ranks[0] if ranks else 0)
        expected = metrics.average_precisions(
            np.array(ranks, np.int64), np.zeros(len(ranks), np.int64), 1
        )[0]
        assert found.ap_Q[q] == pytest.approx(expected, abs=1e-12)
        assert found.top_rows_QK[q].tolist() == rows
        assert found.top_scores_QK[q].tolist() == scores


def same(one: Ranking, other: Ranking) -> bool:
    return all(
        np.array_equal(getattr(one, name), getattr(other, name), equal_nan=True)
        for name in Ranking.__dataclass_fields__
    )


def test_every_bit_is_the_same_for_blocks_of_any_shape() -> None:
    rng = np.random.default_rng(0)
    pool = rng.standard_normal((40, 257)).astype(np.float32)
    queries = side(pool[rng.integers(0, 40, 40)], [f"{i % 30}" for i in range(40)])
    gallery = side(pool[rng.integers(0, 40, 120)], [f"{i % 35}" for i in range(120)])
    whole = rank(queries, gallery)
    for rows in (3, 7, 64, 119):
        assert same(
            rank(
                queries,
                gallery,
                blocks=BlockSizes(queries_in_memory=25, query_rows=rows, gallery_rows=rows),
            ),
            whole,
        )


def test_every_bit_is_the_same_for_any_number_of_workers(ray_cluster: None) -> None:
    rng = np.random.default_rng(3)
    queries = side(
        rng.standard_normal((23, 16)).astype(np.float32), [f"{i % 7}" for i in range(23)]
    )
    gallery = side(
        rng.standard_normal((90, 16)).astype(np.float32), [f"{i % 9}" for i in range(90)]
    )
    whole, settled = rank(queries, gallery, 5), [0]

    def advance(scores: int) -> None:
        settled[0] += scores

    assert same(rank_distributed(queries, gallery, 5, 0, lambda scores: None), whole)
    assert same(rank_distributed(queries, gallery, 5, 2, advance), whole)
    assert same(
        rank_distributed(
            queries, gallery, 5, 2, advance, BlockSizes(queries_in_memory=4, query_rows=3)
        ),
        whole,
    )
    assert settled == [2 * 23 * 90]


@pytest.mark.parametrize("spread", [0.0, 1e-7, 1e-5, 1e-3, 0.1])
@pytest.mark.parametrize("each", [1, 3, 30])
@pytest.mark.parametrize("few", FEW)
def test_near_ties_are_settled_exactly_however_near(
    spread: float, each: int, few: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Vectors that differ by less than float32 products can tell: every score is in doubt."""
    monkeypatch.setattr(exact_scores, "MAX_SPARSE_SHARE", few)
    rng = np.random.default_rng(4)
    centre = rng.standard_normal(300)
    queries = side(
        (centre + spread * rng.standard_normal((9, 300))).astype(np.float32),
        [f"{i % 4}" for i in range(9)],
    )
    names = [f"{i % 4}" if i < 4 * each else f"x{i}" for i in range(4 * each + 60)]
    gallery = side(
        (centre + spread * rng.standard_normal((len(names), 300))).astype(np.float32), names
    )
    found = rank(queries, gallery, 10, BlockSizes(query_rows=4, gallery_rows=50))
    for q, (ranks, rows, scores) in enumerate(brute(queries, gallery, 10)):
        assert found.first_rank_Q[q] == ranks[0]
        expected = metrics.average_precisions(np.array(ranks), np.zeros(len(ranks), np.int64), 1)[0]
        assert found.ap_Q[q] == pytest.approx(expected, abs=1e-12)
        assert found.top_rows_QK[q].tolist() == rows
        assert found.top_scores_QK[q].tolist() == scores


@given(st.integers(0, 2**32 - 1), st.sampled_from([2, 64, 2048]))
@settings(max_examples=25)
def test_float32_products_lie_within_the_bound_of_the_score(seed: int, dimension: int) -> None:
    rng = np.random.default_rng(seed)
    one, other = (
        round_to_grid(unit(np.abs(rng.standard_normal((8, dimension))).astype(np.float32)))
        for _ in range(2)
    )
    exact = (one.astype(np.float64) @ other.astype(np.float64).T).astype(np.float32)
    assert np.abs(exact.astype(np.float64) - one @ other.T).max() <= error_bound(dimension)


def test_many_matches_a_query_are_counted_as_few_are() -> None:
    rng = np.random.default_rng(1)
    queries = side(rng.standard_normal((5, 8)).astype(np.float32), ["a", "a", "b", "c", "none"])
    gallery = side(
        rng.standard_normal((200, 8)).astype(np.float32),
        [["a", "b", "x"][i % 3] for i in range(197)] + ["c"] * 3,
    )
    found = rank(queries, gallery)
    for q, (ranks, rows, _) in enumerate(brute(queries, gallery, 10)):
        assert found.first_rank_Q[q] == (ranks[0] if ranks else 0)
        assert found.top_rows_QK[q].tolist() == rows
    assert found.first_row_Q[4] == -1
    assert math.isnan(found.first_score_Q[4])


def test_a_network_that_gives_all_images_one_vector_finds_nothing() -> None:
    queries, gallery = (
        side(np.ones((4, 8), np.float32), list("abcd")),
        side(np.ones((6, 8), np.float32), list("abcdxy")),
    )
    found = rank(queries, gallery)
    assert found.first_rank_Q.tolist() == [6, 6, 6, 6]
    assert found.top_rows_QK[1].tolist() == [0, 2, 3, 4, 5, 1]


def test_scores_are_those_of_the_plain_product() -> None:
    vectors = unit(np.random.default_rng(2).standard_normal((20, 2048)).astype(np.float32))
    names = np.array([str(i) for i in range(20)])
    found = rank(
        embedding_set_from_array(names, names, vectors[:5]),
        embedding_set_from_array(names, names, vectors),
        top=20,
    )
    plain = vectors[:5].astype(np.float64) @ vectors.astype(np.float64).T
    assert (
        np.abs(np.take_along_axis(plain, found.top_rows_QK, 1) - found.top_scores_QK).max() < 1e-7
    )
    assert found.first_rank_Q.tolist() == [1] * 5


@pytest.mark.parametrize("spoilt", [0.0, 3.0, math.nan])
def test_vectors_that_are_not_of_unit_length_are_refused(spoilt: float) -> None:
    vectors = np.eye(3, dtype=np.float32)
    vectors[1] *= spoilt
    names = np.array(list("abc"))
    with pytest.raises(InputError, match=r"row 1 .* expected unit length; normalise"):
        rank(
            embedding_set_from_array(names, names, np.eye(3, dtype=np.float32)),
            embedding_set_from_array(names, names, vectors),
        )


def test_merged_queries_are_the_mean_at_unit_length_one_for_each_location() -> None:
    merged = mean_by_location(
        side(np.array([[1, 0], [0, 1], [0, 1], [1, 0]], np.float32), ["b", "a", "b", "b"])
    )
    assert merged.keys.tolist() == merged.locations.tolist() == ["a", "b"]
    assert np.concatenate(list(merged.blocks(1))) == pytest.approx(
        np.array([[0, 1], [2 / 5**0.5, 1 / 5**0.5]])
    )


def test_the_reduced_gallery_keeps_rows_of_queried_locations_in_their_order() -> None:
    reduced = filter_locations(
        side(np.eye(5, dtype=np.float32), list("axbya")), np.array(["a", "b", "c"])
    )
    assert reduced.keys.tolist() == ["k0", "k2", "k4"]
    assert np.concatenate(list(reduced.blocks(2))).argmax(axis=1).tolist() == [0, 2, 4]


Row = tuple[Split, View, str, list[float]]


def made_table(folder: str, rows: list[Row]) -> FeatureTable:
    """A table of two parts that mix splits and views, which the evaluation must not mind."""
    for part, name in ((rows[::2], "a.parquet"), (rows[1::2], "b.parquet")):
        write_part(
            f"{folder}/{name}",
            PartRows(
                keys=[
                    f"{s}-{v}-{place}-{rows.index(row)}" for row in part for s, v, place, _ in [row]
                ],
                locations=[row[2] for row in part],
                views=[row[1] for row in part],
                splits=[row[0] for row in part],
                lats=[None] * len(part),
                lons=[None] * len(part),
                embeddings_BD=unit(np.array([row[3] for row in part], np.float32)),
            ),
            PartFooter(fingerprint="f" * 64, shard_sha256="s", rows=len(part)),
        )
    return open_table(folder)


Q, G, D, S = Split.QUERY, Split.GALLERY, View.DRONE, View.SATELLITE
TOWN: list[Row] = [
    (Q, D, "0001", [1, 0, 0]),
    (Q, D, "0001", [1, 0.2, 0]),
    (Q, D, "0002", [0.5, 0.6, 0.9]),
    (Q, S, "0001", [1, 0.1, 0]),
    (Q, S, "0002", [0, 1, 0.1]),
    (G, S, "0001", [1, 0.1, 0]),
    (G, S, "0002", [0, 1, 0.1]),
    (G, S, "far", [0, 0, 1]),
    (G, D, "0001", [1, 0, 0]),
    (G, D, "0001", [1, 0.2, 0]),
    (G, D, "0002", [0, 0.6, 0.9]),
    (G, D, "far", [0, 0.9, 0.1]),
]


def test_tasks_are_the_pairs_of_two_views_that_have_queries_and_a_gallery(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    table = made_table(str(tmp_path_factory.mktemp("t")), TOWN)
    assert [task.name for task in possible_tasks(table, table)] == [
        "drone->satellite",
        "satellite->drone",
    ]
    street: Row = (G, View.STREET, "0001", [1, 0, 0])
    table = made_table(str(tmp_path_factory.mktemp("t")), [*TOWN, street])
    assert [task.name for task in possible_tasks(table, table)] == [
        "drone->satellite", "drone->street", "satellite->drone", "satellite->street",
    ]  # fmt: skip


def test_the_protocols_differ_by_the_distractors_alone(tmp_path: object) -> None:
    table = made_table(str(tmp_path), TOWN)
    task = Task(query_view=D, gallery_view=S)
    full, reduced = (
        retrieve(task, table, table, protocol) for protocol in ("full", "queried-only")
    )
    assert (full.metrics["gallery"], full.metrics["r1"], full.metrics["protocol"]) == (
        3,
        pytest.approx(2 / 3),
        "full",
    )
    assert (reduced.metrics["gallery"], reduced.metrics["r1"]) == (2, 1.0)
    assert reduced.metrics["protocol"] == "queried-only"
    assert full.metrics["ap"] == pytest.approx((1 + 1 + 1 / 4) / 3)


def test_a_result_row_names_what_was_found(tmp_path: object) -> None:
    table = made_table(str(tmp_path), TOWN)
    rows = retrieve(Task(query_view=D, gallery_view=S), table, table).queries.to_pylist()
    [row] = [row for row in rows if row["location"] == "0002"]
    assert row["query"].startswith("query-drone-0002")
    assert (row["task"], row["protocol"], row["multi_query"]) == ("drone->satellite", "full", False)
    assert (row["matches"], row["first_match_rank"], row["ap"]) == (1, 2, 0.25)
    assert row["top_locations"] == ["far", "0002", "0001"]
    assert row["first_match_key"] == row["top_keys"][1]
    assert row["first_match_score"] == row["top_scores"][1]


def test_a_query_without_a_match_has_no_rank_and_counts_as_zero(tmp_path: object) -> None:
    table = made_table(str(tmp_path), [*TOWN, (Q, S, "lost", [0, 0, 1])])
    found = retrieve(Task(query_view=S, gallery_view=D), table, table)
    [lost] = [row for row in found.queries.to_pylist() if row["location"] == "lost"]
    assert (lost["matches"], lost["first_match_rank"], lost["first_match_key"], lost["ap"]) == (
        0,
        None,
        None,
        0.0,
    )
    assert found.metrics["queries"] == 3
    assert found.metrics["r10"] == pytest.approx(2 / 3)


def test_several_true_matches_all_enter_the_average_precision(tmp_path: object) -> None:
    table = made_table(str(tmp_path), TOWN)
    rows = retrieve(Task(query_view=S, gallery_view=D), table, table).queries.to_pylist()
    assert {
        row["location"]: (row["matches"], row["first_match_rank"], row["ap"]) for row in rows
    } == {
        "0001": (2, 1, 1.0),
        "0002": (1, 2, 0.25),
    }


def test_merged_queries_are_one_for_each_location(tmp_path: object) -> None:
    table = made_table(str(tmp_path), TOWN)
    found = retrieve(Task(query_view=D, gallery_view=S, multi_query=True), table, table)
    assert found.metrics["queries"] == 2
    assert found.metrics["multi_query"] is True
    assert found.queries["query"].to_pylist() == ["0001", "0002"]
