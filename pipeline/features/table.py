"""The feature table: a folder of Parquet parts, one per shard, that any Parquet reader opens.

In: a folder that embedding has filled. Out: its rows in blocks, all of them or those that filters
select, for ranking, indexing and evaluation. A table that is incomplete, damaged or of more than
one encoder is refused.
Shapes: B rows of a block, D dimensions of an embedding.
"""

import hashlib
import json
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, overload

import numpy as np
import pyarrow as pa

from pipeline.core import storage
from pipeline.core.arrays import Doubles, Floats, Halves, Strings
from pipeline.core.errors import InputError
from pipeline.core.filters import Filter
from pipeline.core.geo import Box
from pipeline.core.parquet import select_or_null
from pipeline.core.prefetch import prefetch_map
from pipeline.core.records import Split, View
from pipeline.features.encoding import EncodingConfig
from pipeline.features.expected_parts import check_expected
from pipeline.features.part import (
    READERS,
    PartFooter,
    PartHeader,
    check_consistent_parts,
    open_part,
    parse_split_and_view,
    part_header,
    part_names,
    part_schema,
    validate_rows,
    vector_lengths,
    verify_part,
)
from pipeline.features.row_groups import matching_row_groups
from pipeline.features.unique_keys import check_unique_keys

BLOCK_BYTES = 64 * 2**20
"Of a block as float32, where its number of rows is not given."
UNIQUE_CHECK_ROWS = 1_000_000
"""Rows up to which opening checks that keys are unique, a third of a second; `verify_table` checks
any number."""
Counts = Counter[tuple[Split, View]]


@dataclass(frozen=True, kw_only=True)
class Labels:
    """A row's columns besides its embedding; equal lengths, in the table's order."""

    keys: Strings
    locations: Strings
    lats: Doubles
    "NaN where unknown."
    lons: Doubles


