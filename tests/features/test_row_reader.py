"""Single rows of a table equal what pyarrow reads; changed parts are rejected."""

import resource
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.core.arrays import Ints
from pipeline.core.errors import InputError
from pipeline.features import row_reader
from pipeline.features.row_reader import RowReader, supports_row_reads
from tests.index.index_tables import clustered, write_table_part

NAME = "gallery-satellite-000000.parquet"


@pytest.mark.parametrize("dtype", ["float16", "float32"])
def test_row_reader_equals_pyarrow(tmp_path: Path, dtype: str) -> None:
    """40,000 rows: three row groups, of several pages each."""
    vectors = clustered(40_000, 24, 0)
    write_table_part(tmp_path, 0, vectors, dtype=dtype)
    numbers = np.array([39_999, 0, 16_383, 16_384, 16_384, 7, 32_768, 25_000])
    found = RowReader(str(tmp_path), 24).read(NAME, "shard 0", numbers)
    assert found.dtype == dtype
    assert np.array_equal(found, vectors.astype(dtype)[numbers])
    assert RowReader(str(tmp_path), 24).read(NAME, "shard 0", numbers[:0]).shape == (0, 24)


@given(
    rows=st.integers(1, 60), dimension=st.integers(1, 40),
    page=st.sampled_from([64, 100, 1000]), group=st.integers(1, 40),
    version=st.sampled_from(["1.0", "2.0"]), dtype=st.sampled_from(["float16", "float32"]),
)  # fmt: skip
@settings(max_examples=40)
def test_row_reader_finds_rows_across_pages(
    tmp_path_factory: pytest.TempPathFactory,
    rows: int,
    dimension: int,
    page: int,
    group: int,
    version: str,
    dtype: str,
) -> None:
    """Small pages, small groups, either kind of page; rows may lie across pages."""
    folder = tmp_path_factory.mktemp("pages")
    write_table_part(folder, 0, clustered(rows, dimension, 1), dtype=dtype)
    table = pq.read_table(folder / NAME)
    pq.write_table(
        table,
        folder / NAME,
        row_group_size=group,
        data_page_size=page,
        write_batch_size=7,
        compression="none",
        data_page_version=version,
        use_dictionary=["location"],
    )
    expected = (
        table["embedding"]
        .combine_chunks()
        .flatten()
        .to_numpy(zero_copy_only=False)
        .reshape(rows, dimension)
    )
    numbers = np.arange(rows)[::-1].copy()
    reader = RowReader(str(folder), dimension)
    wanted = [(NAME, "shard 0", numbers), (NAME, "shard 0", numbers[:1])]
    first, second = reader.read_all(wanted)
    assert np.array_equal(first, expected[::-1])
    assert np.array_equal(second, expected[-1:])


STORED: list[dict[str, object]] = [
    {"compression": "zstd"},
    {"compression": "none", "use_dictionary": True},
    {
        "compression": "none",
        "use_dictionary": False,
        "column_encoding": {"embedding.list.element": "BYTE_STREAM_SPLIT"},
    },
]


@pytest.mark.parametrize("stored", STORED)
def test_row_reader_rejects_encoded_embeddings(tmp_path: Path, stored: dict[str, object]) -> None:
    write_table_part(tmp_path, 0, clustered(20, 8, 1))
    table = pq.read_table(tmp_path / NAME)
    pq.write_table(table, tmp_path / NAME, **stored)
    with pytest.raises(InputError, match="compressed, encoded or damaged, expected plain ones"):
        RowReader(str(tmp_path), 8).read(NAME, "shard 0", np.array([3]))


@pytest.mark.parametrize(("seconds", "requests"), [(0.0, 2), (60.0, 0)])
def test_row_reader_requests_what_a_slow_disk_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seconds: float, requests: int
) -> None:
    monkeypatch.setattr(row_reader, "COLD_ROW_S", seconds)
    vectors = clustered(3_000, 24, 0)
    write_table_part(tmp_path, 0, vectors)
    reader, asked = RowReader(str(tmp_path), 24), list[str]()
    request = reader._request

    def counted(part: str, shard_sha256: str, row_R: Ints) -> None:
        asked.append(part)
        request(part, shard_sha256, row_R)

    monkeypatch.setattr(reader, "_request", counted)
    rows = [np.array([5, 2_000]), np.array([2_999]), np.array([0, 1, 1_000])]
    found = reader.read_all([(NAME, "shard 0", row_R) for row_R in rows])
    assert [
        np.array_equal(one, vectors[row_R]) for one, row_R in zip(found, rows, strict=True)
    ] == 3 * [True]
    assert len(asked) == requests


def test_row_reader_rejects_changed_or_missing_part(tmp_path: Path) -> None:
    write_table_part(tmp_path, 0, clustered(20, 8, 1))
    reader = RowReader(str(tmp_path), 8)
    with pytest.raises(InputError, match="no longer of the shard"):
        reader.read(NAME, "another", np.array([3]))
    with pytest.raises(InputError, match="which is not there"):
        reader.read("gallery-satellite-000009.parquet", "shard 9", np.array([3]))
    (tmp_path / NAME).write_bytes((tmp_path / NAME).read_bytes()[:-100])
    with pytest.raises(InputError, match="not a readable Parquet file"):
        reader.read(NAME, "shard 0", np.array([3]))


def test_row_reader_keeps_few_parts_open(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(row_reader, "most_open_parts", lambda: 2)
    for number in range(5):
        write_table_part(tmp_path, number, clustered(4, 8, number))
    reader = RowReader(str(tmp_path), 8)
    for number in (0, 1, 2, 0, 4, 3, 0):
        found = reader.read(
            f"gallery-satellite-{number:06d}.parquet", f"shard {number}", np.array([2])
        )
        assert np.array_equal(found, clustered(4, 8, number)[2:3])
        assert len(reader._open) <= 2


@pytest.mark.parametrize(
    ("soft", "hard", "raised", "parts"),
    [
        (1_024, 4_096, 4_096, 2_048),
        (1_024, 1_024, None, 512),
        (1_024, resource.RLIM_INFINITY, 65_536, 32_768),
        (1_048_576, 1_048_576, None, 32_768),
        (resource.RLIM_INFINITY, resource.RLIM_INFINITY, None, 32_768),
    ],
)
def test_most_open_parts_leaves_half_of_the_descriptors(
    monkeypatch: pytest.MonkeyPatch, soft: int, hard: int, raised: int | None, parts: int
) -> None:
    asked = list[tuple[int, int]]()
    monkeypatch.setattr(resource, "getrlimit", lambda which: (soft, hard))
    monkeypatch.setattr(resource, "setrlimit", lambda which, limits: asked.append(limits))
    assert row_reader.most_open_parts() == parts
    assert asked == ([] if raised is None else [(raised, hard)])


def test_most_open_parts_where_the_limit_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(which: int, limits: tuple[int, int]) -> None:
        raise ValueError("not allowed to raise maximum limit")

    monkeypatch.setattr(resource, "getrlimit", lambda which: (256, 4_096))
    monkeypatch.setattr(resource, "setrlimit", refuse)
    assert row_reader.most_open_parts() == 128


def test_row_reader_needs_local_table() -> None:
    assert supports_row_reads("/somewhere/table")
    assert not supports_row_reads("memory://table")
