"""The books of a feature table that is being filled: expected, done and skipped parts."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from pipeline.core.errors import InputError
from pipeline.core.json_files import write_checksummed
from pipeline.core.records import Rejection
from pipeline.features.encoding import EncodingConfig
from pipeline.features.expected_parts import (
    OLD_PARTS_NAME,
    add_expected,
    check_expected,
    expected_parts_file,
)
from pipeline.features.part import SCHEMA_VERSION, PartFooter, PartRows, read_footer, write_part
from pipeline.features.rejected import read_rejected
from pipeline.features.table import open_table
from pipeline.features.table_writer import ExpectedPart, FeatureTableWriter

NAMES = ("query-drone-000000.parquet", "query-drone-000001.parquet")
EXPECTED = [ExpectedPart(name=name, shard_sha256=f"of {name}", images=3) for name in NAMES]
REJECTION = Rejection(path="query-drone-k", reason="damaged image", found="9 bytes")


def write(
    folder: Path, name: str, rows: int = 3, dtype: str = "float32", **changes: object
) -> None:
    footer = {"fingerprint": "f" * 64, "shard_sha256": f"of {name}", "rows": rows} | changes
    part = PartRows(
        keys=[f"{name}-{n}" for n in range(rows)],
        locations=["a"] * rows,
        views=["drone"] * rows,
        splits=["query"] * rows,
        lats=[None] * rows,
        lons=[None] * rows,
        embeddings_BD=np.eye(rows, 4, dtype=np.float32),
    )
    write_part(str(folder / name), part, PartFooter(**footer), dtype)  # type: ignore[arg-type]


def writer_of(folder: Path) -> FeatureTableWriter:
    return FeatureTableWriter(str(folder), "f" * 64, "float32")


def test_expect_returns_missing_and_outdated_parts(tmp_path: Path) -> None:
    assert writer_of(tmp_path).expect(EXPECTED) == [*NAMES]
    write(tmp_path, NAMES[0])
    assert writer_of(tmp_path).expect(EXPECTED) == [NAMES[1]]
    write(tmp_path, NAMES[1], shard_sha256="another shard")
    assert writer_of(tmp_path).expect(EXPECTED) == [NAMES[1]]
    write(tmp_path, NAMES[1], rows=2)  # an image has neither a row nor a rejection
    assert writer_of(tmp_path).expect(EXPECTED) == [NAMES[1]]
    write(tmp_path, NAMES[1], rows=2, rejected=(REJECTION,))
    assert writer_of(tmp_path).expect(EXPECTED) == []


def test_expect_makes_table_incomplete_until_written(tmp_path: Path) -> None:
    writer_of(tmp_path).expect(EXPECTED)
    write(tmp_path, NAMES[0])
    with pytest.raises(InputError, match=rf"lacks 1 of the 2 parts .*, {NAMES[1]} first"):
        open_table(str(tmp_path))
    write(tmp_path, NAMES[1])
    assert open_table(str(tmp_path)).rows == 6


def test_expect_rejects_parts_of_another_encoder_or_dtype(tmp_path: Path) -> None:
    write(tmp_path, NAMES[0], fingerprint="g" * 64)
    with pytest.raises(InputError, match=r"was made by network g+, this checkpoint is f+"):
        writer_of(tmp_path).expect(EXPECTED)
    write(tmp_path, NAMES[0], dtype="float16")
    with pytest.raises(InputError, match=r"holds float16, --dtype is float32"):
        writer_of(tmp_path).expect(EXPECTED)


def test_finish_drops_skipped_parts_and_leftovers(tmp_path: Path) -> None:
    writer = writer_of(tmp_path)
    writer.expect(EXPECTED)
    write(tmp_path, NAMES[0], rows=2, rejected=(REJECTION,))
    (tmp_path / f".{NAMES[1]}.0123abcd").write_bytes(b"half")
    leftover = tmp_path.with_name(f".{tmp_path.name}.parts.json.0123abcd")
    leftover.write_bytes(b"half")
    writer.skip(NAMES[1], "unusable", "cut off")
    written = writer.finish()
    assert (written.rejected, written.list_changed) == ((REJECTION,), True)
    assert open_table(str(tmp_path)).rows == 2
    assert [path.name for path in tmp_path.iterdir()] == [NAMES[0]]
    assert not leftover.exists()
    listed = [(row["shard"], row["key"]) for row in read_rejected(str(tmp_path)).to_pylist()]
    assert listed == [("query-drone-000000", REJECTION.path), ("query-drone-000001", None)]
    assert not writer.finish().list_changed


def test_expected_parts_damaged_list_is_replaced(tmp_path: Path) -> None:
    add_expected(str(tmp_path), NAMES)
    Path(expected_parts_file(str(tmp_path))).write_bytes(b'{"parts": [')
    with pytest.raises(InputError, match=r"\.parts\.json is damaged.*embed_gallery command"):
        check_expected(str(tmp_path), NAMES)
    add_expected(str(tmp_path), NAMES)
    check_expected(str(tmp_path), NAMES)


def test_expected_parts_within_an_older_table_are_moved(tmp_path: Path) -> None:
    table = tmp_path / "table"
    write(table, NAMES[0])
    write_checksummed(str(table / OLD_PARTS_NAME), {"parts": [*NAMES]})
    (table / "_rejected").mkdir()
    (table / "_rejected" / "rejected.parquet").write_bytes(b"an older list")
    with pytest.raises(InputError, match=r"lacks 1 of the 2 parts .* delete .*table/_parts\.json"):
        open_table(str(table))
    writer_of(table).expect(EXPECTED[:1])
    with pytest.raises(InputError, match=r"lacks 1 of the 2 parts .* delete .*table\.parts\.json"):
        open_table(str(table))
    write(table, NAMES[1])
    writer_of(table).finish()
    assert sorted(path.name for path in table.iterdir()) == [*NAMES]
    assert open_table(str(table)).rows == 6


def test_expected_parts_of_a_deleted_table_are_forgotten(tmp_path: Path) -> None:
    table = tmp_path / "table"
    writer_of(table).expect(EXPECTED)
    writer_of(table).expect(EXPECTED[:1])  # killed before its first part, run with other flags
    write(table, NAMES[0])
    with pytest.raises(InputError, match="lacks 1 of the 2 parts"):
        open_table(str(table))
    shutil.rmtree(table)
    writer_of(table).expect(EXPECTED[:1])
    write(table, NAMES[0])
    assert open_table(str(table)).rows == 3


@pytest.mark.parametrize(
    "encoding",
    [
        None,
        EncodingConfig(mirror=True, resizer="pillow", precision="int8", calibration="c" * 64),
    ],
)
def test_footer_round_trip_of_the_encoding(tmp_path: Path, encoding: EncodingConfig | None) -> None:
    write(tmp_path, NAMES[0], encoding=encoding)
    assert read_footer(str(tmp_path / NAMES[0])).encoding == encoding
    assert open_table(str(tmp_path)).encoding == encoding


def test_part_of_an_older_schema_names_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipeline.features.part.SCHEMA_VERSION", "1")
    write(tmp_path, NAMES[0])
    monkeypatch.undo()
    sentence = rf"schema version '1', expected {SCHEMA_VERSION}; run jobs/embed_gallery\.py again"
    with pytest.raises(InputError, match=sentence):
        open_table(str(tmp_path))
    assert writer_of(tmp_path).expect(EXPECTED) == [*NAMES], "embedding makes it anew"