@dataclass(frozen=True, kw_only=True)
class FeatureTable:
    """A feature table, or a selection of its rows. Opened by `open_table`; embeddings are read in
    blocks.
    """

    path: str
    fingerprint: str
    "Of the encoder that made every row."
    encoding: EncodingConfig | None
    "How it encoded the images; None for features that another program made."
    dimension: int
    dtype: str
    "Of the stored embeddings: float32 or float16."
    parts: tuple[str, ...]
    footers: tuple[PartFooter, ...]
    counts: dict[tuple[Split, View], int]
    "Rows of each split and view in the whole table, whatever is selected."
    filters: tuple[Filter, ...] = ()
    "A row is selected when all of them match it."

    def select(
        self,
        split: Split | None = None,
        view: View | None = None,
        locations: str | Iterable[str] | None = None,
        box: Box | None = None,
    ) -> "FeatureTable":
        """Those of these rows that have the split, the view, one of the locations and a position in
        the rectangle (None: any).
        """
        if locations is not None:
            locations = frozenset([locations] if isinstance(locations, str) else locations)
        added = Filter(split=split, view=view, locations=locations, box=box)
        return replace(self, filters=(*self.filters, added)) if added != Filter() else self

    @cached_property
    def rows(self) -> int:
        """Number of selected rows."""
        if self._filter_columns - {"split", "view"}:
            return sum(len(rows) for _, rows in self._read(["split"]))
        return sum(count for _, count in self._selected_counts())

    @property
    def digest(self) -> str:
        """Hash of the whole table's content, from its footers: the same for a copy elsewhere."""
        footers = [[one.fingerprint, one.shard_sha256, one.rows] for one in self.footers]
        content = json.dumps([self.dimension, list(self.parts), footers])
        return hashlib.sha256(content.encode()).hexdigest()

    @property
    def shards(self) -> dict[str, str]:
        """For each part the hash of the shard that was embedded, in the table's order."""
        return {name: footer.shard_sha256 for name, footer in self._footer_of.items()}

    @property
    def views(self) -> list[View]:
        """The views that occur in the selected splits and views."""
        return sorted({view for view, _ in self._selected_counts()})

    def _selected_counts(self) -> Iterator[tuple[View, int]]:
        """View and count of the splits and views that the filters select."""
        for (split, view), count in self.counts.items():
            if all(one.split in (None, split) and one.view in (None, view) for one in self.filters):
                yield view, count

    @property
    def _filter_columns(self) -> set[str]:
        return {column for one in self.filters for column in one.columns}

    def labels(self) -> Labels:
        """Keys, locations and positions of all selected rows."""
        columns = ["key", "location", "lat", "lon"]
        tables = [rows for _, rows in self._read(columns)]
        rows = pa.concat_tables(tables) if tables else pa.table({name: [] for name in columns})
        return Labels(
            keys=np.asarray(rows["key"].to_pylist(), dtype=np.str_),
            locations=np.asarray(rows["location"].to_pylist(), dtype=np.str_),
            lats=np.asarray(rows["lat"].to_numpy(), dtype=np.float64),
            lons=np.asarray(rows["lon"].to_numpy(), dtype=np.float64),
        )

    def keys(self) -> Iterator[tuple[str, list[str]]]:
        """The selected rows' keys in pieces, each with the part that it is from."""
        for part, rows in self._read(["key"]):
            yield part, rows["key"].to_pylist()

    def with_parts(self, parts: Sequence[str]) -> "FeatureTable":
        """The same selection of some parts alone, in this order. `counts`, and with it `rows`,
        remain the whole table's.
        """
        footers = tuple(self._footer_of[name] for name in parts)
        return replace(self, parts=tuple(parts), footers=footers)

    @cached_property
    def _footer_of(self) -> dict[str, PartFooter]:
        return dict(zip(self.parts, self.footers, strict=True))

    def numbered_rows(self, columns: Sequence[str]) -> Iterator[tuple[str, pa.Table]]:
        """Per part that has selected rows: its name and their columns, first `part_row`, a row's
        number within the part.
        """
        wanted = sorted({*columns, *self._filter_columns})
        for part in self.parts:
            with open_part(storage.join(self.path, part)) as parquet:
                rows = validate_rows(parquet.read(columns=wanted))
            rows = select_or_null(rows, wanted, part_schema(1))
            rows = rows.append_column("part_row", pa.array(np.arange(len(rows), dtype=np.int32)))
            rows = self._apply_filters(rows)
            if len(rows):
                yield part, rows.select(["part_row", *columns])

    @overload
    def blocks(
        self, rows: int | None = None, dtype: Literal["float32"] = "float32"
    ) -> Iterator[Floats]: ...

    @overload
    def blocks(self, rows: int | None = None, *, dtype: Literal["float16"]) -> Iterator[Halves]: ...

    @overload
    def blocks(
        self, rows: int | None = None, *, dtype: Literal["stored"]
    ) -> Iterator[Floats | Halves]: ...

    def blocks(
        self, rows: int | None = None, dtype: Literal["float32", "float16", "stored"] = "float32"
    ) -> Iterator[Any]:
        """Embeddings of the selected rows as arrays (B, D), B <= rows, in the order of `labels`.

        One block at a time is in memory; without `rows` it has 64 MiB at most. With the dtype
        "stored" it is that of the parts. Raises InputError where an embedding is NaN or not of unit
        length.
        """
        wanted = self.dtype if dtype == "stored" else dtype
        for part, piece in self._read(["embedding"], rows):
            flat = piece["embedding"].combine_chunks().flatten().to_numpy(zero_copy_only=False)
            block_BD = flat.reshape(-1, self.dimension)
            single_BD = block_BD.astype(np.float32, copy=False)
            self._check_unit_length(part, single_BD)
            yield single_BD if wanted == "float32" else block_BD.astype(wanted, copy=False)

    def embeddings(self) -> Floats:
        """All selected embeddings at once, float32 (rows, D)."""
        return np.concatenate([np.empty((0, self.dimension), np.float32), *self.blocks()])

    def _check_unit_length(self, part: str, vectors_BD: Floats) -> None:
        length_B, unit_B = vector_lengths(vectors_BD)
        if not unit_B.all():
            raise InputError(
                f"{storage.join(self.path, part)} holds {np.count_nonzero(~unit_B)} embeddings "
                f"like one of length {length_B[np.argmin(unit_B)]:.4g}, expected unit length; "
                "delete this part and embed its shard again"
            )

    def _read(self, columns: list[str], rows: int | None = None) -> Iterator[tuple[str, pa.Table]]:
        """The selected rows' columns in pieces, each with the part that it is from."""
        rows = rows or max(1, BLOCK_BYTES // (4 * self.dimension))
        wanted = sorted({*columns, *self._filter_columns})
        for part in self.parts:
            with open_part(storage.join(self.path, part)) as parquet:
                groups = matching_row_groups(parquet, self.filters)
                for batch in parquet.iter_batches(rows, groups, columns=wanted):
                    piece = self._apply_filters(validate_rows(pa.Table.from_batches([batch])))
                    if len(piece):
                        yield part, piece.select(columns)

    def _apply_filters(self, rows: pa.Table) -> pa.Table:
        for one in self.filters:
            rows = rows.filter(pa.array(one.mask(rows)))
        return rows


def open_table(path: str) -> FeatureTable:
    """Open a feature table.

    Raises InputError when there is none, when a part is missing, damaged or no part, when the parts
    come from different encoders or have different vectors, and when a key is not unique (checked in
    tables of up to UNIQUE_CHECK_ROWS rows).
    """
    table = _open(path)
    if table.rows <= UNIQUE_CHECK_ROWS:
        check_unique_keys(path, table.keys)
    return table


def verify_table(path: str) -> FeatureTable:
    """`open_table` with a check of every byte and row: keys unique, embeddings of unit length.

    Takes 8 bytes of memory a row. Raises InputError, naming the part, where a check fails.
    """
    for name in part_names(path):
        verify_part(storage.join(path, name))
    table = _open(path)
    check_unique_keys(path, table.keys)
    for _ in table.blocks(dtype="stored"):
        pass
    return table


def _open(path: str) -> FeatureTable:
    names = part_names(path)
    if not names:
        raise InputError(
            f"no feature table at {path}: found no Parquet part; make one with "
            "jobs/embed_gallery.py"
        )
    check_expected(path, names)
    paths = [storage.join(path, name) for name in names]
    opened = list(prefetch_map(_open_one, paths, READERS, 4 * READERS))
    headers = [header for header, _ in opened]
    check_consistent_parts(path, headers)
    first = headers[0]
    return FeatureTable(
        path=path,
        fingerprint=first.footer.fingerprint,
        encoding=first.footer.encoding,
        dimension=first.dimension,
        dtype=first.dtype,
        parts=tuple(names),
        footers=tuple(header.footer for header in headers),
        counts=dict(sum((counts for _, counts in opened), Counts())),
    )


def _open_one(path: str) -> tuple[PartHeader, Counts]:
    counts: Counts = Counter()
    with open_part(path) as parquet:
        header = part_header(parquet, path)
        rows = validate_rows(parquet.read(columns=["split", "view"])).unify_dictionaries()
    for row in rows.group_by(["split", "view"]).aggregate([([], "count_all")]).to_pylist():
        counts[parse_split_and_view(path, row["split"], row["view"])] += row["count_all"]
    return header, counts
