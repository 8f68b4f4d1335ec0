"""One part of a feature table: its columns, its footer, and how it is written and known again.

In: unit vectors with their keys, locations, views, splits and positions. Out: atomic Parquet files
whose footers say what made them, and the list of the images that have no row. Shapes: B rows of a
part, D dimensions of an embedding.
"""

import json
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.core import parquet as parquet_files
from pipeline.core import rejections, storage
from pipeline.core.arrays import Floats, Halves
from pipeline.core.errors import InputError
from pipeline.core.prefetch import prefetch_map
from pipeline.core.records import Rejection, Split, View, excerpt

SCHEMA_VERSION = "1"
REJECTED = f"_rejected/{rejections.REJECTED_FILE}"
"""Within a table. In a folder of its own, so that `*.parquet` names parts only, and one whose
underscore keeps it from readers that look into folders: pandas, pyarrow and Spark."""
REJECTED_SCHEMA = pa.schema([(name, pa.string()) for name in ("shard", "key", "reason", "found")])
ROW_GROUP = 16_384
"Rows: few enough that a reader's memory does not grow with a part of millions."
PAGE_BYTES = 1 << 18
"""Of a data page: whoever reads a single row holds the checksum of its whole page against it, 65
us; smaller pages would take longer to find when a part is opened."""
READERS = 8
"Footers read at once: on an object store each is a request of some 50 ms."


@dataclass(frozen=True, kw_only=True)
class PartFooter:
    """What a part says of itself."""

    fingerprint: str
    "Hash of the model's weights, its config and the preprocessing."
    shard_sha256: str
    "Hash of the shard that was embedded."
    rows: int
    rejected: tuple[Rejection, ...] = ()
    "Images of the shard that could not be decoded; they have no row."

    def metadata(self) -> dict[bytes, bytes]:
        rejected = json.dumps([[r.path, r.reason, r.found] for r in self.rejected])
        said = {
            "schema_version": SCHEMA_VERSION,
            "fingerprint": self.fingerprint,
            "shard_sha256": self.shard_sha256,
            "rows": str(self.rows),
            "rejected": rejected,
        }
        return {f"pvda.{name}".encode(): value.encode() for name, value in said.items()}


def part_schema(dimension: int, dtype: str = "float32") -> pa.Schema:
    """Arrow schema of a part. `dtype` is float32 or float16."""
    names = pa.dictionary(pa.int8(), pa.string())
    return pa.schema(
        [
            pa.field("key", pa.string(), nullable=False),
            pa.field("location", pa.string(), nullable=False),
            pa.field("view", names, nullable=False),
            pa.field("split", names, nullable=False),
            pa.field("lat", pa.float64()),
            pa.field("lon", pa.float64()),
            pa.field(
                "embedding",
                pa.list_(pa.field("item", pa.type_for_alias(dtype), nullable=False), dimension),
                False,
            ),
        ]
    )


@dataclass(frozen=True, kw_only=True)
class PartRows:
    """Rows on their way into a part."""

    keys: Sequence[str]
    locations: Sequence[str]
    views: Sequence[str]
    splits: Sequence[str]
    lats: Sequence[float | None]
    lons: Sequence[float | None]
    embeddings_BD: Floats | Halves


def write_part(path: str, rows: PartRows, footer: PartFooter, dtype: str = "float32") -> None:
    """Write one part, whole or not at all."""
    dimension = rows.embeddings_BD.shape[1]
    schema = part_schema(dimension, dtype)
    flat = pa.array(rows.embeddings_BD.astype(dtype, copy=False).ravel())
    columns = [
        pa.array(rows.keys, pa.string()), pa.array(rows.locations, pa.string()),
        pa.array(rows.views, pa.string()).dictionary_encode().cast(schema.field("view").type),
        pa.array(rows.splits, pa.string()).dictionary_encode().cast(schema.field("split").type),
        pa.array(rows.lats, pa.float64()), pa.array(rows.lons, pa.float64()),
        pa.FixedSizeListArray.from_arrays(flat, type=schema.field("embedding").type),
    ]  # fmt: skip
    table = pa.Table.from_arrays(columns, schema=schema.with_metadata(footer.metadata()))
    text = [name for name in schema.names if name != "embedding"]
    # Embeddings do not compress and nobody filters on them: plain bytes are the fastest to read
    # back.
    parquet_files.write_table(
        path, table, ROW_GROUP, compression="none", write_statistics=text, data_page_size=PAGE_BYTES
    )


