"""Parts and lists of a feature table,
damaged by flipped bits, zeroed blocks, truncation and removal: rejected, or read as it was.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from pipeline.core.errors import InputError
from pipeline.core.geo import Box
from pipeline.core.records import Split, View
from pipeline.features.part import PartFooter, PartRows, read_header, verify_part, write_part
from pipeline.features.rejected import read_rejected, rejected_file, write_rejected
from pipeline.features.row_reader import RowReader
from pipeline.features.table import open_table
from tests.damaging import (
    count_detected,
    damaged_versions,
    raising_if_missing,
)

ROWS, DIMENSION = 40, 16


@pytest.fixture
def part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A feature table of one part, in three row groups."""
    monkeypatch.setattr("pipeline.features.part.ROW_GROUP", 16)
    vectors = np.random.default_rng(0).normal(size=(ROWS, DIMENSION)).astype(np.float32)
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    places = [None if number % 5 == 0 else 40 + number / 7 for number in range(ROWS)]
    rows = PartRows(
        keys=[f"k{number}" for number in range(ROWS)],
        locations=[f"place{number // 4}" for number in range(ROWS)],
        views=["drone"] * 20 + ["satellite"] * 20,
        splits=["gallery"] * ROWS,
        lats=places,
        lons=places,
        embeddings_BD=vectors,
    )
    path = tmp_path / "table" / "gallery-drone-000000.parquet"
    write_part(str(path), rows, PartFooter(fingerprint="f" * 64, shard_sha256="s" * 64, rows=ROWS))
    return path


def look_at_table(part: Path) -> list[Any]:
    """Everything that can be read from a table, by every way of reading it."""
    try:
        table = open_table(str(part.parent))
    except InputError as error:
        if "no feature table" not in str(error):
            raise
        raise InputError(f"{part}: {error}") from None  # it was the only part
    seen: list[Any] = [table.fingerprint, table.counts, table.footers]
    box = Box(south=41, north=43, west=0, east=90)
    for rows in (
        table,
        table.select(view=View.DRONE),
        table.select(locations=["place7", "place3"]),
        table.select(box=box),
    ):
        labels = rows.labels()
        seen += [
            rows.rows,
            labels.keys.tolist(),
            labels.locations.tolist(),
            np.nan_to_num(labels.lats).tolist(),
        ]
        seen += [np.nan_to_num(labels.lons).tolist(), rows.embeddings().tobytes()]
    seen.append(
        [
            (name, rows.to_pylist())
            for name, rows in table.select(Split.GALLERY).numbered_rows(["key"])
        ]
    )
    seen.append(
        RowReader(str(part.parent), DIMENSION).read(part.name, "s" * 64, np.arange(ROWS)).tobytes()
    )
    return seen


@pytest.mark.slow
def test_part_damaged_is_rejected_by_every_reader(part: Path) -> None:
    assert count_detected(part, lambda: look_at_table(part), 400) > 300


def test_footer_checksum_is_compared_before_arrow_reads(part: Path) -> None:
    """Arrow ends the process over some flipped bits, and accepts others."""
    good, rng = part.read_bytes(), np.random.default_rng(0)
    begin = len(good) - 8 - int.from_bytes(good[-8:-4], "little")
    for place in range(begin - len(good), 0, 3):
        data = bytearray(good)
        data[place] ^= 1 << int(rng.integers(8))
        part.write_bytes(data)
        with pytest.raises(InputError, match=re.escape(f"{part} is not a readable Parquet file")):
            read_header(str(part))


def test_verify_part_checks_every_byte(part: Path) -> None:
    assert (
        count_detected(part, raising_if_missing(part, lambda: verify_part(str(part))), 200) == 201
    )


def test_part_without_checksums_is_read(part: Path) -> None:
    expected, whole = look_at_table(part), pq.read_table(part)
    for dictionary in (False, ["key", "view"]):
        pq.write_table(
            whole, part, row_group_size=16, compression="none", use_dictionary=dictionary
        )
        assert look_at_table(part) == expected
        verify_part(str(part))


def test_rejected_of_table_damaged_is_rewritten(tmp_path: Path) -> None:
    rows = [("shard", "key", "reason", "found")]
    write_rejected(str(tmp_path), rows)
    path = Path(rejected_file(str(tmp_path)))

    look = raising_if_missing(path, lambda: read_rejected(str(tmp_path)).to_pylist())
    assert count_detected(path, look, 100) > 80
    for data in damaged_versions(path.read_bytes(), 30, seed=1):
        path.write_bytes(data or b"")
        write_rejected(str(tmp_path), rows)
        assert len(read_rejected(str(tmp_path))) == 1
