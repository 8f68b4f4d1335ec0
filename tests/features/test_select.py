"""Selections of a feature table: by split, view, location and rectangle, and in blocks."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.core.errors import InputError
from pipeline.core.geo import Box
from pipeline.core.records import Split, View
from pipeline.features.part import PartFooter, PartRows, write_part
from pipeline.features.table import FeatureTable, open_table

FOOTER = PartFooter(fingerprint="f" * 64, shard_sha256="s" * 64, rows=5)


def table_of_places(folder: Path, dtype: str = "float32") -> np.ndarray:
    """Two parts of five rows each; positions on both sides of 180 degrees, the last unknown."""
    vectors = np.random.default_rng(7).normal(size=(10, 8)).astype(np.float32)
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    lons: list[float | None] = [179.0, -179.0, 180.0, -180.0, None]
    for number, view in enumerate(("drone", "satellite")):
        rows = PartRows(
            keys=[f"{view}-{n}" for n in range(5)],
            locations=list("abcde"),
            views=[view] * 5,
            splits=["gallery"] * 5,
            lats=[10.0, 20.0, 30.0, -40.0, None],
            lons=lons,
            embeddings_BD=vectors[5 * number : 5 * number + 5],
        )
        write_part(str(folder / f"gallery-{view}-000000.parquet"), rows, FOOTER, dtype)
    return vectors


def keys_of(table: FeatureTable) -> list[str]:
    assert table.rows == len(table.labels().keys) == len(table.embeddings())
    found: list[str] = table.labels().keys.tolist()
    return found


def test_select_by_location_and_box(tmp_path: Path) -> None:
    vectors = table_of_places(tmp_path)
    table = open_table(str(tmp_path))
    assert keys_of(table.select(locations="b")) == ["drone-1", "satellite-1"]
    assert keys_of(table.select(view=View.DRONE, locations=["a", "e", "nowhere"])) == [
        "drone-0",
        "drone-4",
    ]
    assert keys_of(table.select(locations=[])) == []
    across = Box(south=0, north=90, west=178, east=-178)
    assert keys_of(table.select(view=View.DRONE, box=across)) == ["drone-0", "drone-1", "drone-2"]
    assert keys_of(table.select(box=across).select(view=View.DRONE).select(locations="b")) == [
        "drone-1"
    ]
    # 180 degrees east and 180 degrees west are one meridian.
    assert keys_of(
        table.select(view=View.DRONE, box=Box(south=-90, north=90, west=179.5, east=180))
    ) == [
        "drone-2",
        "drone-3",
    ]
    assert keys_of(table.select(box=Box(south=-90, north=90, west=0, east=10))) == []
    chosen = table.select(view=View.SATELLITE, box=across).embeddings()
    assert np.array_equal(chosen, vectors[5:8])
    with pytest.raises(InputError, match="south 5, north 4"):
        Box(south=5, north=4, west=0, east=1)


def test_select_narrows_earlier_selection(tmp_path: Path) -> None:
    table_of_places(tmp_path)
    table = open_table(str(tmp_path)).select(view=View.DRONE)
    assert table.select(view=View.SATELLITE).rows == 0
    assert table.select(Split.GALLERY).rows == 5


@pytest.mark.parametrize("dtype", ["float32", "float16"])
def test_blocks_have_stored_or_requested_dtype(tmp_path: Path, dtype: str) -> None:
    vectors = table_of_places(tmp_path, dtype)
    table = open_table(str(tmp_path))
    assert table.dtype == dtype
    assert {block_BD.dtype for block_BD in table.blocks(dtype="stored")} == {np.dtype(dtype)}
    assert {block_BD.dtype for block_BD in table.blocks(dtype="float16")} == {np.dtype("float16")}
    assert [len(block_BD) for block_BD in table.blocks(rows=3)] == [3, 2, 3, 2]
    assert np.allclose(table.embeddings(), vectors, atol=1e-3)