@dataclass(frozen=True, kw_only=True)
class PartHeader:
    """What is known of a part without reading its rows."""

    name: str
    "File name within the table."
    footer: PartFooter
    dimension: int
    dtype: str
    "Of the stored embeddings: float32 or float16."


@contextmanager
def open_part(path: str) -> Iterator[pq.ParquetFile]:
    """A part to read from, a piece at a time.

    Raises InputError, here or while it is read, when it is no whole Parquet file.
    """
    try:
        with parquet_files.open_parquet(path) as parquet:
            yield parquet
    except parquet_files.DAMAGE_ERRORS as error:
        raise _unreadable(path, error) from None


def verify_part(path: str) -> None:
    """Look at every byte of a part. Raises InputError where one is not what was written."""
    try:
        parquet_files.verify_parquet(path)
    except parquet_files.DAMAGE_ERRORS as error:
        raise _unreadable(path, error) from None


def _unreadable(path: str, error: Exception) -> InputError:
    return InputError(
        f"{path} is not a readable Parquet file ({error}); delete it and embed its shard again"
    )


def validate_rows(found: pa.Table) -> pa.Table:
    """The rows, every value looked at: text that is no UTF-8 would else come to light far from its
    part.

    Raises ArrowInvalid.
    """
    found.validate(full=True)
    return found


def parse_split_and_view(path: str, split: str | None, view: str | None) -> tuple[Split, View]:
    """Split and view of rows. Raises InputError where they are none of ours."""
    if split not in list(Split) or view not in list(View):
        raise InputError(
            f"{path} has rows of split {excerpt(split)} and view {excerpt(view)}; expected splits {', '.join(Split)} and views "
            f"{', '.join(View)}; delete it and embed its shard again"
        )
    return Split(split), View(view)


def read_header(path: str) -> PartHeader:
    """What a part says of itself.

    Raises InputError when the file is not a part of a feature table.
    """
    with open_part(path) as parquet:
        return part_header(parquet, path)


def part_header(parquet: pq.ParquetFile, path: str) -> PartHeader:
    """`read_header` of an open part."""
    schema, rows = parquet.schema_arrow, parquet.metadata.num_rows
    said = schema.metadata or {}
    try:
        version, stated = said[b"pvda.schema_version"].decode(), int(said[b"pvda.rows"])
        fingerprint, shard = said[b"pvda.fingerprint"].decode(), said[b"pvda.shard_sha256"].decode()
        rejected = tuple(
            Rejection(path=p, reason=r, found=f) for p, r, f in json.loads(said[b"pvda.rejected"])
        )
        embedding = schema.field("embedding").type
        plain = pa.types.is_fixed_size_list(embedding) and pa.types.is_floating(
            embedding.value_type
        )
    except KeyError as name:
        raise InputError(
            f"{path} has no {name} in its footer; expected a part written by embed_gallery"
        ) from None
    except (ValueError, TypeError, RecursionError) as error:
        raise InputError(
            f"{path} has a damaged footer ({error}); delete it and embed its shard again"
        ) from None
    columns = {field.name: field.type for field in part_schema(1)}
    strange = [name for name in columns if name not in schema.names] or [
        name
        for name in ("key", "location", "lat", "lon")
        if schema.field(name).type != columns[name]
    ]
    if strange:
        raise InputError(
            f"{path} has no column {strange[0]} as embed_gallery writes it; delete it and embed its shard again"
        )
    if not plain or not embedding.list_size:
        raise InputError(
            f"{path} has embeddings of {embedding}; expected lists of one length of floats; embed its shard again"
        )
    if version != SCHEMA_VERSION or stated != rows:
        raise InputError(
            f"{path} says version {version} and {stated} rows and holds {rows}; expected version {SCHEMA_VERSION} and "
            "equal counts; delete it and embed its shard again"
        )
    footer = PartFooter(fingerprint=fingerprint, shard_sha256=shard, rows=rows, rejected=rejected)
    dtype = (
        "float16"
        if pa.types.is_float16(embedding.value_type)
        else str(np.dtype(embedding.value_type.to_pandas_dtype()))
    )
    return PartHeader(
        name=path.rsplit("/", 1)[-1], footer=footer, dimension=embedding.list_size, dtype=dtype
    )


