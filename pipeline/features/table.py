"""The feature table: a folder of Parquet parts, one per shard, that any Parquet reader opens as it
is.

In: a folder that embedding has filled. Out: its rows in blocks, all of them or a selection, for
whoever ranks, indexes or evaluates. What is not a whole table of one network is refused. Shapes: B
rows of a block, D dimensions of an embedding.
"""

import hashlib
import json
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, overload

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from pipeline.core import storage
from pipeline.core.arrays import Floats, Halves, Strings
from pipeline.core.errors import InputError
from pipeline.core.geo import Box
from pipeline.core.prefetch import prefetch_map
from pipeline.core.records import Split, View
from pipeline.features import expected_parts
from pipeline.features.part import (
    READERS,
    PartFooter,
    PartHeader,
    PartRows,
    check_consistent_parts,
    open_part,
    parse_split_and_view,
    part_header,
    part_names,
    part_schema,
    read_footer,
    validate_rows,
    verify_part,
    write_part,
)
from pipeline.features.selection import Selection

__all__ = [
    "Box",
    "FeatureTable",
    "Floats",
    "Labels",
    "PartFooter",
    "PartRows",
    "Strings",
    "open_table",
    "part_names",
    "part_schema",
    "read_footer",
    "verify_table",
    "write_part",
]

BLOCK_BYTES = 64 * 2**20
"Of a block as float32, where its rows are not said."
TOLERANCE = 0.01
"Of an embedding's length: what float16 and rounding take."
UNIQUE_CHECK_ROWS = 1_000_000
"""Rows up to which opening looks whether a key repeats, a third of a second; `verify_table` does for any
number."""
Counts = Counter[tuple[Split, View]]


