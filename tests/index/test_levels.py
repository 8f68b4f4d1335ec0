"""Levels of a gallery in its index: the side of the ground that each image shows."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from pipeline.core import parquet
from pipeline.index.ids import RowIds
from pipeline.index.searcher import Index
from tests.index.index_tables import build, clustered, write_table_part

SIDES = [60.0, 120.0, None, 61.0, 240.0]


@pytest.fixture
def table(tmp_path: Path) -> Path:
    write_table_part(tmp_path / "table", 0, clustered(5, 8, 0), sides_m=SIDES)
    return tmp_path / "table"


def sides(index: Index) -> dict[str, float | None]:
    [hits] = index.search(clustered(1, 8, 1), 10)
    return {hit.key: hit.side_m for hit in hits}


def test_hits_know_the_side_of_their_ground(table: Path, tmp_path: Path) -> None:
    found = sides(build(str(table), tmp_path / "index"))
    assert found == {f"gallery-0-{n}": side for n, side in enumerate(SIDES)}


def test_table_and_index_of_before_levels_are_read(table: Path, tmp_path: Path) -> None:
    [part] = table.glob("*.parquet")
    rows = parquet.read_table(str(part))
    parquet.write_table(str(part), rows.drop_columns(["side_m"]), compression="none")
    assert set(sides(build(str(table), tmp_path / "new")).values()) == {None}
    ids = tmp_path / "new" / "ids.arrow"
    with pa.ipc.open_file(ids.read_bytes()) as reader:
        old = reader.read_all().drop_columns(["side_m"])
    with pa.ipc.new_file(str(ids), old.schema) as writer:
        writer.write_table(old)
    found = RowIds(str(ids))
    assert found.take(np.array([3, 1])).to_pylist()[0] | {"lat": 0} == {
        "key": "gallery-0-3", "location": "00003", "view": "satellite", "lat": 0, "lon": 0.0,
        "side_m": None,
    }  # fmt: skip
