"""The record table of a set of shards: `records/<shard>.parquet`, one row per image with all that
is known of it but its bytes.

In: rows that packing made. Out: Parquet parts, by which packing resumes, extends and repairs; and
one table for other programs, as Parquet or GeoJSON.
"""

import json
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

import pyarrow as pa

from pipeline.core import parquet, storage
from pipeline.core.errors import InputError
from pipeline.core.json_files import from_json
from pipeline.core.records import ImageRecord, Rejection
from pipeline.shards.manifest import Shard, repair_hint

FOLDER = "records"
SCHEMA = pa.schema(
    [
        pa.field(name, pa.string(), nullable=False)
        for name in ("key", "location", "view", "split", "variant", "shard")
    ]
    + [(name, pa.float64()) for name in ("lat", "lon", "altitude_m", "heading_deg", "pitch_deg")]
    + [("footprint", pa.list_(pa.list_(pa.float64(), 2))), ("taken_at", pa.string())]
    + [pa.field(name, pa.string(), nullable=False) for name in ("source", "path", "part", "sha256")]
    + [pa.field(name, pa.int64(), nullable=False) for name in ("bytes", "width", "height")]
    + [("level", pa.string()), ("roll_deg", pa.float64()), ("focal_35mm", pa.float64())]
)
"A column that may be null is null where an older part lacks it."
FOOTER = b"pvda.packed"


@dataclass(frozen=True, kw_only=True)
class Packed:
    """The result of one planned tar, stored in the footer of the tar's record part."""

    shard: Shard
    plan: str
    "Digest of the plan."
    rejected: tuple[Rejection, ...]


def row(record: ImageRecord, shard: str, metadata: dict[str, Any], size: int) -> dict[str, Any]:
    """One image's row of the table. `metadata`: the JSON beside it in the tar."""
    tag = asdict(record.geotag) if record.geotag else {}
    known = {name: metadata.get(name, tag.get(name)) for name in SCHEMA.names}
    return known | {"shard": shard, "path": record.path, "part": record.part, "bytes": size}


def write_part(out: str, packed: Packed, rows: list[dict[str, Any]]) -> None:
    footer = {FOOTER: json.dumps(asdict(packed), sort_keys=True)}
    table = pa.Table.from_pylist(rows, SCHEMA.with_metadata(footer))
    parquet.write_table(_path(out, packed.shard.name), table)


def has_part(out: str, name: str) -> bool:
    """Whether a shard has its part of the record table."""
    return storage.exists(_path(out, name))


def read_packed(out: str, name: str) -> Packed | None:
    """The result of a tar; None where its part is missing or cannot be read."""
    try:
        with parquet.open_parquet(_path(out, name)) as part:
            footer = json.loads(part.schema_arrow.metadata[FOOTER])
        return from_json(Packed, footer)
    except (*parquet.DAMAGE_ERRORS, KeyError, TypeError, RecursionError):
        return None


def read_part(out: str, name: str, columns: list[str] | None = None) -> pa.Table:
    """The rows of one shard.

    Raises InputError when they cannot be read.
    """
    path = _path(out, name)
    try:
        return parquet.select_or_null(parquet.read_table(path, columns), columns, SCHEMA)
    except parquet.DAMAGE_ERRORS as error:
        raise InputError(
            f"{path} cannot be read ({error}), expected the record table that packing wrote beside "
            f"the tars; {repair_hint(out)}"
        ) from None


def part_intact(out: str, name: str) -> bool:
    """Whether every byte of a record part is the one that was written."""
    return parquet.parquet_intact(_path(out, name))


def export(parts: Iterable[pa.Table], file: str) -> tuple[int, int]:
    """Write all records as one file: `.parquet`, or `.geojson` with a point for each image whose
    position is known.

    Returns how many were written, and how many have no position and were skipped. Raises InputError
    for another ending.
    """
    if file.lower().endswith(".parquet"):
        written = 0
        with parquet.writer(file, SCHEMA) as columns:
            for table in parts:
                columns.write_table(table.cast(SCHEMA))
                written += len(table)
        return written, 0
    if not file.lower().endswith((".geojson", ".json")):
        raise InputError(f"--export is {file}, expected a name that ends in .parquet or .geojson")
    written = skipped = 0
    with storage.atomic_write(file) as stream:
        stream.write(b'{"type": "FeatureCollection", "features": [')
        for table in parts:
            for feature in _features(table):
                if feature is None:
                    skipped += 1
                    continue
                stream.write(b",\n" if written else b"\n")
                stream.write(json.dumps(feature, ensure_ascii=False).encode())
                written += 1
        stream.write(b"\n]}\n")
    return written, skipped


def _features(table: pa.Table) -> Iterator[dict[str, Any] | None]:
    """Each row as a GeoJSON feature; None for a row without a position."""
    for known in table.to_pylist():
        lat, lon, footprint = (known.pop(name) for name in ("lat", "lon", "footprint"))
        if lat is None:
            yield None
            continue
        if footprint:
            # RFC 7946: longitude first, the ring closed and counter-clockwise seen from above.
            known["footprint"] = [[corner[1], corner[0]] for corner in footprint]
        point = {"type": "Point", "coordinates": [lon, lat]}
        yield {"type": "Feature", "id": known["key"], "geometry": point, "properties": known}


def _path(out: str, name: str) -> str:
    return storage.join(out, FOLDER, f"{name}.parquet")
