"""One part of a feature table: its columns, its footer, and how it is written and read.

In: unit vectors with their keys, locations, views, splits and positions. Out: Parquet files that
appear complete or not at all, whose footers say what made them.
Shapes: B rows of a part, D dimensions of an embedding.
"""

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.core import parquet as parquet_files
from pipeline.core import storage
from pipeline.core.arrays import Floats, Halves, Mask
from pipeline.core.errors import InputError
from pipeline.core.prefetch import prefetch_map
from pipeline.core.records import Rejection, Split, View, excerpt
from pipeline.features.encoding import EncodingConfig, encode_config, parse_config

SCHEMA_VERSION = "2"
ROW_GROUP = 16_384
"Rows: few enough that a reader's memory does not grow with a part of millions."
PAGE_BYTES = 1 << 18
"""Of a data page. Reading a single row computes the checksum of its page, 65 us; with smaller pages
it would take longer to find them when a part is opened."""
READERS = 8
"Footers read at once: on an object store each is a request of some 50 ms."
UNIT_LENGTH_TOLERANCE = 0.01
"Of an embedding's length: float16 and rounding stay within it."
REPAIR_HINT = "delete it and embed its shard again"


@dataclass(frozen=True, kw_only=True)
class PartFooter:
    """The metadata in a part's Parquet footer."""

    fingerprint: str
    "Hash of the model's weights, its config and the encoding."
    shard_sha256: str
    "Hash of the shard that was embedded."
    rows: int
    rejected: tuple[Rejection, ...] = ()
    "Images of the shard that could not be decoded; they have no row."
    encoding: EncodingConfig | None = None
    "None for features that another program made."

    def metadata(self) -> dict[bytes, bytes]:
        """Parquet's key-value metadata."""
        entries = {
            "schema_version": SCHEMA_VERSION,
            "fingerprint": self.fingerprint,
            "shard_sha256": self.shard_sha256,
            "rows": str(self.rows),
            "rejected": json.dumps([[one.path, one.reason, one.found] for one in self.rejected]),
            "encoding": encode_config(self.encoding),
        }
        return {f"pvda.{name}".encode(): value.encode() for name, value in entries.items()}


@dataclass(frozen=True, kw_only=True)
class PartRows:
    """Rows to be written into a part."""

    keys: Sequence[str]
    locations: Sequence[str]
    views: Sequence[str]
    splits: Sequence[str]
    lats: Sequence[float | None]
    lons: Sequence[float | None]
    sides_m: Sequence[float | None] | None = None
    "Sides of the ground shown, metres; None: no row's is known."
    embeddings_BD: Floats | Halves


@dataclass(frozen=True, kw_only=True)
class PartHeader:
    """What a part's footer and schema tell, without reading its rows."""

    name: str
    "File name within the table."
    footer: PartFooter
    dimension: int
    dtype: str
    "Of the stored embeddings: float32 or float16."


def part_schema(dimension: int, dtype: str = "float32") -> pa.Schema:
    """Arrow schema of a part. `dtype` is float32 or float16."""
    names = pa.dictionary(pa.int8(), pa.string())
    number = pa.field("item", pa.type_for_alias(dtype), nullable=False)
    return pa.schema(
        [
            pa.field("key", pa.string(), nullable=False),
            pa.field("location", pa.string(), nullable=False),
            pa.field("view", names, nullable=False),
            pa.field("split", names, nullable=False),
            pa.field("lat", pa.float64()),
            pa.field("lon", pa.float64()),
            pa.field("side_m", pa.float64()),  # not in parts of before there were levels
            pa.field("embedding", pa.list_(number, dimension), nullable=False),
        ]
    )


def write_part(path: str, rows: PartRows, footer: PartFooter, dtype: str = "float32") -> None:
    """Write one part atomically."""
    schema = part_schema(rows.embeddings_BD.shape[1], dtype)
    flat = pa.array(rows.embeddings_BD.astype(dtype, copy=False).ravel())
    views, splits = (
        pa.array(values, pa.string()).dictionary_encode().cast(schema.field("view").type)
        for values in (rows.views, rows.splits)
    )
    columns = [
        pa.array(rows.keys, pa.string()),
        pa.array(rows.locations, pa.string()),
        views,
        splits,
        pa.array(rows.lats, pa.float64()),
        pa.array(rows.lons, pa.float64()),
        pa.array(rows.sides_m or [None] * len(rows.keys), pa.float64()),
        pa.FixedSizeListArray.from_arrays(flat, type=schema.field("embedding").type),
    ]
    table = pa.Table.from_arrays(columns, schema=schema.with_metadata(footer.metadata()))
    # Embeddings do not compress and no query filters on them: plain bytes are the fastest to read.
    parquet_files.write_table(
        path,
        table,
        ROW_GROUP,
        compression="none",
        write_statistics=[name for name in schema.names if name != "embedding"],
        data_page_size=PAGE_BYTES,
    )


@contextmanager
def open_part(path: str) -> Iterator[pq.ParquetFile]:
    """A part opened for reading, a piece at a time.

    Raises InputError, here or while it is read, when it is not an intact Parquet file.
    """
    try:
        with parquet_files.open_parquet(path) as parquet:
            yield parquet
    except parquet_files.DAMAGE_ERRORS as error:
        raise _unreadable(path, error) from None


def verify_part(path: str) -> None:
    """Compare every byte of a part with its checksum. Raises InputError where one differs."""
    try:
        parquet_files.verify_parquet(path)
    except parquet_files.DAMAGE_ERRORS as error:
        raise _unreadable(path, error) from None


