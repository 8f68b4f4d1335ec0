"""The evaluation stage from tables on disk to a finished folder, and its refusals."""

import io
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from PIL import Image
from webdataset import TarWriter

from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.json_files import write_checksummed
from pipeline.core.records import Split, View
from pipeline.evaluation.evaluate import evaluate
from pipeline.evaluation.settings import EvaluationSettings
from pipeline.features.part import PartFooter, PartRows, write_part
from pipeline.shards.manifest import Manifest, Shard

pytestmark = pytest.mark.slow

COLUMNS = [
    "task",
    "protocol",
    "multi_query",
    "queries",
    "gallery",
    "r1",
    "r5",
    "r10",
    "r1p",
    "ap",
    "fingerprint",
]
TEST_SET = [
    (split, view) for split in (Split.QUERY, Split.GALLERY) for view in (View.DRONE, View.SATELLITE)
]


def made_table(
    folder: Path, groups: list[tuple[Split, View]], fingerprint: str = "f" * 64, seed: int = 0
) -> str:
    """One part for each split and view: five queried places and three more in the gallery, two
    images of each.
    """
    rng = np.random.default_rng(7)
    centres = rng.standard_normal((8, 16))
    noise = np.random.default_rng(seed)
    for split, view in groups:
        places = [f"{i:04d}" for i in range(5 if split == Split.QUERY else 8) for _ in range(2)]
        vectors = np.array([centres[int(p)] + 0.8 * noise.standard_normal(16) for p in places])
        vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
        count, keys = len(places), [f"{split}-{view}-{place}-{i}" for i, place in enumerate(places)]
        write_part(
            str(folder / f"{split}-{view}-000000.parquet"),
            PartRows(
                keys=keys,
                locations=places,
                views=[view] * count,
                splits=[split] * count,
                lats=[None] * count,
                lons=[None] * count,
                embeddings_BD=vectors.astype(np.float32),
            ),
            PartFooter(fingerprint=fingerprint, shard_sha256=f"{split}{view}{seed}", rows=count),
        )
    return str(folder)


def test_evaluate_table_on_every_possible_task(tmp_path: Path) -> None:
    out = tmp_path / "out"
    rows = evaluate(EvaluationSettings(table=made_table(tmp_path / "t", TEST_SET), out=str(out)))
    assert [(row["task"], row["multi_query"], row["queries"], row["gallery"]) for row in rows] == [
        ("drone->satellite", False, 10, 16),
        ("satellite->drone", False, 10, 16),
        ("drone->satellite", True, 5, 16),
    ]
    assert all(list(row)[: len(COLUMNS)] == COLUMNS for row in rows)
    assert (
        storage.read_json(str(out / "metrics.json"))
        == rows
        == pq.read_table(out / "metrics.parquet").to_pylist()
    )
    assert len(pq.read_table(out / "queries.parquet")) == 25
    assert "drone → satellite" in (out / "report.html").read_text()
    [gap] = storage.read_json(str(out / "view_gap.json"))  # one for both directions
    assert (gap["task"], len(gap["points"]), gap["true"]["pairs"]) == ("drone->satellite", 20, 20)
    assert not (out / "parts.json").exists()  # these embeddings have none


def test_evaluate_fetches_images_from_the_shards(tmp_path: Path) -> None:
    table, shards = made_table(tmp_path / "t", TEST_SET), tmp_path / "shards"
    picture, listed = io.BytesIO(), []
    Image.new("RGB", (8, 8)).save(picture, "PNG")
    shards.mkdir()
    for path in sorted((tmp_path / "t").iterdir()):
        split, view, _ = path.stem.split("-")
        listed.append(
            Shard(
                name=path.stem, split=Split(split), view=View(view), samples=16, bytes=0, sha256=""
            )
        )
        with TarWriter(str(shards / f"{path.stem}.tar")) as tar:
            for key in pq.read_table(path)["key"].to_pylist():
                tar.write({"__key__": key, "png": picture.getvalue(), "json": {"key": key}})
    manifest = Manifest(shards=tuple(listed), classes=(), packing={}, rejected=0)
    write_checksummed(str(shards / "manifest.json"), asdict(manifest))
    evaluate(EvaluationSettings(table=table, out=str(tmp_path / "out"), shards=str(shards)))
    text = (tmp_path / "out" / "report.html").read_text()
    assert text.count("<img src=") >= 2 * (1 + 5)
    assert "no picture" not in text


def test_evaluate_two_tables_on_their_one_task(tmp_path: Path) -> None:
    queries, gallery = (
        made_table(tmp_path / "q", TEST_SET[1:2]),
        made_table(tmp_path / "g", TEST_SET[2:3]),
    )
    [row] = evaluate(
        EvaluationSettings(
            queries=queries, gallery=gallery, out=str(tmp_path / "o"), protocol="queried-only"
        )
    )
    assert (row["task"], row["protocol"], row["queries"], row["gallery"]) == (
        "satellite->drone",
        "queried-only",
        10,
        10,
    )
    [row] = evaluate(
        EvaluationSettings(
            queries=queries, gallery=gallery, out=str(tmp_path / "m"), multi_query=True
        )
    )
    assert (row["multi_query"], row["queries"], row["gallery"]) == (True, 5, 16)