def read_footer(path: str) -> PartFooter:
    """`read_header`'s footer."""
    return read_header(path).footer


def part_names(path: str) -> list[str]:
    """The file names of a table's parts, in its order."""
    return [name for name in storage.list_names(path) if name.endswith(".parquet")]


def read_headers(path: str) -> list[PartHeader]:
    """Every part's header, in the table's order; a folder that is not there has none."""
    return list(
        prefetch_map(
            lambda name: read_header(storage.join(path, name)),
            part_names(path),
            READERS,
            4 * READERS,
        )
    )


def check_consistent_parts(path: str, headers: Sequence[PartHeader]) -> None:
    """Raise InputError where parts cannot stand in one table: of different networks, or of
    different numbers.
    """
    fingerprints = sorted({header.footer.fingerprint for header in headers})
    if len(fingerprints) > 1:
        other = next(
            one for one in headers if one.footer.fingerprint != headers[0].footer.fingerprint
        )
        raise InputError(
            f"{path} holds features of {len(fingerprints)} networks ({', '.join(f[:12] for f in fingerprints)}; {other.name} "
            f"is not of {headers[0].name}'s), expected one; embed into an empty folder with jobs/embed_gallery.py --out"
        )
    first = headers[0]
    for one in headers:
        if (one.dimension, one.dtype) != (first.dimension, first.dtype):
            raise InputError(
                f"{storage.join(path, one.name)} holds {one.dtype} of {one.dimension} dimensions and {first.name} "
                f"{first.dtype} of {first.dimension}, expected the same in all parts; delete it and embed its shard again"
            )


def write_rejected(table: str, rejected: Iterable[tuple[str, str | None, str, str]]) -> bool:
    """Write what has no row, as (shard, key, reason, found), in that order; the key is None where
    it is the whole shard.

    The file is there only while there is something in it, and is left alone where it says so
    already; returns whether it was changed.
    """
    rows = sorted(rejected, key=lambda row: (row[0], row[1] or ""))
    path = storage.join(table, REJECTED)
    wanted = pa.Table.from_pylist(
        [dict(zip(REJECTED_SCHEMA.names, row, strict=True)) for row in rows], REJECTED_SCHEMA
    )
    there = storage.exists(path)
    if not rows:
        if there:
            storage.remove(path)
        return there
    try:
        if there and read_rejected(table).equals(wanted):
            return False
    except InputError:  # it is written again
        pass
    parquet_files.write_table(path, wanted)
    return True


def read_rejected(table: str) -> pa.Table:
    """What of the shards has no row in the table: `shard, key, reason, found`; no rows where there
    is no such list.

    Raises InputError when it cannot be read.
    """
    path = storage.join(table, REJECTED)
    if not storage.exists(path):
        return REJECTED_SCHEMA.empty_table()
    try:
        return parquet_files.read_table(path)
    except parquet_files.DAMAGE_ERRORS as error:
        raise InputError(
            f"{path} cannot be read ({error}), expected the list that embedding writes; run jobs/embed_gallery.py again as it "
            "was run before, which writes it from the parts"
        ) from None
