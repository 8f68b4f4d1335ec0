"""The feature table: a folder of Parquet parts, one per shard, that any Parquet reader opens as it is.

In: unit vectors with their keys, locations, views, splits and positions. Out: atomic parts whose footers say what made
them, and block-wise reading for whoever ranks, indexes or evaluates.
Shapes: B rows of a block, D dimensions of an embedding.
"""

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from pipeline import storage
from pipeline.records import InputError, Rejection, Split, View

SCHEMA_VERSION = "1"
BLOCK_ROWS = 65_536
Floats = npt.NDArray[np.float32]
Words = npt.NDArray[np.str_]


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
        said = {"schema_version": SCHEMA_VERSION, "fingerprint": self.fingerprint, "shard_sha256": self.shard_sha256,
                "rows": str(self.rows), "rejected": rejected}  # fmt: skip
        return {f"pvda.{name}".encode(): value.encode() for name, value in said.items()}


def part_schema(dimension: int, dtype: str = "float32") -> pa.Schema:
    """Arrow schema of a part. `dtype` is float32 or float16."""
    names = pa.dictionary(pa.int8(), pa.string())
    return pa.schema([
        pa.field("key", pa.string(), nullable=False),
        pa.field("location", pa.string(), nullable=False),
        pa.field("view", names, nullable=False),
        pa.field("split", names, nullable=False),
        pa.field("lat", pa.float64()),
        pa.field("lon", pa.float64()),
        pa.field("embedding", pa.list_(pa.field("item", pa.type_for_alias(dtype), nullable=False), dimension), False),
    ])  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class PartRows:
    """Rows on their way into a part."""

    keys: Sequence[str]
    locations: Sequence[str]
    views: Sequence[str]
    splits: Sequence[str]
    lats: Sequence[float | None]
    lons: Sequence[float | None]
    embeddings_BD: Floats


def write_part(path: str, rows: PartRows, footer: PartFooter, dtype: str = "float32") -> None:
    """Write one part, whole or not at all."""
    dimension = rows.embeddings_BD.shape[1]
    schema = part_schema(dimension, dtype)
    flat = pa.array(rows.embeddings_BD.astype(dtype).ravel())
    columns = [
        pa.array(rows.keys, pa.string()), pa.array(rows.locations, pa.string()),
        pa.array(rows.views, pa.string()).dictionary_encode().cast(schema.field("view").type),
        pa.array(rows.splits, pa.string()).dictionary_encode().cast(schema.field("split").type),
        pa.array(rows.lats, pa.float64()), pa.array(rows.lons, pa.float64()),
        pa.FixedSizeListArray.from_arrays(flat, type=schema.field("embedding").type),
    ]  # fmt: skip
    table = pa.Table.from_arrays(columns, schema=schema.with_metadata(footer.metadata()))
    text = [name for name in schema.names if name != "embedding"]
    with storage.atomic(path) as stream:
        # Embeddings do not compress and nobody filters on them: plain bytes are the fastest to read back.
        pq.write_table(table, stream, compression="none", use_dictionary=text, write_statistics=text)


def read_footer(path: str) -> PartFooter:
    """What a part says of itself.

    Raises InputError when the file is not a part of a feature table.
    """
    try:
        with storage.open_read(path) as stream:
            parquet = pq.ParquetFile(stream)
            said = parquet.schema_arrow.metadata or {}
            rows = parquet.metadata.num_rows
    except (pa.ArrowException, OSError) as error:
        raise InputError(
            f"{path} is not a readable Parquet file ({error}); delete it and embed its shard again"
        ) from None
    try:
        version, stated = said[b"pvda.schema_version"].decode(), int(said[b"pvda.rows"])
        fingerprint, shard = said[b"pvda.fingerprint"].decode(), said[b"pvda.shard_sha256"].decode()
        rejected = tuple(Rejection(path=p, reason=r, found=f) for p, r, f in json.loads(said[b"pvda.rejected"]))
    except KeyError as missing:
        raise InputError(f"{path} has no {missing} in its footer; expected a part written by embed_gallery") from None
    if version != SCHEMA_VERSION or stated != rows:
        raise InputError(
            f"{path} says version {version} and {stated} rows and holds {rows}; expected version {SCHEMA_VERSION} and "
            "equal counts; delete it and embed its shard again"
        )
    return PartFooter(fingerprint=fingerprint, shard_sha256=shard, rows=rows, rejected=rejected)


def part_names(path: str) -> list[str]:
    return [name for name in storage.names(path) if name.endswith(".parquet")]