def test_evaluate_rerun_of_a_finished_evaluation_is_a_no_op(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = EvaluationSettings(
        table=made_table(tmp_path / "t", TEST_SET), out=str(tmp_path / "out")
    )
    first = evaluate(asked)
    before = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "out").iterdir()}
    capsys.readouterr()
    assert evaluate(asked) == first
    assert {path.name: path.stat().st_mtime_ns for path in (tmp_path / "out").iterdir()} == before
    assert "nothing to do" in capsys.readouterr().err


def test_evaluate_with_another_title_rewrites_the_report_only(tmp_path: Path) -> None:
    table, out = made_table(tmp_path / "t", TEST_SET), tmp_path / "out"
    evaluate(EvaluationSettings(table=table, out=str(out)))
    ranked = (out / "queries.parquet").stat().st_mtime_ns
    evaluate(EvaluationSettings(table=table, out=str(out), title="Our town"))
    assert "<h1>Our town</h1>" in (out / "report.html").read_text()
    assert (out / "queries.parquet").stat().st_mtime_ns == ranked


def test_evaluate_redoes_an_unfinished_evaluation(tmp_path: Path) -> None:
    asked = EvaluationSettings(
        table=made_table(tmp_path / "t", TEST_SET), out=str(tmp_path / "out")
    )
    evaluate(asked)
    complete = {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()}
    (tmp_path / "out" / "metrics.json").unlink()
    (tmp_path / "out" / "report.html").write_text("half")
    evaluate(asked)
    assert {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()} == complete


def test_evaluate_refuses_a_folder_of_another_evaluation(tmp_path: Path) -> None:
    table, out = made_table(tmp_path / "t", TEST_SET), str(tmp_path / "out")
    evaluate(EvaluationSettings(table=table, out=out))
    with pytest.raises(InputError, match=r"different protocol.*choose another --out"):
        evaluate(EvaluationSettings(table=table, out=out, protocol="queried-only"))
    with pytest.raises(InputError, match=r"different queries, gallery"):
        evaluate(EvaluationSettings(table=made_table(tmp_path / "u", TEST_SET, seed=1), out=out))


def test_evaluate_refuses_tables_of_two_networks(tmp_path: Path) -> None:
    queries = made_table(tmp_path / "q", TEST_SET[:1])
    gallery = made_table(tmp_path / "g", TEST_SET[3:], fingerprint="e" * 64)
    with pytest.raises(InputError, match=r"embed both with the same checkpoint"):
        evaluate(EvaluationSettings(queries=queries, gallery=gallery, out=str(tmp_path / "out")))


def test_evaluate_asks_for_views_if_several_tasks_fit(tmp_path: Path) -> None:
    table, out = made_table(tmp_path / "t", TEST_SET), str(tmp_path / "out")
    with pytest.raises(
        InputError, match=r"drone->satellite, satellite->drone; expected one task; .*--query-view"
    ):
        evaluate(EvaluationSettings(queries=table, gallery=table, out=out))
    [row] = evaluate(
        EvaluationSettings(queries=table, gallery=table, out=out, query_view="satellite")
    )
    assert row["task"] == "satellite->drone"


def test_evaluate_refuses_a_table_without_a_task(tmp_path: Path) -> None:
    with pytest.raises(
        InputError,
        match=r"query rows of drone in .* and gallery rows of drone in .*embed both splits",
    ):
        evaluate(
            EvaluationSettings(
                table=made_table(tmp_path / "t", TEST_SET[::2]), out=str(tmp_path / "out")
            )
        )


@pytest.mark.parametrize(
    "named",
    [{}, {"queries": "q"}, {"table": "t", "gallery": "g"}, {"table": "t", "multi_query": True}],
)
def test_settings_refuse_a_wrong_combination_of_tables(named: dict[str, str]) -> None:
    with pytest.raises(InputError, match=r"expected --table alone|leave it out"):
        EvaluationSettings(out="o", **named)  # type: ignore[arg-type]


def test_evaluate_refuses_a_damaged_or_unlike_beside(tmp_path: Path) -> None:
    table, other = made_table(tmp_path / "t", TEST_SET), str(tmp_path / "reduced")
    evaluate(EvaluationSettings(table=table, out=other))
    beside = EvaluationSettings(table=table, out=str(tmp_path / "out"), beside=other)
    assert evaluate(beside)
    assert "reduced" in (tmp_path / "out" / "report.html").read_text()
    queries, gallery = (
        made_table(tmp_path / "q", TEST_SET[:1]),
        made_table(tmp_path / "g", TEST_SET[3:] * 2),
    )
    (tmp_path / "reduced" / "metrics.json").write_text(
        (tmp_path / "reduced" / "metrics.json").read_text().replace('"gallery": 16', '"gallery": 9')
    )
    with pytest.raises(InputError, match=r"reduced/metrics.json is damaged .* evaluate again"):
        evaluate(
            EvaluationSettings(
                queries=queries, gallery=gallery, out=str(tmp_path / "one"), beside=other
            )
        )
    (tmp_path / "reduced" / "evaluation.json").unlink()
    with pytest.raises(InputError, match=r"reduced ranked 10 queries in 9 rows.*same images"):
        evaluate(
            EvaluationSettings(
                queries=queries, gallery=gallery, out=str(tmp_path / "one"), beside=other
            )
        )
