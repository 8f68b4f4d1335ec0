"""The feature table: round trips, other people's readers, and what is refused."""

from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.dataset
import pyarrow.parquet as pq
import pytest

from pipeline.features import PartFooter, PartRows, open_table, read_footer, write_part
from pipeline.records import InputError, Rejection, Split, View

FOOTER = PartFooter(fingerprint="f" * 64, shard_sha256="s" * 64, rows=5)


def write(
    folder: Path, split: str, view: str, seed: int, dtype: str = "float32", footer: PartFooter = FOOTER
) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(5, 8)).astype(np.float32)
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    rows = PartRows(
        keys=[f"{split}-{view}-{n}" for n in range(5)], locations=list("abcde"), views=[view] * 5, splits=[split] * 5,
        lats=[50.0, None, 1.0, 2.0, 3.0], lons=[4.0, None, 1.0, 2.0, 3.0], embeddings_BD=vectors,
    )  # fmt: skip
    write_part(str(folder / f"{split}-{view}-000000.parquet"), rows, footer, dtype)
    return vectors


def test_what_is_written_is_read_back_by_split_and_view(tmp_path: Path) -> None:
    drone, satellite = write(tmp_path, "query", "drone", 0), write(tmp_path, "gallery", "satellite", 1)
    table = open_table(str(tmp_path))
    assert (table.rows, table.dimension, table.fingerprint) == (10, 8, "f" * 64)
    assert table.counts == {(Split.QUERY, View.DRONE): 5, (Split.GALLERY, View.SATELLITE): 5}
    assert np.array_equal(table.select(Split.QUERY, View.DRONE).embeddings(), drone)
    assert np.array_equal(np.concatenate(list(table.select(view=View.SATELLITE).blocks(rows=2))), satellite)
    labels = table.select(Split.QUERY).labels()
    assert labels.keys.tolist() == [f"query-drone-{n}" for n in range(5)]
    assert labels.locations.tolist() == list("abcde")
    assert np.array_equal(labels.lats, [50, np.nan, 1, 2, 3], equal_nan=True)
    assert table.select(view=View.STREET).rows == 0
    assert table.select(view=View.STREET).embeddings().shape == (0, 8)
    assert table.select(view=View.STREET).labels().keys.tolist() == []


def test_a_part_that_mixes_splits_is_filtered_by_row(tmp_path: Path) -> None:
    rows = PartRows(
        keys=["a", "b"], locations=["1", "2"], views=["drone", "satellite"], splits=["query", "gallery"],
        lats=[None, None], lons=[None, None], embeddings_BD=np.eye(2, dtype=np.float32),
    )  # fmt: skip
    write_part(str(tmp_path / "mixed.parquet"), rows, PartFooter(fingerprint="f", shard_sha256="s", rows=2))
    assert open_table(str(tmp_path)).select(Split.GALLERY).labels().keys.tolist() == ["b"]


def test_half_precision_is_stored_as_such_and_read_as_float32(tmp_path: Path) -> None:
    vectors = write(tmp_path, "query", "drone", 0, "float16")
    read = open_table(str(tmp_path)).embeddings()
    assert read.dtype == np.float32
    assert np.abs(read - vectors).max() < 5e-4


def test_pandas_and_pyarrow_read_the_table_as_it_is(tmp_path: Path) -> None:
    vectors = write(tmp_path, "query", "drone", 0)
    frame = pd.read_parquet(tmp_path)
    assert frame["key"].tolist() == [f"query-drone-{n}" for n in range(5)]
    assert np.array_equal(np.stack(frame["embedding"].to_numpy()), vectors)
    assert pyarrow.dataset.dataset(tmp_path).count_rows() == 5


def test_the_footer_says_what_made_the_part(tmp_path: Path) -> None:
    footer = PartFooter(
        fingerprint="f",
        shard_sha256="s",
        rows=5,
        rejected=(Rejection(path="k", reason="damaged image", found="9 bytes"),),
    )
    write(tmp_path, "query", "drone", 0, footer=footer)
    assert read_footer(str(tmp_path / "query-drone-000000.parquet")) == footer


def test_embeddings_are_neither_compressed_nor_given_statistics(tmp_path: Path) -> None:
    write(tmp_path, "query", "drone", 0)
    group = pq.ParquetFile(tmp_path / "query-drone-000000.parquet").metadata.row_group(0)
    columns = {group.column(n).path_in_schema: group.column(n) for n in range(group.num_columns)}
    embedding = next(column for path, column in columns.items() if path.startswith("embedding"))
    assert embedding.compression == "UNCOMPRESSED"
    assert not embedding.is_stats_set
    assert "PLAIN" in embedding.encodings
    assert not any("DICTIONARY" in encoding for encoding in embedding.encodings)


def test_two_networks_in_one_table_are_refused_with_the_remedy(tmp_path: Path) -> None:
    write(tmp_path, "query", "drone", 0)
    write(tmp_path, "gallery", "drone", 1, footer=PartFooter(fingerprint="g" * 64, shard_sha256="s", rows=5))
    with pytest.raises(InputError, match=r"features of 2 networks.*embed into an empty folder"):
        open_table(str(tmp_path))


def test_no_table_a_foreign_file_and_a_torn_one_are_told_apart(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="found no Parquet part"):
        open_table(str(tmp_path))
    (tmp_path / "a.parquet").write_bytes(b"torn")
    with pytest.raises(InputError, match="not a readable Parquet file"):
        open_table(str(tmp_path))
    pd.DataFrame({"x": [1]}).to_parquet(tmp_path / "a.parquet")
    with pytest.raises(InputError, match="expected a part written by embed_gallery"):
        open_table(str(tmp_path))


def test_a_part_with_fewer_rows_than_it_says_is_refused(tmp_path: Path) -> None:
    write(tmp_path, "query", "drone", 0, footer=PartFooter(fingerprint="f", shard_sha256="s", rows=6))
    with pytest.raises(InputError, match="says version 1 and 6 rows and holds 5"):
        open_table(str(tmp_path))