@dataclass(frozen=True, kw_only=True)
class Labels:
    """What is known of each row besides its embedding; equal lengths, in the table's order."""

    keys: Words
    locations: Words
    lats: npt.NDArray[np.float64]
    "NaN where unknown."
    lons: npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class FeatureTable:
    """A feature table, or the rows of one split and view of it. Opened by `open_table`; embeddings are read in blocks."""

    path: str
    fingerprint: str
    dimension: int
    parts: tuple[str, ...]
    footers: tuple[PartFooter, ...]
    counts: dict[tuple[Split, View], int]
    "Rows of each split and view that the whole table holds, whatever is selected."
    split: Split | None = None
    view: View | None = None

    def select(self, split: Split | None = None, view: View | None = None) -> "FeatureTable":
        """The rows of one split or one view (None: any)."""
        return replace(self, split=split, view=view)

    @property
    def rows(self) -> int:
        return sum(
            count for (split, view), count in self.counts.items()
            if self.split in (None, split) and self.view in (None, view)
        )  # fmt: skip

    def labels(self) -> Labels:
        """Keys, locations and positions of all selected rows."""
        tables = list(self._read(["key", "location", "lat", "lon"]))
        whole = pa.concat_tables(tables) if tables else pa.table({c: [] for c in ("key", "location", "lat", "lon")})
        return Labels(
            keys=np.asarray(whole["key"].to_pylist(), dtype=np.str_),
            locations=np.asarray(whole["location"].to_pylist(), dtype=np.str_),
            lats=np.asarray(whole["lat"].to_numpy(), dtype=np.float64),
            lons=np.asarray(whole["lon"].to_numpy(), dtype=np.float64),
        )

    def blocks(self, rows: int = BLOCK_ROWS) -> Iterator[Floats]:
        """Embeddings of the selected rows as float32 arrays (B, D), B <= rows, in the order of `labels`."""
        for table in self._read(["embedding"], rows):
            flat = table["embedding"].combine_chunks().flatten()
            yield flat.to_numpy(zero_copy_only=False).astype(np.float32, copy=False).reshape(-1, self.dimension)

    def embeddings(self) -> Floats:
        """All selected embeddings at once, float32 (rows, D)."""
        return np.concatenate([np.empty((0, self.dimension), np.float32), *self.blocks()])

    def _read(self, columns: list[str], rows: int = BLOCK_ROWS) -> Iterator[pa.Table]:
        wanted = {"split": self.split, "view": self.view}
        tests = {name: str(value) for name, value in wanted.items() if value is not None}
        for part in self.parts:
            with storage.open_read(storage.join(self.path, part)) as stream:
                parquet = pq.ParquetFile(stream)
                groups = [group for group in range(parquet.num_row_groups) if _may_hold(parquet, group, tests)]
                for batch in parquet.iter_batches(rows, groups, columns=[*columns, *tests]):
                    table = pa.Table.from_batches([batch])
                    for name, value in tests.items():
                        table = table.filter(pc.equal(table[name].cast(pa.string()), value))
                    if len(table):
                        yield table.select(columns)


def _may_hold(parquet: pq.ParquetFile, group: int, tests: dict[str, str]) -> bool:
    """Whether a row group's statistics leave room for the wanted values: most parts hold one split and view only."""
    for name, value in tests.items():
        column = parquet.schema_arrow.get_field_index(name)
        bounds = parquet.metadata.row_group(group).column(column).statistics
        if bounds is not None and bounds.has_min_max and not bounds.min <= value <= bounds.max:
            return False
    return True


def _count(path: str, parts: Sequence[str]) -> dict[tuple[Split, View], int]:
    found: Counter[tuple[Split, View]] = Counter()
    for part in parts:
        with storage.open_read(storage.join(path, part)) as stream:
            table = pq.read_table(stream, columns=["split", "view"])
        for row in table.group_by(["split", "view"]).aggregate([([], "count_all")]).to_pylist():
            found[Split(row["split"]), View(row["view"])] += row["count_all"]
    return dict(found)


def open_table(path: str) -> FeatureTable:
    """Open a feature table.

    Raises InputError when there is none, or when its parts come from different networks.
    """
    names = part_names(path)
    if not names:
        raise InputError(f"no feature table at {path}: found no Parquet part; make one with jobs/embed_gallery.py")
    footers = tuple(read_footer(storage.join(path, name)) for name in names)
    fingerprints = sorted({footer.fingerprint for footer in footers})
    if len(fingerprints) > 1:
        raise InputError(
            f"{path} holds features of {len(fingerprints)} networks ({', '.join(f[:12] for f in fingerprints)}); expected "
            "one; embed into an empty folder with jobs/embed_gallery.py --out"
        )
    with storage.open_read(storage.join(path, names[0])) as stream:
        dimension = pq.ParquetFile(stream).schema_arrow.field("embedding").type.list_size
    return FeatureTable(
        path=path,
        fingerprint=fingerprints[0],
        dimension=dimension,
        parts=tuple(names),
        footers=footers,
        counts=_count(path, names),
    )
