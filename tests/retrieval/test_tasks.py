"""Retrieval tasks on made tables: possible tasks, protocols, result rows, merged queries."""

import numpy as np
import pytest

from pipeline.core.records import Split, View
from pipeline.features.part import PartFooter, PartRows, write_part
from pipeline.features.table import FeatureTable, open_table
from pipeline.retrieval.tasks import Task, possible_tasks, retrieve
from tests.retrieval.test_ranking import unit

Row = tuple[Split, View, str, list[float]]


def made_table(folder: str, rows: list[Row]) -> FeatureTable:
    """A table of two parts, each of which mixes splits and views."""
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


def test_possible_tasks_are_pairs_of_views_with_rows(
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


def test_retrieve_protocols_differ_by_the_distractors(tmp_path: object) -> None:
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


def test_retrieve_rows_list_the_best_answers(tmp_path: object) -> None:
    table = made_table(str(tmp_path), TOWN)
    rows = retrieve(Task(query_view=D, gallery_view=S), table, table).queries.to_pylist()
    [row] = [row for row in rows if row["location"] == "0002"]
    assert row["query"].startswith("query-drone-0002")
    assert (row["task"], row["protocol"], row["multi_query"]) == ("drone->satellite", "full", False)
    assert (row["matches"], row["first_match_rank"], row["ap"]) == (1, 2, 0.25)
    assert row["top_locations"] == ["far", "0002", "0001"]
    assert row["first_match_key"] == row["top_keys"][1]
    assert row["first_match_score"] == row["top_scores"][1]


def test_retrieve_counts_a_query_without_match_as_zero(tmp_path: object) -> None:
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


def test_retrieve_averages_over_all_true_matches(tmp_path: object) -> None:
    table = made_table(str(tmp_path), TOWN)
    rows = retrieve(Task(query_view=S, gallery_view=D), table, table).queries.to_pylist()
    assert {
        row["location"]: (row["matches"], row["first_match_rank"], row["ap"]) for row in rows
    } == {
        "0001": (2, 1, 1.0),
        "0002": (1, 2, 0.25),
    }


def test_retrieve_multi_query_has_one_query_per_location(tmp_path: object) -> None:
    table = made_table(str(tmp_path), TOWN)
    found = retrieve(Task(query_view=D, gallery_view=S, multi_query=True), table, table)
    assert found.metrics["queries"] == 2
    assert found.metrics["multi_query"] is True
    assert found.queries["query"].to_pylist() == ["0001", "0002"]
