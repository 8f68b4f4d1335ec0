"""The feature table: round trips, readers of other programs, and what is rejected."""

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.dataset
import pyarrow.parquet as pq
import pytest

from pipeline.core.errors import InputError
from pipeline.core.records import Rejection, Split, View
from pipeline.features.expected_parts import add_expected
from pipeline.features.part import PartFooter, PartRows, read_footer, write_part
from pipeline.features.rejected import read_rejected, write_rejected
from pipeline.features.table import open_table, verify_table

FOOTER = PartFooter(fingerprint="f" * 64, shard_sha256="s" * 64, rows=5)


def write(
    folder: Path,
    split: str,
    view: str,
    seed: int,
    dtype: str = "float32",
    footer: PartFooter = FOOTER,
) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(5, 8)).astype(np.float32)
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    rows = PartRows(
        keys=[f"{split}-{view}-{n}" for n in range(5)],
        locations=list("abcde"),
        views=[view] * 5,
        splits=[split] * 5,
        lats=[50.0, None, 1.0, 2.0, 3.0],
        lons=[4.0, None, 1.0, 2.0, 3.0],
        embeddings_BD=vectors,
    )
    write_part(str(folder / f"{split}-{view}-000000.parquet"), rows, footer, dtype)
    return vectors


def test_table_round_trip_by_split_and_view(tmp_path: Path) -> None:
    drone, satellite = (
        write(tmp_path, "query", "drone", 0),
        write(tmp_path, "gallery", "satellite", 1),
    )
    table = open_table(str(tmp_path))
    assert (table.rows, table.dimension, table.fingerprint) == (10, 8, "f" * 64)
    assert table.counts == {(Split.QUERY, View.DRONE): 5, (Split.GALLERY, View.SATELLITE): 5}
    assert np.array_equal(table.select(Split.QUERY, View.DRONE).embeddings(), drone)
    assert np.array_equal(
        np.concatenate(list(table.select(view=View.SATELLITE).blocks(rows=2))), satellite
    )
    labels = table.select(Split.QUERY).labels()
    assert labels.keys.tolist() == [f"query-drone-{n}" for n in range(5)]
    assert labels.locations.tolist() == list("abcde")
    assert np.array_equal(labels.lats, [50, np.nan, 1, 2, 3], equal_nan=True)
    assert table.select(view=View.STREET).rows == 0
    assert table.select(view=View.STREET).embeddings().shape == (0, 8)
    assert table.select(view=View.STREET).labels().keys.tolist() == []


def test_table_filters_mixed_part_by_row(tmp_path: Path) -> None:
    rows = PartRows(
        keys=["a", "b"],
        locations=["1", "2"],
        views=["drone", "satellite"],
        splits=["query", "gallery"],
        lats=[None, None],
        lons=[None, None],
        embeddings_BD=np.eye(2, dtype=np.float32),
    )
    write_part(
        str(tmp_path / "mixed.parquet"), rows, PartFooter(fingerprint="f", shard_sha256="s", rows=2)
    )
    assert open_table(str(tmp_path)).select(Split.GALLERY).labels().keys.tolist() == ["b"]


def test_write_part_float16_is_read_as_float32(tmp_path: Path) -> None:
    vectors = write(tmp_path, "query", "drone", 0, "float16")
    read = open_table(str(tmp_path)).embeddings()
    assert read.dtype == np.float32
    assert np.abs(read - vectors).max() < 5e-4


def test_table_is_read_by_pandas_and_pyarrow(tmp_path: Path) -> None:
    vectors = write(tmp_path, "query", "drone", 0)
    frame = pd.read_parquet(tmp_path)
    assert frame["key"].tolist() == [f"query-drone-{n}" for n in range(5)]
    assert np.array_equal(np.stack(frame["embedding"].to_numpy()), vectors)
    assert pyarrow.dataset.dataset(tmp_path).count_rows() == 5


