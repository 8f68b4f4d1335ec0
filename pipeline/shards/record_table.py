"""The record table of a set of shards: `records/<shard>.parquet`, one row per image, all that is
known of it but its bytes.

In: rows that packing made. Out: Parquet parts, which tell packing what it has done already and
extending what is there; and one table for other programs, as Parquet or GeoJSON.
"""

import json
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from pipeline.core import parquet, storage
from pipeline.core import parquet as parquet_files
from pipeline.core.errors import InputError
from pipeline.core.json_files import from_json
from pipeline.core.records import ImageRecord, Rejection
from pipeline.shards.manifest import Manifest, Shard, repair_hint


def part_intact(out: str, name: str) -> bool:
    """Whether every byte of a record part is what was written."""
    return parquet.parquet_intact(storage.join(out, FOLDER, f"{name}.parquet"))


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
)
FOOTER = b"pvda.packed"


@dataclass(frozen=True, kw_only=True)
class Packed:
    """What became of one planned tar. It stands in the footer of the tar's record part."""

    shard: Shard
    plan: str
    "Digest of the plan."
    rejected: tuple[Rejection, ...]


def row(record: ImageRecord, shard: str, facts: dict[str, Any], size: int) -> dict[str, Any]:
    """One image as the table has it. `facts`: the JSON beside it in the tar."""
    tag = asdict(record.geotag) if record.geotag else {}
    known = {name: facts.get(name, tag.get(name)) for name in SCHEMA.names}
    return known | {"shard": shard, "path": record.path, "part": record.part, "bytes": size}


def write_part(out: str, packed: Packed, rows: list[dict[str, Any]]) -> None:
    footer = {FOOTER: json.dumps(asdict(packed), sort_keys=True)}
    table = pa.Table.from_pylist(rows, SCHEMA.with_metadata(footer))
    parquet_files.write_table(_path(out, packed.shard.name), table)


def read_packed(out: str, name: str) -> Packed | None:
    """What became of a tar; None where its part is missing or cannot be read."""
    try:
        with parquet_files.open_parquet(_path(out, name)) as parquet:
            said = json.loads(parquet.schema_arrow.metadata[FOOTER])
        return from_json(Packed, said)
    except (*parquet_files.DAMAGE_ERRORS, KeyError, TypeError, RecursionError):
        return None


def read_part(out: str, name: str, columns: list[str] | None = None) -> pa.Table:
    """The rows of one shard.

    Raises InputError when they cannot be read.
    """
    path = _path(out, name)
    try:
        return parquet_files.read_table(path, columns)
    except parquet_files.DAMAGE_ERRORS as error:
        raise InputError(
            f"{path} cannot be read ({error}), expected the record table that packing wrote beside the tars; {repair_hint(out)}"
        ) from None


def footprints(
    shards: str, manifest: Manifest, keys: Iterable[str]
) -> dict[str, list[list[float]]]:
    """Corners (lat, lon) of the ground that some images show, from the upper left clockwise; those
    unknown are absent.
    """
    wanted = set(keys)
    found: dict[str, list[list[float]]] = {}
    for shard in manifest.shards:
        if any(key.startswith(f"{shard.split}-{shard.view}-") for key in wanted):
            table = read_part(shards, shard.name, ["key", "footprint"])
            known = table.filter(
                pc.and_(pc.is_in(table["key"], pa.array(wanted)), pc.is_valid(table["footprint"]))
            )
            found |= dict(
                zip(known["key"].to_pylist(), known["footprint"].to_pylist(), strict=True)
            )
    return found


def export(shards: str, manifest: Manifest, file: str) -> tuple[int, int]:
    """All records as one file: `.parquet`, or `.geojson` with a point for each image whose place is
    known.

    Returns how many were written and how many have no place and are left out. Raises InputError for
    another ending.
    """
    if file.lower().endswith(".parquet"):
        written = 0
        with parquet_files.writer(file, SCHEMA) as columns:
            for shard in manifest.shards:
                table = read_part(shards, shard.name).cast(SCHEMA)
                columns.write_table(table)
                written += len(table)
        return written, 0
    if not file.lower().endswith((".geojson", ".json")):
        raise InputError(f"--export is {file}, expected a name that ends in .parquet or .geojson")
    written = without = 0
    with storage.atomic_write(file) as stream:
        stream.write(b'{"type": "FeatureCollection", "features": [')
        for shard in manifest.shards:
            for feature in _features(read_part(shards, shard.name)):
                if feature is None:
                    without += 1
                    continue
                stream.write(b",\n" if written else b"\n")
                stream.write(json.dumps(feature, ensure_ascii=False).encode())
                written += 1
        stream.write(b"\n]}\n")
    return written, without


def _features(table: pa.Table) -> Iterator[dict[str, Any] | None]:
    for known in table.to_pylist():
        lat, lon, footprint = (known.pop(name) for name in ("lat", "lon", "footprint"))
        if lat is None:
            yield None
            continue
        if (
            footprint
        ):  # RFC 7946: longitude first, the ring closed and counter-clockwise seen from above
            known["footprint"] = [[corner[1], corner[0]] for corner in footprint]
        point = {"type": "Point", "coordinates": [lon, lat]}
        yield {"type": "Feature", "id": known["key"], "geometry": point, "properties": known}


def _path(out: str, name: str) -> str:
    return storage.join(out, FOLDER, f"{name}.parquet")