def _unreadable(path: str, error: Exception) -> InputError:
    return InputError(f"{path} is not a readable Parquet file ({error}); {REPAIR_HINT}")


def validate_rows(rows: pa.Table) -> pa.Table:
    """The rows, after a check of every value: invalid UTF-8 would otherwise fail far from its part.

    Raises ArrowInvalid.
    """
    rows.validate(full=True)
    return rows


def vector_lengths(vectors_BD: Floats) -> tuple[Floats, Mask]:
    """The vectors' lengths (B,), and which of them are of unit length; a NaN is not."""
    length_B = np.sqrt(np.einsum("bd,bd->b", vectors_BD, vectors_BD))
    return length_B, np.abs(length_B - 1) <= UNIT_LENGTH_TOLERANCE


def parse_split_and_view(path: str, split: str | None, view: str | None) -> tuple[Split, View]:
    """Split and view of rows. Raises InputError where they are none of ours."""
    if split not in list(Split) or view not in list(View):
        raise InputError(
            f"{path} has rows of split {excerpt(split)} and view {excerpt(view)}; expected splits "
            f"{', '.join(Split)} and views {', '.join(View)}; {REPAIR_HINT}"
        )
    return Split(split), View(view)


def read_header(path: str) -> PartHeader:
    """A part's header.

    Raises InputError when the file is not a part of a feature table.
    """
    with open_part(path) as parquet:
        return part_header(parquet, path)


def part_header(parquet: pq.ParquetFile, path: str) -> PartHeader:
    """`read_header` of an open part."""
    schema = parquet.schema_arrow
    footer = _read_footer(schema.metadata or {}, parquet.metadata.num_rows, path)
    expected = {field.name: field.type for field in part_schema(1)}
    wrong = [name for name in expected if name not in (*schema.names, "side_m")] or [
        name
        for name in ("key", "location", "lat", "lon", "side_m")
        if name in schema.names and schema.field(name).type != expected[name]
    ]
    if wrong:
        raise InputError(
            f"{path} has no column {wrong[0]} as embed_gallery writes it; {REPAIR_HINT}"
        )
    embedding = schema.field("embedding").type
    if not (
        pa.types.is_fixed_size_list(embedding)
        and embedding.list_size
        and pa.types.is_floating(embedding.value_type)
    ):
        raise InputError(
            f"{path} has embeddings of {embedding}; expected lists of one length of floats; embed "
            "its shard again"
        )
    dtype = str(np.dtype(embedding.value_type.to_pandas_dtype()))
    name = path.rsplit("/", 1)[-1]
    return PartHeader(name=name, footer=footer, dimension=embedding.list_size, dtype=dtype)


def _read_footer(metadata: dict[bytes, bytes], rows: int, path: str) -> PartFooter:
    """The footer of a part that holds `rows` rows. Raises InputError."""
    try:
        version = metadata[b"pvda.schema_version"].decode()
        if version != SCHEMA_VERSION:
            raise InputError(
                f"{path} has schema version {excerpt(version)}, expected {SCHEMA_VERSION}; run "
                "jobs/embed_gallery.py again as it was run before, which makes the parts anew, or "
                "jobs/import_features.py for imported features"
            )
        footer = PartFooter(
            fingerprint=metadata[b"pvda.fingerprint"].decode(),
            shard_sha256=metadata[b"pvda.shard_sha256"].decode(),
            rows=int(metadata[b"pvda.rows"]),
            rejected=tuple(
                Rejection(path=path, reason=reason, found=found)
                for path, reason, found in json.loads(metadata[b"pvda.rejected"])
            ),
            encoding=parse_config(metadata[b"pvda.encoding"]),
        )
    except KeyError as name:
        raise InputError(
            f"{path} has no {name} in its footer; expected a part written by embed_gallery"
        ) from None
    except (ValueError, TypeError, RecursionError) as error:
        raise InputError(f"{path} has a damaged footer ({error}); {REPAIR_HINT}") from None
    if footer.rows != rows:
        raise InputError(
            f"{path} has {rows} rows and its footer says {footer.rows}, expected the same; "
            f"{REPAIR_HINT}"
        )
    return footer


def read_footer(path: str) -> PartFooter:
    """`read_header`'s footer."""
    return read_header(path).footer


def part_names(path: str) -> list[str]:
    """The file names of a table's parts, in the table's order."""
    return [name for name in storage.list_names(path) if name.endswith(".parquet")]


def read_headers(path: str) -> list[PartHeader]:
    """Every part's header, in the table's order; a folder that does not exist has none."""
    paths = [storage.join(path, name) for name in part_names(path)]
    return list(prefetch_map(read_header, paths, READERS, 4 * READERS))


def check_consistent_parts(path: str, headers: Sequence[PartHeader]) -> None:
    """Raise InputError where parts come from different encoders or have different vectors."""
    first = headers[0]
    fingerprints = sorted({header.footer.fingerprint for header in headers})
    if len(fingerprints) > 1:
        other = next(one for one in headers if one.footer.fingerprint != first.footer.fingerprint)
        raise InputError(
            f"{path} holds features of {len(fingerprints)} networks "
            f"({', '.join(one[:12] for one in fingerprints)}; {other.name} is not of "
            f"{first.name}'s), expected one; embed into an empty folder with "
            "jobs/embed_gallery.py --out"
        )
    for one in headers:
        if (one.dimension, one.dtype) != (first.dimension, first.dtype):
            raise InputError(
                f"{storage.join(path, one.name)} holds {one.dtype} of {one.dimension} dimensions "
                f"and {first.name} {first.dtype} of {first.dimension}, expected the same in all "
                f"parts; {REPAIR_HINT}"
            )