def test_footer_records_encoder_and_shard(tmp_path: Path) -> None:
    footer = PartFooter(
        fingerprint="f",
        shard_sha256="s",
        rows=5,
        rejected=(Rejection(path="k", reason="damaged image", found="9 bytes"),),
    )
    write(tmp_path, "query", "drone", 0, footer=footer)
    assert read_footer(str(tmp_path / "query-drone-000000.parquet")) == footer


def test_write_part_stores_plain_embeddings(tmp_path: Path) -> None:
    write(tmp_path, "query", "drone", 0)
    group = pq.ParquetFile(tmp_path / "query-drone-000000.parquet").metadata.row_group(0)
    columns = {group.column(n).path_in_schema: group.column(n) for n in range(group.num_columns)}
    embedding = next(column for path, column in columns.items() if path.startswith("embedding"))
    assert embedding.compression == "UNCOMPRESSED"
    assert not embedding.is_stats_set
    assert "PLAIN" in embedding.encodings
    assert not any("DICTIONARY" in encoding for encoding in embedding.encodings)


def test_table_rejects_two_fingerprints(tmp_path: Path) -> None:
    write(tmp_path, "query", "drone", 0)
    write(
        tmp_path,
        "gallery",
        "drone",
        1,
        footer=PartFooter(fingerprint="g" * 64, shard_sha256="s", rows=5),
    )
    with pytest.raises(InputError, match=r"features of 2 networks.*embed into an empty folder"):
        open_table(str(tmp_path))


def test_open_table_distinguishes_absent_foreign_torn(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="found no Parquet part"):
        open_table(str(tmp_path))
    (tmp_path / "a.parquet").write_bytes(b"torn")
    with pytest.raises(InputError, match="not a readable Parquet file"):
        open_table(str(tmp_path))
    pd.DataFrame({"x": [1]}).to_parquet(tmp_path / "a.parquet")
    with pytest.raises(InputError, match="expected a part written by embed_gallery"):
        open_table(str(tmp_path))


def test_table_rejects_part_with_missing_rows(tmp_path: Path) -> None:
    write(
        tmp_path, "query", "drone", 0, footer=PartFooter(fingerprint="f", shard_sha256="s", rows=6)
    )
    with pytest.raises(InputError, match="has 5 rows and its footer says 6"):
        open_table(str(tmp_path))


def test_table_reads_large_part_in_little_memory(tmp_path: Path) -> None:
    rows, dimension = 60_000, 256  # 61 MB
    vectors = np.zeros((rows, dimension), np.float32)
    vectors[np.arange(rows), np.arange(rows) % dimension] = 1
    write_part(
        str(tmp_path / "a.parquet"),
        PartRows(
            keys=[str(n) for n in range(rows)],
            locations=["a"] * rows,
            views=["drone"] * rows,
            splits=["train"] * rows,
            lats=[None] * rows,
            lons=[None] * rows,
            embeddings_BD=vectors,
        ),
        PartFooter(fingerprint="f", shard_sha256="s", rows=rows),
    )
    table, before, most = open_table(str(tmp_path)), pa.total_allocated_bytes(), 0
    for _ in table.blocks(rows=1000):
        most = max(most, pa.total_allocated_bytes() - before)
    assert most < 12e6


@pytest.mark.parametrize("length", [np.nan, 0.0, 1.1])
def test_table_rejects_non_unit_embedding(tmp_path: Path, length: float) -> None:
    write(tmp_path, "gallery", "satellite", 1)
    rows = PartRows(
        keys=["k"], locations=["a"], views=["drone"], splits=["query"], lats=[None], lons=[None],
        embeddings_BD=np.eye(1, 8, dtype=np.float32) * length,
    )  # fmt: skip
    footer = PartFooter(fingerprint="f" * 64, shard_sha256="s", rows=1)
    write_part(str(tmp_path / "query-drone-000000.parquet"), rows, footer)
    table = open_table(str(tmp_path))
    with pytest.raises(
        InputError, match=r"query-drone-000000\.parquet holds 1 embeddings like one of length"
    ):
        table.embeddings()
    with pytest.raises(InputError, match=r"query-drone-000000\.parquet"):
        verify_table(str(tmp_path))
    assert table.select(Split.GALLERY).embeddings().shape == (5, 8)


