"""The workshop of an index: units of work that survive a kill, made into the parts of an index.

In: a trained index and a table. Out: the files of each part, in the folder of the index. Everything unfinished lies in its
`_building`, with the plan that it is of; another plan begins anew.
"""

import ctypes
import json
import os
import tempfile
from collections.abc import Sequence
from typing import Any

import faiss
import ray

from pipeline.core import cluster, json_files, storage
from pipeline.core.progress import progress
from pipeline.features.table import FeatureTable
from pipeline.index.ids import ID_COLUMNS, local_copy, write_ids
from pipeline.index.metadata import PartMetadata, file_checksum
from pipeline.index.part import read_faiss
from pipeline.index.units import (
    WorkUnit,
    build_unit,
    can_merge,
    checksum_ok,
    even_groups,
    merge_units,
    plan_units,
    write_checksum,
)

WORK_FOLDER, PLAN, TRAINED = "_building", "plan.json", "trained.faiss"


class BuildWorkspace:
    """Where one index is built or grown."""

    def __init__(
        self, out: str, table: FeatureTable, identity: dict[str, Any], workers: int
    ) -> None:
        """`identity`: what the work is of; unfinished work of another is thrown away. `workers`:
        Ray tasks, 0 for none.
        """
        self._out, self._table, self._workers = out, table, workers
        self._scratch = storage.join(out, WORK_FOLDER)
        wanted = json.loads(json.dumps(identity))
        plan = storage.join(self._scratch, PLAN)
        if _read_plan(plan) != wanted:
            self.clear()
            json_files.write_checksummed(plan, wanted)

    def clear(self) -> None:
        storage.remove_folder(self._scratch)

    def is_trained(self) -> bool:
        return checksum_ok(self._trained)

    def save_trained(self, index: Any) -> None:
        with storage.atomic_file(self._trained) as local:
            faiss.write_index(index, local)
        write_checksum(self._trained)

    def reuse_trained(self) -> None:
        """Go on with the trained index of the finished one."""
        if not self.is_trained():
            storage.link_or_copy(storage.join(self._out, TRAINED), self._trained)
            write_checksum(self._trained)

    def publish_trained(self) -> dict[str, dict[str, Any]]:
        """Put the trained index beside what was built; its name, size and hash."""
        storage.link_or_copy(self._trained, storage.join(self._out, TRAINED))
        return {TRAINED: file_checksum(self._out, TRAINED)}

    @property
    def _trained(self) -> str:
        return storage.join(self._scratch, TRAINED)

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
        whole = self._can_merge()
        units = plan_units(rows_of_part, min(unit_rows, part_rows) if whole else part_rows)
        files = [
            storage.join(self._scratch, f"unit-{number:06d}.faiss") for number in range(len(units))
        ]
        self._build_units(units, files)
        parts: list[PartMetadata] = []
        for group in (
            even_groups([unit.rows for unit in units], part_rows)
            if whole
            else [[i] for i in range(len(units))]
        ):
            ending = _part_suffix(first_part + len(parts))
            self._merge(
                [files[number] for number in group], storage.join(self._out, f"index{ending}.faiss")
            )
            parts.append(self._describe([units[number] for number in group], first_row, ending))
            first_row += parts[-1].rows
        return tuple(parts)

    def _can_merge(self) -> bool:
        with tempfile.TemporaryDirectory() as scratch:
            return can_merge(read_faiss(local_copy(self._trained, scratch), on_disk=False))

    def _merge(self, files: Sequence[str], out: str) -> None:
        """Make units one file of the index."""
        if len(files) == 1:
            storage.link_or_copy(files[0], out)
            return
        with tempfile.TemporaryDirectory() as scratch, storage.atomic_file(out) as local:
            units = [local_copy(file, scratch) for file in files]
            faiss.write_index(merge_units(local_copy(self._trained, scratch), units), local)
        release_memory()

    def _build_units(self, units: Sequence[WorkUnit], files: Sequence[str]) -> None:
        missing = [number for number, file in enumerate(files) if not checksum_ok(file)]
        with progress(sum(unit.rows for unit in units), "indexing", "rows") as meter:
            meter.advance(
                sum(units[number].rows for number in range(len(units)) if number not in missing)
            )
            if not self._workers:
                for number in missing:
                    rows = build_unit(
                        self._trained,
                        self._table,
                        units[number],
                        files[number],
                        os.cpu_count() or 1,
                    )
                    meter.advance(rows)
                release_memory()
                return
            cluster.connect()
            task: Any = ray.remote(num_cpus=1)(build_unit)
            table, trained = ray.put(self._table), storage.absolute(self._trained)

            def submit(number: int) -> Any:
                return task.remote(
                    trained, table, units[number], storage.absolute(files[number]), 1
                )

            for _, rows in cluster.bounded_map(submit, missing, self._workers):
                meter.advance(rows)

    def _describe(self, units: Sequence[WorkUnit], first_row: int, ending: str) -> PartMetadata:
        """Write whose rows the vectors of a part are, and say what it holds."""
        held = {
            name: number
            for number, name in enumerate(name for unit in units for name in unit.table_parts)
        }
        table = self._table.only(list(held))
        ids = {kind: f"ids{ending}.{kind}" for kind in ("parquet", "arrow")}
        parquet, arrow = (storage.join(self._out, name) for name in ids.values())
        write_ids(
            parquet,
            arrow,
            first_row,
            ((held[name], rows) for name, rows in table.numbered(ID_COLUMNS)),
        )
        names = (f"index{ending}.faiss", *ids.values())
        return PartMetadata(
            faiss=names[0],
            ids=ids["arrow"],
            first_row=first_row,
            rows=sum(unit.rows for unit in units),
            table_parts=table.shards,
            files={name: file_checksum(self._out, name) for name in names},
        )


def _read_plan(path: str) -> dict[str, Any] | None:
    """What unfinished work is of; None where there is none, or where that cannot be told."""
    try:
        return json_files.read_checksummed(path) if storage.exists(path) else None
    except ValueError:
        return None


def release_memory() -> None:
    """Let the system have what FAISS has freed: glibc keeps thousands of lists' room, and an index
    that is read next would come on top of it. Elsewhere there is nothing to call."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def _part_suffix(number: int) -> str:
    """Of the names of a part's files; the first one has the names that plain readers look for."""
    return f"-{number:06d}" if number else ""


def rows_by_part(table: FeatureTable) -> dict[str, int]:
    """How many rows of a selection each part of the table holds; parts without any are left out."""
    return {part: len(rows) for part, rows in table.numbered(["view"])}
