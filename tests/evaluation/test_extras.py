"""Extra outputs of an evaluation: views, groups, exports, and the same files from any workers."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from jobs import evaluate as job
from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.evaluation import breakdowns
from pipeline.evaluation.evaluate import evaluate
from pipeline.evaluation.settings import EvaluationSettings
from pipeline.features.part import PartFooter, PartRows, write_part
from pipeline.retrieval.tasks import RESULTS_SCHEMA
from pipeline.shards.shard_set import open_shards
from tests.evaluation.test_evaluate import TEST_SET, made_table


def test_views_range_from_single_query_to_multi_query(tmp_path: Path) -> None:
    rows = evaluate(
        EvaluationSettings(table=made_table(tmp_path / "t", TEST_SET), out=str(tmp_path / "o"))
    )
    curve = storage.read_json(str(tmp_path / "o" / "views.json"))
    assert [(row["views"], row["queries"]) for row in curve] == [(1, 10), (2, 5)]
    assert [curve[0][name] for name in ("r1", "ap", "r1_low")] == pytest.approx(
        [rows[0][name] for name in ("r1", "ap", "r1_low")]
    )
    assert [curve[1][name] for name in ("r1", "ap")] == pytest.approx(
        [rows[2][name] for name in ("r1", "ap")]
    )


def test_evaluate_writes_the_same_bytes_for_any_workers(tmp_path: Path, ray_cluster: None) -> None:
    table = made_table(tmp_path / "t", TEST_SET)
    for workers in (0, 1, 3):
        evaluate(
            EvaluationSettings(
                table=table, out=str(tmp_path / f"{workers}"), workers=workers, exports=("answer",)
            )
        )
    names = sorted(path.name for path in (tmp_path / "0").iterdir())
    assert "answer-drone-satellite.txt" in names
    for workers in (1, 3):
        assert all(
            (tmp_path / f"{workers}" / n).read_bytes() == (tmp_path / "0" / n).read_bytes()
            for n in names
        )


def test_evaluate_adds_an_export_without_ranking_again(tmp_path: Path) -> None:
    table, out = made_table(tmp_path / "t", TEST_SET), tmp_path / "o"
    evaluate(EvaluationSettings(table=table, out=str(out)))
    ranked = (out / "queries.parquet").stat().st_mtime_ns
    evaluate(EvaluationSettings(table=table, out=str(out), exports=("mat",)))
    assert (out / "pytorch_result-satellite-drone.mat").exists()
    assert (out / "queries.parquet").stat().st_mtime_ns == ranked


@pytest.mark.parametrize(
    ("asked", "sentence"),
    [
        ({"by": ("altitude_m",)}, r"found --by altitude_m without --shards"),
        ({"answer_order": "x"}, r"expected one task .*--exports answer and --shards"),
        ({"workers": -1}, r"--workers is -1"),
        ({"panels": -1}, r"--panels is -1"),
    ],
)
def test_settings_refuse_flags_that_do_not_go_together(
    asked: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(InputError, match=sentence):
        EvaluationSettings(table="t", out="o", **asked)


def results(*rows: tuple[str, str, int | None]) -> pa.Table:
    return pa.Table.from_pylist(
        [
            {
                "query": key,
                "location": place,
                "task": "drone->satellite",
                "protocol": "full",
                "multi_query": False,
                "first_match_rank": rank,
                "ap": 1.0 if rank == 1 else 0.0,
            }
            for key, place, rank in rows
        ],
        RESULTS_SCHEMA,
    )


def test_break_down_measures_the_queries_of_each_group() -> None:
    known = {"a": 80.0, "b": 100.0, "c": 80.0, "d": None}
    rows = breakdowns.break_down(
        results(("a", "1", 1), ("b", "1", 3), ("c", "2", None), ("d", "2", 1)), "altitude_m", known
    )
    assert [(row["value"], row["queries"], row["r1"], row["r5"], row["ap"]) for row in rows] == [
        ("80", 2, 0.5, 0.5, 0.5), ("100", 1, 0.0, 1.0, 0.0), ("unknown", 1, 1.0, 1.0, 1.0),
    ]  # fmt: skip
    assert (rows[0]["by"], rows[0]["locations"]) == ("altitude_m", 2)


def test_group_names_are_sectors_and_round_bins() -> None:
    names, _ = breakdowns.group_names("heading_deg", [0, 22.4, 22.6, 359, -90, 180, None])
    assert names.tolist() == ["N", "N", "NE", "N", "W", "S", "unknown"]
    values = [float(v) for v in range(100, 251, 5)]
    names, order = breakdowns.group_names("altitude_m", values)
    assert order == ["100 to 150", "150 to 200", "200 to 250", "unknown"]
    assert (names[0], names[10], names[-1]) == ("100 to 150", "150 to 200", "200 to 250")
    assert breakdowns.group_names("variant", ["b", "a", None])[1] == ["a", "b", "unknown"]


@pytest.mark.slow
def test_read_column_reads_the_records_beside_the_shards(tiny_shards: str) -> None:
    assert set(breakdowns.read_column(open_shards(tiny_shards), "view").values()) == {
        "drone",
        "satellite",
    }
    with pytest.raises(
        InputError,
        match=r"--by is colour, expected a column of the shards' records: location, view",
    ):
        breakdowns.read_column(open_shards(tiny_shards), "colour")


@pytest.mark.slow
def test_evaluate_measures_distances_from_positions(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    places = ["0001", "0002"]
    for split, view, off in (("query", "drone", 0.0), ("gallery", "satellite", 0.0005)):
        write_part(
            str(tmp_path / "t" / f"{split}.parquet"),
            PartRows(
                keys=[f"{split}-{p}" for p in places],
                locations=places,
                views=[view] * 2,
                splits=[split] * 2,
                lats=[30.0 + off, 31.0 + off],
                lons=[120.0, 120.0],
                embeddings_BD=np.eye(2, dtype=np.float32),
            ),
            PartFooter(fingerprint="f", shard_sha256=split, rows=2),
        )
    asked_for = EvaluationSettings(
        table=str(tmp_path / "t"), out=str(tmp_path / "o"), figures=("pdf",)
    )
    job.main(asked_for, published=True)
    [row, merged] = storage.read_json(str(tmp_path / "o" / "metrics.json"))
    assert (row["geo_queries"], row["within_25m"], row["within_100m"]) == (2, 0.0, 1.0)
    assert row["distance_median_m"] == pytest.approx(55.6, abs=0.05)
    assert row["distance_p90_m_low"] == pytest.approx(55.6, abs=0.05)
    assert (row["within_25m_low"], row["within_25m_high"]) == (0, 0)
    assert row["sdm1"] == pytest.approx(np.exp(-2.5))
    assert row["sdm3"] is None
    assert merged["geo_queries"] == 0
    assert pq.read_table(tmp_path / "o" / "metrics.parquet").to_pylist() == [row, merged]
    asked = pq.read_table(tmp_path / "o" / "queries.parquet").to_pylist()
    assert [each["distance_m"] for each in asked[:2]] == pytest.approx([55.6, 55.6], abs=0.05)
    assert [asked[1][name] for name in ("lat", "lon", "answer_lat", "answer_lon")] == [
        31.0,
        120.0,
        31.0005,
        120.0,
    ]
    assert asked[2]["distance_m"] is None
    assert (tmp_path / "o" / "figures" / "map-drone-satellite.pdf").exists()
    report = (tmp_path / "o" / "report.html").read_text()
    assert 'id="map"' in report
    assert 'id="metres"' in report
    output = capsys.readouterr().out
    assert "55.6 m" in output
    assert "published" in output
    assert "82.73" in output
    assert "…" not in output