@dataclass(frozen=True, kw_only=True)
class Labels:
    """What is known of each row besides its embedding; equal lengths, in the table's order."""

    keys: Strings
    locations: Strings
    lats: npt.NDArray[np.float64]
    "NaN where unknown."
    lons: npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class FeatureTable:
    """A feature table, or the rows of it that were selected. Opened by `open_table`; embeddings are
    read in blocks.
    """

    path: str
    fingerprint: str
    "Of the network that made every row."
    dimension: int
    dtype: str
    "Of the stored embeddings: float32 or float16."
    parts: tuple[str, ...]
    footers: tuple[PartFooter, ...]
    counts: dict[tuple[Split, View], int]
    "Rows of each split and view that the whole table holds, whatever is selected."
    selections: tuple[Selection, ...] = ()
    "A row is meant when all of them mean it."

    def select(
        self,
        split: Split | None = None,
        view: View | None = None,
        locations: str | Iterable[str] | None = None,
        box: Box | None = None,
    ) -> "FeatureTable":
        """Of these rows, those of a split, a view, one or several locations, a rectangle of
        positions (None: any).
        """
        named = frozenset([locations]) if isinstance(locations, str) else locations
        meant = Selection(
            split=split, view=view, locations=None if named is None else frozenset(named), box=box
        )
        return replace(self, selections=(*self.selections, meant)) if meant != Selection() else self

    @cached_property
    def rows(self) -> int:
        """How many are selected."""
        if any(meant.columns - {"split", "view"} for meant in self.selections):
            return sum(len(rows) for _, rows in self._read(["split"]))
        return sum(count for _, count in self._kinds())

    @property
    def digest(self) -> str:
        """Hash of what the whole table holds, from its parts' footers: the same for a copy
        elsewhere.
        """
        said = [[footer.fingerprint, footer.shard_sha256, footer.rows] for footer in self.footers]
        return hashlib.sha256(
            json.dumps([self.dimension, list(self.parts), said]).encode()
        ).hexdigest()

    @property
    def shards(self) -> dict[str, str]:
        """Of each part the hash of the shard that was embedded, in the table's order."""
        return {
            name: footer.shard_sha256 for name, footer in zip(self.parts, self.footers, strict=True)
        }

    @property
    def views(self) -> list[View]:
        """The views that rows of the selected splits and views have."""
        return sorted({view for view, _ in self._kinds()})

    def _kinds(self) -> Iterator[tuple[View, int]]:
        """View and count of the splits and views that are selected."""
        for (split, view), count in self.counts.items():
            if all(
                one.split in (None, split) and one.view in (None, view) for one in self.selections
            ):
                yield view, count

    def labels(self) -> Labels:
        """Keys, locations and positions of all selected rows."""
        columns = ["key", "location", "lat", "lon"]
        tables = [rows for _, rows in self._read(columns)]
        whole = pa.concat_tables(tables) if tables else pa.table({name: [] for name in columns})
        return Labels(
            keys=np.asarray(whole["key"].to_pylist(), dtype=np.str_),
            locations=np.asarray(whole["location"].to_pylist(), dtype=np.str_),
            lats=np.asarray(whole["lat"].to_numpy(), dtype=np.float64),
            lons=np.asarray(whole["lon"].to_numpy(), dtype=np.float64),
        )

    def only(self, parts: Sequence[str]) -> "FeatureTable":
        """The same selection of some parts alone, in this order. `counts`, and with it `rows`,
        remain the whole table's.
        """
        return replace(
            self, parts=tuple(parts), footers=tuple(self._footer_of[name] for name in parts)
        )

    @cached_property
    def _footer_of(self) -> dict[str, PartFooter]:
        return dict(zip(self.parts, self.footers, strict=True))

    def numbered(self, columns: Sequence[str]) -> Iterator[tuple[str, pa.Table]]:
        """Per part that holds selected rows: its name and their columns, first `part_row`, a row's
        number within the part.
        """
        tests = set().union(*(meant.columns for meant in self.selections))
        for part in self.parts:
            with open_part(storage.join(self.path, part)) as parquet:
                found = validate_rows(parquet.read(columns=sorted({*columns, *tests})))
            found = found.append_column("part_row", pa.array(np.arange(len(found), dtype=np.int32)))
            for meant in self.selections:
                found = found.filter(meant.mask(found))
            if len(found):
                yield part, found.select(["part_row", *columns])

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

        No more than a block is in memory; without `rows` it has 64 MiB at most. `dtype` may be
        `stored`: as the parts have them. Raises InputError where an embedding is NaN or not of unit
        length.
        """
        wanted = self.dtype if dtype == "stored" else dtype
        for part, found in self._read(["embedding"], rows):
            flat = found["embedding"].combine_chunks().flatten().to_numpy(zero_copy_only=False)
            block_BD = flat.reshape(-1, self.dimension)
            single_BD = block_BD.astype(np.float32, copy=False)
            self._refuse_lengths(part, np.sqrt(np.einsum("bd,bd->b", single_BD, single_BD)))
            yield single_BD if wanted == "float32" else block_BD.astype(wanted, copy=False)

    def embeddings(self) -> Floats:
        """All selected embeddings at once, float32 (rows, D)."""
        return np.concatenate([np.empty((0, self.dimension), np.float32), *self.blocks()])

    def _refuse_lengths(self, part: str, length_B: Floats) -> None:
        unit_B = np.abs(length_B - 1) <= TOLERANCE  # false of a NaN
        if not unit_B.all():
            raise InputError(
                f"{storage.join(self.path, part)} holds {np.count_nonzero(~unit_B)} embeddings like one of length "
                f"{length_B[np.argmin(unit_B)]:.4g}, expected unit length; delete this part and embed its shard again"
            )

    def _read(self, columns: list[str], rows: int | None = None) -> Iterator[tuple[str, pa.Table]]:
        """The selected rows' columns in pieces, each with the part that it is from."""
        rows = rows or max(1, BLOCK_BYTES // (4 * self.dimension))
        tests = set().union(*(meant.columns for meant in self.selections))
        for part in self.parts:
            with open_part(storage.join(self.path, part)) as parquet:
                groups = [
                    group
                    for group in range(parquet.num_row_groups)
                    if all(meant.may_hold(parquet, group) for meant in self.selections)
                ]
                for batch in parquet.iter_batches(rows, groups, columns=sorted({*columns, *tests})):
                    found = validate_rows(pa.Table.from_batches([batch]))
                    for meant in self.selections:
                        found = found.filter(meant.mask(found))
                    if len(found):
                        yield part, found.select(columns)


def open_table(path: str) -> FeatureTable:
    """Open a feature table.

    Raises InputError when there is none, when a part is missing, torn or another's, when the parts
    come from different networks or hold different numbers, and when a key is there twice (looked
    for in tables of up to KEYS_AT_OPENING rows).
    """
    table = _open(path)
    if table.rows <= UNIQUE_CHECK_ROWS:
        _check_unique_keys(table)
    return table


def verify_table(path: str) -> FeatureTable:
    """`open_table`, and every byte and row is looked at: keys there once, embeddings of unit
    length. Takes 8 bytes a row.

    Raises InputError, naming the part, where they are not.
    """
    for name in part_names(path):
        verify_part(storage.join(path, name))
    table = _open(path)
    _check_unique_keys(table)
    for _ in table.blocks(dtype="stored"):
        pass
    return table


def _open(path: str) -> FeatureTable:
    names = part_names(path)
    if not names:
        raise InputError(
            f"no feature table at {path}: found no Parquet part; make one with jobs/embed_gallery.py"
        )
    expected_parts.check_expected(path, names)
    found = list(
        prefetch_map(lambda name: _open_one(storage.join(path, name)), names, READERS, 4 * READERS)
    )
    headers = [header for header, _ in found]
    check_consistent_parts(path, headers)
    return FeatureTable(
        path=path,
        fingerprint=headers[0].footer.fingerprint,
        dimension=headers[0].dimension,
        dtype=headers[0].dtype,
        parts=tuple(names),
        footers=tuple(header.footer for header in headers),
        counts=dict(sum((counts for _, counts in found), Counts())),
    )


def _open_one(path: str) -> tuple[PartHeader, Counts]:
    counts: Counts = Counter()
    with open_part(path) as parquet:
        header = part_header(parquet, path)
        table = validate_rows(parquet.read(columns=["split", "view"])).unify_dictionaries()
    for row in table.group_by(["split", "view"]).aggregate([([], "count_all")]).to_pylist():
        counts[parse_split_and_view(path, row["split"], row["view"])] += row["count_all"]
    return header, counts


def _check_unique_keys(table: FeatureTable) -> None:
    """Raise InputError where a key is there twice. Keys are compared by 64-bit hashes, and those
    that agree by themselves.
    """
    hashes = [np.empty(0, np.int64)]
    for _, rows in table._read(["key"]):
        hashes.append(np.fromiter(map(hash, rows["key"].to_pylist()), np.int64, len(rows)))
    hash_N = np.sort(np.concatenate(hashes))
    twice = set(hash_N[1:][hash_N[1:] == hash_N[:-1]].tolist())
    seen: dict[str, str] = {}
    for part, rows in table._read(["key"]) if twice else ():
        for key in rows["key"].to_pylist():
            if hash(key) not in twice:
                continue
            if key in seen:
                raise InputError(
                    f"{storage.join(table.path, part)} holds key {key}, which {seen[key]} holds too, expected keys that are "
                    "there once; keep the parts of one data set only, and embed others into a folder of their own"
                )
            seen[key] = part