def test_table_rejects_duplicate_key_with_both_parts(tmp_path: Path) -> None:
    write(tmp_path, "query", "drone", 0)
    shutil.copy(tmp_path / "query-drone-000000.parquet", tmp_path / "query-drone-000001.parquet")
    sentence = (
        r"query-drone-000001\.parquet holds key query-drone-0, which "
        r"query-drone-000000\.parquet holds too"
    )
    for opened in (open_table, verify_table):
        with pytest.raises(InputError, match=sentence):
            opened(str(tmp_path))


def test_table_rejects_mixed_dtypes(tmp_path: Path) -> None:
    write(tmp_path, "query", "drone", 0, "float16")
    write(tmp_path, "gallery", "drone", 1)
    with pytest.raises(
        InputError,
        match=r"query-drone-000000\.parquet holds float16 of 8 dimensions and gallery-drone",
    ):
        open_table(str(tmp_path))


def test_rejected_list_is_hidden_from_readers(tmp_path: Path) -> None:
    write(tmp_path, "query", "drone", 0)
    add_expected(str(tmp_path), ["query-drone-000000.parquet"])
    assert write_rejected(
        str(tmp_path), [("s", "k", "not an image", "9 bytes"), ("r", None, "unusable", "cut off")]
    )
    assert not write_rejected(
        str(tmp_path), [("r", None, "unusable", "cut off"), ("s", "k", "not an image", "9 bytes")]
    )
    assert read_rejected(str(tmp_path))["shard"].to_pylist() == ["r", "s"]
    assert (
        len(pd.read_parquet(tmp_path))
        == pyarrow.dataset.dataset(tmp_path).count_rows()
        == open_table(str(tmp_path)).rows
    )
    assert [path.name for path in tmp_path.iterdir()] == ["query-drone-000000.parquet"]
    assert write_rejected(str(tmp_path), [])
    assert len(read_rejected(str(tmp_path))) == 0


def test_table_folder_is_read_by_polars(tmp_path: Path) -> None:
    polars = pytest.importorskip("polars")
    vectors = write(tmp_path, "query", "drone", 0, "float16")
    add_expected(str(tmp_path), ["query-drone-000000.parquet"])
    write_rejected(str(tmp_path), [("s", "k", "not an image", "9 bytes")])
    frame = polars.read_parquet(tmp_path)
    assert frame["key"].to_list() == [f"query-drone-{row}" for row in range(len(vectors))]
    assert np.array_equal(frame["embedding"].to_numpy(), vectors)


def test_docs_snippets_run(tmp_path: Path) -> None:
    vectors = write(tmp_path, "query", "drone", 0)
    write_rejected(str(tmp_path), [("s", "k", "not an image", "9 bytes")])
    frame = pd.read_parquet(tmp_path, filters=[("view", "==", "drone")])
    assert np.array_equal(np.stack(frame.embedding.to_list()), vectors)
    duckdb = pytest.importorskip("duckdb")
    connection = duckdb.connect()
    connection.execute("set enable_progress_bar = false")
    counted = connection.sql(
        f"select split, view, count(*) from '{tmp_path}/*.parquet' group by all"
    ).fetchall()
    assert counted == [("query", "drone", 5)]
    nearest = connection.sql(f"""
        with photo as (select embedding from '{tmp_path}/*.parquet' where key = 'query-drone-2')
        select t.key, list_inner_product(t.embedding, photo.embedding) as score
        from '{tmp_path}/*.parquet' t, photo order by score desc limit 1""").fetchall()
    assert nearest[0][0] == "query-drone-2"
    rejected = connection.sql(
        f"select shard, key, reason from '{tmp_path}.rejected.parquet'"
    ).fetchall()
    assert rejected == [("s", "k", "not an image")]
