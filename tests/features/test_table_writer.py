"""The books of a feature table that is being filled: expected, done and skipped parts."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.core.errors import InputError
from pipeline.core.records import Rejection
from pipeline.features.encoding import EncodingConfig
from pipeline.features.expected_parts import EXPECTED_PARTS, add_expected, check_expected
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
    writer.skip(NAMES[1], "unusable", "cut off")
    written = writer.finish()
    assert (written.rejected, written.list_changed) == ((REJECTION,), True)
    assert open_table(str(tmp_path)).rows == 2
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]
    listed = [(row["shard"], row["key"]) for row in read_rejected(str(tmp_path)).to_pylist()]
    assert listed == [("query-drone-000000", REJECTION.path), ("query-drone-000001", None)]
    assert not writer.finish().list_changed


def test_expected_parts_damaged_list_is_replaced(tmp_path: Path) -> None:
    add_expected(str(tmp_path), NAMES)
    (tmp_path / EXPECTED_PARTS).write_bytes(b'{"parts": [')
    with pytest.raises(InputError, match=r"_parts\.json is damaged.*embed_gallery command"):
        check_expected(str(tmp_path), NAMES)
    add_expected(str(tmp_path), NAMES)
    check_expected(str(tmp_path), NAMES)


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
