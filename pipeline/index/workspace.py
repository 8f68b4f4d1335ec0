"""The workspace of an index build: work units that survive a kill, merged into the index's parts.

In: a trained index and a table. Out: the files of each part, in the folder of the index. Unfinished
work lies in its `_building`, with the plan that it belongs to; a build with another plan starts
over.
"""

import ctypes
import json
import os
import tempfile
from collections.abc import Sequence
from typing import Any

import ray

from pipeline.core import cluster, json_files, storage
from pipeline.core.integrity import FileChecksum, checksum_file, checksum_ok, write_checksum
from pipeline.core.progress import progress
from pipeline.features.table import FeatureTable
from pipeline.index.faiss_io import FAISS, local_copy, read_faiss
from pipeline.index.ids import ID_COLUMNS, write_ids
from pipeline.index.metadata import PartMetadata
from pipeline.index.units import (
    WorkUnit,
    build_unit,
    can_merge,
    even_groups,
    merge_units,
    plan_units,
)

WORK_FOLDER, PLAN, TRAINED = "_building", "plan.json", "trained.faiss"


class BuildWorkspace:
    """The folder in which one index is built or extended."""

    def __init__(
        self, out: str, table: FeatureTable, identity: dict[str, Any], workers: int
    ) -> None:
        """`identity`: the plan of the work; unfinished work of another plan is removed. `workers`:
        Ray tasks, 0 for none.
        """
        self._out, self._table, self._workers = out, table, workers
        self._folder = storage.join(out, WORK_FOLDER)
        wanted = json.loads(json.dumps(identity))
        plan = storage.join(self._folder, PLAN)
        if _read_plan(plan) != wanted:
            self.clear()
            json_files.write_checksummed(plan, wanted)

    def clear(self) -> None:
        storage.remove_folder(self._folder)

    def is_trained(self) -> bool:
        return checksum_ok(self._trained)

    def save_trained(self, index: Any) -> None:
        with storage.atomic_file(self._trained) as local:
            FAISS.write_index(index, local)
        write_checksum(self._trained)

    def reuse_trained(self) -> None:
        """Take the trained index of the finished index."""
        if not self.is_trained():
            storage.link_or_copy(storage.join(self._out, TRAINED), self._trained)
            write_checksum(self._trained)

    def publish_trained(self) -> dict[str, FileChecksum]:
        """Put the trained index beside the parts; returns its name and checksum."""
        published = storage.join(self._out, TRAINED)
        storage.link_or_copy(self._trained, published)
        return {TRAINED: checksum_file(published)}

    @property
    def _trained(self) -> str:
        return storage.join(self._folder, TRAINED)

    def build(
        self,
        rows_of_part: dict[str, int],
        unit_rows: int,
        part_rows: int,
        first_row: int = 0,
        first_part: int = 0,
    ) -> tuple[PartMetadata, ...]:
        """Index these parts of the table, and write the parts of the index, of about `part_rows`
        rows.

        `first_row`, `first_part`: how many of each the index has already.
        """
        mergeable = self._can_merge()
        units = plan_units(rows_of_part, min(unit_rows, part_rows) if mergeable else part_rows)
        files = [
            storage.join(self._folder, f"unit-{number:06d}.faiss") for number in range(len(units))
        ]
        self._build_units(units, files)
        groups = [[number] for number in range(len(units))]
        if mergeable:
            groups = even_groups([unit.rows for unit in units], part_rows)
        parts: list[PartMetadata] = []
        for group in groups:
            suffix = _part_suffix(first_part + len(parts))
            faiss_file = storage.join(self._out, f"index{suffix}.faiss")
            self._merge([files[number] for number in group], faiss_file)
            part = self._write_ids([units[number] for number in group], first_row, suffix)
            parts.append(part)
            first_row += part.rows
        return tuple(parts)

    def _can_merge(self) -> bool:
        with tempfile.TemporaryDirectory() as scratch:
            return can_merge(read_faiss(local_copy(self._trained, scratch), on_disk=False))

    def _merge(self, files: Sequence[str], out: str) -> None:
        """Merge units into one file of the index."""
        if len(files) == 1:
            storage.link_or_copy(files[0], out)
            return
        with tempfile.TemporaryDirectory() as scratch, storage.atomic_file(out) as local:
            units = [local_copy(file, scratch) for file in files]
            FAISS.write_index(merge_units(local_copy(self._trained, scratch), units), local)
        release_memory()

    def _build_units(self, units: Sequence[WorkUnit], files: Sequence[str]) -> None:
        missing = [number for number, file in enumerate(files) if not checksum_ok(file)]
        total = sum(unit.rows for unit in units)
        with progress(total, "indexing", "rows") as meter:
            meter.advance(total - sum(units[number].rows for number in missing))
            if not self._workers:
                threads = os.cpu_count() or 1
                for number in missing:
                    unit, file = units[number], files[number]
                    meter.advance(build_unit(self._trained, self._table, unit, file, threads))
                release_memory()
                return
            cluster.connect()
            task: Any = ray.remote(num_cpus=1)(build_unit)
            table, trained = ray.put(self._table), storage.absolute(self._trained)

            def submit(number: int) -> Any:
                file = storage.absolute(files[number])
                return task.remote(trained, table, units[number], file, 1)

            for _, rows in cluster.bounded_map(submit, missing, self._workers):
                meter.advance(rows)

    def _write_ids(self, units: Sequence[WorkUnit], first_row: int, suffix: str) -> PartMetadata:
        """Write the ids of a part's rows; returns the part's metadata."""
        names = [name for unit in units for name in unit.table_parts]
        numbers = {name: number for number, name in enumerate(names)}
        table = self._table.with_parts(names)
        rows = ((numbers[name], rows) for name, rows in table.numbered_rows(ID_COLUMNS))
        parquet, arrow = f"ids{suffix}.parquet", f"ids{suffix}.arrow"
        write_ids(storage.join(self._out, parquet), storage.join(self._out, arrow), first_row, rows)
        files = (f"index{suffix}.faiss", parquet, arrow)
        return PartMetadata(
            faiss=files[0],
            ids=arrow,
            first_row=first_row,
            rows=sum(unit.rows for unit in units),
            table_parts=table.shards,
            files={name: checksum_file(storage.join(self._out, name)) for name in files},
        )


def unfinished_work(out: str) -> dict[str, Any] | None:
    """The plan of the unfinished build of an index; None where there is none, or it is damaged."""
    return _read_plan(storage.join(out, WORK_FOLDER, PLAN))


def _read_plan(path: str) -> dict[str, Any] | None:
    """The plan of the unfinished work; None where there is none, or it is damaged."""
    try:
        return json_files.read_checksummed(path) if storage.exists(path) else None
    except ValueError:
        return None


def release_memory() -> None:
    """Return to the system what FAISS has freed: glibc keeps the space of thousands of lists, and
    an index that is read next would come on top of it. Other C libraries have nothing to call.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def _part_suffix(number: int) -> str:
    """In the names of a part's files; the first part has the plain names that readers expect."""
    return f"-{number:06d}" if number else ""


def rows_by_part(table: FeatureTable) -> dict[str, int]:
    """How many rows of a selection each part of the table holds; parts without any are left out."""
    return {part: len(rows) for part, rows in table.numbered_rows(["view"])}
