"""Damage to any file that we write is found: a sentence that names the file and what mends it, or the content is what it was.

Seeded: flipped bits, blocks of zeros, files cut off, files gone. Never a traceback, never other content without a word.
"""

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from pipeline import rejects, shard_records
from pipeline.feature_parts import (
    PartFooter,
    PartRows,
    list_rejected,
    read_header,
    read_rejected,
    verify_part,
    write_part,
)
from pipeline.feature_rows import RowReader
from pipeline.features import Box, open_table
from pipeline.records import InputError, Rejection, Split, View
from pipeline.shard_records import Packed
from pipeline.shards import Shard

ROWS, DIMENSION = 40, 16
MENDS = re.compile(r"jobs/\w+\.py|embed its shard again|run the same command again|calibrate again|taking checkpoint")


def damages(good: bytes, count: int, seed: int = 0) -> Iterator[bytes | None]:
    """The file with as many damages, one at a time; None: it is gone."""
    rng = np.random.default_rng(seed)
    yield None
    for number in range(count):
        data, place = bytearray(good), int(rng.integers(len(good)))
        if number % 10 == 8:
            data[place : place + int(rng.integers(1, 65))] = b""
        elif number % 10 == 9:
            data = data[:place]
        else:
            for _ in range((1, 1, 1, 1, 1, 2, 4, 16)[number % 10]):
                data[place] ^= 1 << int(rng.integers(8))
                place = int(rng.integers(len(good))) if rng.random() < 0.5 else min(place + 1, len(good) - 1)
        yield bytes(data)


def sentence_of(work: Callable[[], Any], errors: type[Exception] = InputError) -> str | None:
    """What it is refused with, None where it is not."""
    try:
        work()
    except errors as error:
        return str(error)
    return None


def unchanged(found: Any, expected: Any) -> None:
    assert found == expected, "other content, and not a word"


def found_or_equal(path: Path, look: Callable[[], Any], count: int, errors: type[Exception] = InputError) -> int:
    """Damage the file in so many ways; returns how many were refused, each naming it and what mends it."""
    good, expected, refused = path.read_bytes(), look(), 0
    for data in damages(good, count):
        path.unlink(missing_ok=True)
        if data is not None:
            path.write_bytes(data)
        said = sentence_of(lambda: unchanged(look(), expected), errors)
        if said is not None:
            assert str(path) in said
            assert MENDS.search(said), said
            refused += 1
    path.write_bytes(good)
    assert look() == expected
    return refused


