"""Damage to any file that we write is found: a sentence that names the file and what mends it, or
the content is what it was.

Seeded: flipped bits, blocks of zeros, files cut off, files gone. Never a traceback, never other
content without a word.
"""

import re
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from pipeline.core import json_files, rejections, storage
from pipeline.core.errors import InputError
from pipeline.core.geo import Box
from pipeline.core.integrity import FileChecksum
from pipeline.core.records import Rejection, Split, View
from pipeline.features.part import PartFooter, PartRows, read_header, verify_part, write_part
from pipeline.features.rejected import read_rejected, write_rejected
from pipeline.features.row_reader import RowReader
from pipeline.features.table import open_table
from pipeline.index.metadata import (
    METADATA_FILE,
    IndexMetadata,
    PartMetadata,
    SearchParams,
    read_metadata,
    write_metadata,
)
from pipeline.locate.calibration import Calibration, read_calibration, write_calibration
from pipeline.locate.logistic import LogisticModel
from pipeline.locate.reliability import ReliabilityBin
from pipeline.retrieval.results import (
    INPUTS_FILE,
    METRICS_FILE,
    VIEWS_FILE,
    read_inputs,
    read_result_rows,
    write_inputs,
)
from pipeline.shards import record_table
from pipeline.shards.manifest import MANIFEST, Manifest, Shard, read_manifest
from pipeline.shards.record_table import Packed
from tests.damaging import (
    REMEDIES,
    count_detected,
    damaged_versions,
    error_message,
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


def test_part_damaged_is_rejected_by_every_reader(part: Path) -> None:
    assert count_detected(part, lambda: look_at_table(part), 400) > 300


def test_footer_checksum_is_compared_before_arrow_reads(part: Path) -> None:
    """Arrow ends the process over some of them, and believes others."""
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


def test_record_part_damaged_does_not_count_as_done(tmp_path: Path) -> None:
    shard = Shard(
        name="train-drone-000000",
        split=Split.TRAIN,
        view=View.DRONE,
        samples=9,
        bytes=3,
        sha256="s" * 64,
    )
    packed = Packed(
        shard=shard,
        plan="p" * 64,
        rejected=(Rejection(path="x.jpg", reason="no image", found="text"),),
    )
    row = {
        "key": "k",
        "location": "a",
        "view": "drone",
        "split": "train",
        "variant": "",
        "shard": shard.name,
        "lat": 1.0,
        "footprint": [[1.0, 2.0]] * 4,
        "source": "table",
        "path": "/x.jpg",
        "part": "",
        "sha256": "h",
        "bytes": 3,
        "width": 2,
        "height": 2,
    }
    record_table.write_part(
        str(tmp_path), packed, [row | {"key": f"k{number}"} for number in range(9)]
    )
    path = tmp_path / record_table.FOLDER / f"{shard.name}.parquet"

    def look() -> Any:
        assert record_table.read_packed(str(tmp_path), shard.name) in (packed, None)
        return record_table.read_part(str(tmp_path), shard.name).to_pylist()

    assert count_detected(path, look, 300) > 200


def test_rejected_list_damaged_is_named(tmp_path: Path) -> None:
    rejections.write_rejections(
        str(tmp_path), [Rejection(path="a", reason="b", found="c")], keep=False
    )
    path = tmp_path / rejections.REJECTED_FILE
    good = path.read_bytes()
    for data in damaged_versions(good, 100):
        if data is None:
            continue
        path.write_bytes(data)
        said = error_message(
            lambda: rejections.write_rejections(
                str(tmp_path), [Rejection(path="d", reason="e", found="f")], keep=True
            )
        )
        if said is None:
            assert len(pq.read_table(path)) == 2
        else:
            assert str(path) in said
            assert REMEDIES.search(said)


def test_expected_parts_damaged_are_rewritten(tmp_path: Path) -> None:
    rows = [("shard", "key", "reason", "found")]
    write_rejected(str(tmp_path), rows)
    path = tmp_path / "_rejected" / "rejected.parquet"

    look = raising_if_missing(path, lambda: read_rejected(str(tmp_path)).to_pylist())
    assert count_detected(path, look, 100) > 80
    for data in damaged_versions(path.read_bytes(), 30, seed=1):
        path.write_bytes(data or b"")
        write_rejected(str(tmp_path), rows)
        assert len(read_rejected(str(tmp_path))) == 1


def test_manifest_damaged_is_rejected(tmp_path: Path) -> None:
    shards = tuple(
        Shard(
            name=f"train-drone-{n:06d}",
            split=Split.TRAIN,
            view=View.DRONE,
            samples=n,
            bytes=n,
            sha256=f"{n:064x}",
        )
        for n in range(5)
    )
    manifest = Manifest(
        shards=shards, classes=("a", "b"), packing={"source": "table", "check": "quick"}, rejected=0
    )
    path = tmp_path / MANIFEST
    json_files.write_checksummed(str(path), asdict(manifest))
    look = raising_if_missing(path, lambda: asdict(read_manifest(str(tmp_path))))
    assert count_detected(path, look, 400) > 300


def test_index_json_damaged_is_rejected(tmp_path: Path) -> None:
    part = PartMetadata(
        faiss="index.faiss",
        ids="ids.arrow",
        first_row=0,
        rows=5,
        table_parts={"gallery-drone-000000.parquet": "s" * 64},
        files={"index.faiss": FileChecksum(bytes=9, sha256="0" * 64)},
    )
    facts = IndexMetadata(
        factory="Flat",
        metric="inner product",
        rows=5,
        dimension=8,
        fingerprint="f" * 64,
        encoding=None,
        table="/t",
        settings={"split": None},
        reason="few rows",
        refine="none",
        on_disk=False,
        search_params=SearchParams(nprobe_or_ef=1),
        target_recall=0.9,
        unit_rows=9,
        part_rows=9,
        training_sample=0,
        build_seconds=0.1,
        bytes_per_vector=8.0,
        expected_bytes=None,
        measured={"recall_at_10": 1.0},
        parts=(part,),
        trained={},
    )
    write_metadata(str(tmp_path), facts)
    path = tmp_path / METADATA_FILE
    assert (
        count_detected(path, raising_if_missing(path, lambda: read_metadata(str(tmp_path))), 400)
        > 300
    )


def test_calibration_damaged_is_rejected(tmp_path: Path) -> None:
    model = LogisticModel(
        mean_F=(0.1, 0.2, 0.3, 0.4),
        scale_F=(1.0,) * 4,
        coefficient_F=(1.5, 2.5, 3.5, 4.5),
        intercept=0.25,
    )
    calibration = Calibration(
        fingerprint="f" * 64,
        gallery_rows=5,
        photo_selection="places held out",
        spacing_m=10.0,
        agreement_radius_m=5.0,
        tolerance_m=3.0,
        outside=0.5,
        model=model,
        threshold=0.5,
        inverse_temperature=9.0,
        none_log_odds=0.1,
        photos=3,
        locations=2,
        accuracy=0.7,
        right_kept=0.6,
        outside_unknown=0.8,
        calibration_error=0.02,
        bins=(ReliabilityBin(predicted=0.5, observed=0.4, share=1.0),),
    )
    path = tmp_path / "calibration.json"
    write_calibration(str(path), calibration)
    look = raising_if_missing(path, lambda: read_calibration(str(path), "f" * 64))
    assert count_detected(path, look, 400) > 300


def test_evaluation_damaged_is_rejected(tmp_path: Path) -> None:
    metrics = [
        {
            "task": "drone->satellite",
            "protocol": "full",
            "multi_query": False,
            "r1": 0.25,
            "ap": 0.5,
        }
    ]
    storage.write_json(str(tmp_path / VIEWS_FILE), [{"views": 3, "r1": 0.5}])
    write_inputs(
        str(tmp_path), {"ranked": {"queries": "q" * 64}, "shown": {}}, storage.encode_json(metrics)
    )
    storage.write_json(str(tmp_path / METRICS_FILE), metrics)
    for name, listed in ((METRICS_FILE, METRICS_FILE), (VIEWS_FILE, VIEWS_FILE)):
        read = partial(read_result_rows, str(tmp_path), listed)
        assert count_detected(tmp_path / name, read, 200) == 201
    path = tmp_path / INPUTS_FILE
    assert (
        count_detected(path, raising_if_missing(path, lambda: read_inputs(str(tmp_path))), 200)
        > 150
    )