@pytest.fixture
def part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A feature table of one part, in three row groups."""
    monkeypatch.setattr("pipeline.feature_parts.ROW_GROUP", 16)
    vectors = np.random.default_rng(0).normal(size=(ROWS, DIMENSION)).astype(np.float32)
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    places = [None if number % 5 == 0 else 40 + number / 7 for number in range(ROWS)]
    rows = PartRows(
        keys=[f"k{number}" for number in range(ROWS)], locations=[f"place{number // 4}" for number in range(ROWS)],
        views=["drone"] * 20 + ["satellite"] * 20, splits=["gallery"] * ROWS, lats=places, lons=places, embeddings_BD=vectors,
    )  # fmt: skip
    path = tmp_path / "table" / "gallery-drone-000000.parquet"
    write_part(str(path), rows, PartFooter(fingerprint="f" * 64, shard_sha256="s" * 64, rows=ROWS))
    return path


def look_at_table(part: Path) -> list[Any]:
    """All that others are told of a table, by every way of reading it."""
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
        seen += [rows.rows, labels.keys.tolist(), labels.locations.tolist(), np.nan_to_num(labels.lats).tolist()]
        seen += [np.nan_to_num(labels.lons).tolist(), rows.embeddings().tobytes()]
    seen.append([(name, rows.to_pylist()) for name, rows in table.select(Split.GALLERY).numbered(["key"])])
    seen.append(RowReader(str(part.parent), DIMENSION).read(part.name, "s" * 64, np.arange(ROWS)).tobytes())
    return seen


def test_a_damaged_part_of_a_table_is_refused_however_it_is_read(part: Path) -> None:
    assert found_or_equal(part, lambda: look_at_table(part), 400) > 300


def test_each_byte_of_a_footer_is_held_against_the_seal_before_arrow_sees_it(part: Path) -> None:
    """Arrow ends the process over some of them, and believes others."""
    good, rng = part.read_bytes(), np.random.default_rng(0)
    begin = len(good) - 8 - int.from_bytes(good[-8:-4], "little")
    for place in range(begin - len(good), 0):
        data = bytearray(good)
        data[place] ^= 1 << int(rng.integers(8))
        part.write_bytes(data)
        with pytest.raises(InputError, match=re.escape(f"{part} is not a readable Parquet file")):
            read_header(str(part))


def test_every_byte_of_a_part_is_looked_at_when_asked(part: Path) -> None:
    def look() -> None:
        if not part.exists():
            raise InputError(f"{part} is gone; run jobs/embed_gallery.py again")
        verify_part(str(part))

    assert found_or_equal(part, look, 200) == 201


def test_parts_without_seals_and_checksums_are_read_as_they_are(part: Path) -> None:
    expected, whole = look_at_table(part), pq.read_table(part)
    for dictionary in (False, ["key", "view"]):
        pq.write_table(whole, part, row_group_size=16, compression="none", use_dictionary=dictionary)
        assert look_at_table(part) == expected
        verify_part(str(part))


def test_a_damaged_record_part_is_refused_and_not_taken_for_done(tmp_path: Path) -> None:
    shard = Shard(name="train-drone-000000", split=Split.TRAIN, view=View.DRONE, samples=9, bytes=3, sha256="s" * 64)
    packed = Packed(shard=shard, plan="p" * 64, rejected=(Rejection(path="x.jpg", reason="no image", found="text"),))
    row = {
        "key": "k", "location": "a", "view": "drone", "split": "train", "variant": "", "shard": shard.name, "lat": 1.0,
        "footprint": [[1.0, 2.0]] * 4, "source": "table", "path": "/x.jpg", "part": "", "sha256": "h", "bytes": 3,
        "width": 2, "height": 2,
    }  # fmt: skip
    shard_records.write_part(str(tmp_path), packed, [row | {"key": f"k{number}"} for number in range(9)])
    path = tmp_path / shard_records.FOLDER / f"{shard.name}.parquet"

    def look() -> Any:
        assert shard_records.read_packed(str(tmp_path), shard.name) in (packed, None)
        return shard_records.read_part(str(tmp_path), shard.name).to_pylist()

    assert found_or_equal(path, look, 300) > 200


def test_a_damaged_list_of_what_was_refused_is_named(tmp_path: Path) -> None:
    rejects.write(str(tmp_path), [Rejection(path="a", reason="b", found="c")], keep=False)
    path = tmp_path / rejects.FILE
    good = path.read_bytes()
    for data in damages(good, 100):
        if data is None:
            continue
        path.write_bytes(data)
        said = sentence_of(
            lambda: rejects.write(str(tmp_path), [Rejection(path="d", reason="e", found="f")], keep=True)
        )
        if said is None:
            assert len(pq.read_table(path)) == 2
        else:
            assert str(path) in said
            assert MENDS.search(said)


def test_a_damaged_list_of_a_table_is_named_and_written_again(tmp_path: Path) -> None:
    rows = [("shard", "key", "reason", "found")]
    list_rejected(str(tmp_path), rows)
    path = tmp_path / "_rejected" / "rejected.parquet"

    def look() -> Any:
        if not path.exists():
            raise InputError(f"{path} is gone; run jobs/embed_gallery.py again")
        return read_rejected(str(tmp_path)).to_pylist()

    assert found_or_equal(path, look, 100) > 80
    for data in damages(path.read_bytes(), 30, seed=1):
        path.write_bytes(data or b"")
        list_rejected(str(tmp_path), rows)
        assert len(read_rejected(str(tmp_path))) == 1
