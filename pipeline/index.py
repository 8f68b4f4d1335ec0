"""Feature table -> FAISS index on disk, and searching it.

Out: a folder with `index.faiss` (ids are row numbers, nothing else), `ids.parquet` (row number -> key, location, lat,
lon) and `index.json`, written last, with what was built and how well it finds what exact search finds.
Shapes: N rows, Q queries, K neighbours, D dimensions.
"""

import os
import re
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import faiss
import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from pipeline import storage
from pipeline.features import FeatureTable, Floats, Labels, open_table
from pipeline.progress import console, progress
from pipeline.records import InputError, Split, View

SCHEMA_VERSION = 1
INDEX, IDS, FACTS = "index.faiss", "ids.parquet", "index.json"
TRAINING_ROWS = 65_536
"At most so many rows train a compressed index."
HELD_QUERIES = 256
"Rows of the table that are searched for to measure recall."
UNITS = {"": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12}


@dataclass(frozen=True, kw_only=True)
class IndexSettings:
    """Which table is indexed, and how."""

    table: str
    "Folder or URI of the feature table."
    out: str
    "Folder or URI of the index."
    split: Split | None = None
    "Only rows of this split."
    view: View | None = None
    "Only rows of this view."
    memory_budget: str = "4GB"
    "What the index may take in memory: a number with KB, MB, GB or TB."
    target_recall: float = 0.95
    "Recall@10 against exact search that the index is to reach."
    factory: str | None = None
    "FAISS factory string; by default exact (Flat)."

    def __post_init__(self) -> None:
        if not 0 < self.target_recall <= 1:
            raise InputError(f"--target-recall is {self.target_recall}, expected a fraction above 0 and at most 1")
        parse_bytes(self.memory_budget)


def parse_bytes(text: str) -> int:
    """Bytes that a text such as `4GB` means.

    Raises InputError.
    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([KMGT]?B?)\s*", text.upper())
    unit = "" if match is None else match[2] if match[2].endswith("B") or not match[2] else match[2] + "B"
    if match is None or unit not in UNITS:
        raise InputError(f"--memory-budget is {text!r}, expected a number with KB, MB, GB or TB, such as 4GB")
    return int(float(match[1]) * UNITS[unit])


def choose_factory(rows: int, dimension: int, budget: int) -> str:
    """The FAISS factory string for a table of this size: exact search while it fits.

    Raises InputError when the vectors do not fit into the budget.
    """
    needed = rows * dimension * 4
    if needed > budget:
        raise InputError(
            f"{rows} x {dimension} float32 vectors take {needed / 1e9:.2f} GB, the budget is {budget / 1e9:.2f} GB; raise "
            "--memory-budget, or name a compressed --factory such as IVF1024,PQ64"
        )
    return "Flat"


def build_index(settings: IndexSettings) -> dict[str, Any]:
    """Build the index of a table, or of one split or view of it; a finished one is left as it is. Returns its facts.

    Raises InputError on unusable input.
    """
    table = open_table(settings.table).select(settings.split, settings.view)
    asked = {"split": settings.split, "view": settings.view, "factory": settings.factory}
    if storage.exists(storage.join(settings.out, FACTS)):
        facts: dict[str, Any] = storage.read_json(storage.join(settings.out, FACTS))
        same = facts["asked"] == asked and facts["fingerprint"] == table.fingerprint and facts["rows"] == table.rows
        if not same:
            raise InputError(
                f"{settings.out} holds an index of other rows or settings; choose another --out or delete it"
            )
        console.print(f"{settings.out} is complete: {facts['rows']} rows, {facts['factory']}; nothing to do")
        return facts
    if not table.rows:
        held = ", ".join(f"{count} {split} {view}" for (split, view), count in table.counts.items())
        raise InputError(f"{settings.table} holds {held} and none of it was asked for; check --split and --view")
    factory = settings.factory or choose_factory(table.rows, table.dimension, parse_bytes(settings.memory_budget))
    faiss.omp_set_num_threads(os.cpu_count() or 1)  # Ray sets OMP_NUM_THREADS in its jobs; this one uses all cores
    start = time.perf_counter()
    index, trained_on = _fill(table, factory)
    seconds = time.perf_counter() - start
    recall = measure_recall(index, table)
    if recall["recall_at_10"] < settings.target_recall:
        console.print(
            f"recall@10 is {recall['recall_at_10']:.3f}, below the target of {settings.target_recall}; the index is kept",
            style="yellow",
        )
    size = _write(index, table.labels(), table, settings.out)
    facts = {
        "schema_version": SCHEMA_VERSION, "factory": factory, "metric": "inner product", "rows": table.rows,
        "dimension": table.dimension, "fingerprint": table.fingerprint, "asked": asked, "table": storage.absolute(table.path),
        "training_sample": trained_on, "build_seconds": round(seconds, 3), "bytes_per_vector": size / table.rows, **recall,
    }  # fmt: skip
    storage.write_json(storage.join(settings.out, FACTS), facts)
    console.print(f"{settings.out}: {table.rows} rows, {factory}, recall@10 {recall['recall_at_10']:.3f} of exact")
    return facts


def _fill(table: FeatureTable, factory: str) -> tuple[Any, int]:
    try:
        index = faiss.index_factory(table.dimension, factory, faiss.METRIC_INNER_PRODUCT)
    except RuntimeError:
        raise InputError(
            f"--factory is {factory!r}, which FAISS cannot build over {table.dimension} dimensions; expected a factory "
            "string such as Flat or IVF1024,PQ64"
        ) from None
    trained_on = 0
    if not index.is_trained:
        sample_ND = training_sample(table)
        trained_on = len(sample_ND)
        index.train(sample_ND)
    with progress(table.rows, "indexing", "rows") as meter:
        for block_BD in table.blocks():
            index.add(block_BD)
            meter.advance(len(block_BD))
    return index, trained_on


def training_sample(table: FeatureTable) -> Floats:
    """The table's first rows (N, D), at most TRAINING_ROWS: shards are ordered by hash, so they are a fair sample."""
    blocks, rows = [], 0
    for block_BD in table.blocks():
        blocks.append(block_BD[: TRAINING_ROWS - rows])
        rows += len(blocks[-1])
        if rows == TRAINING_ROWS:
            break
    return np.concatenate(blocks)


def measure_recall(index: Any, table: FeatureTable) -> dict[str, float]:
    """Share of exact search's first and first ten rows that the index finds, over rows spread through the table."""
    rows = table.rows
    held = np.unique(np.linspace(0, rows - 1, min(rows, HELD_QUERIES)).astype(np.int64))
    k = min(10, rows)
    queries, start = [], 0
    for block_BD in table.blocks():
        inside = held[(held >= start) & (held < start + len(block_BD))] - start
        queries.append(block_BD[inside])
        start += len(block_BD)
    queries_QD = np.concatenate(queries)
    exact_QK = exact_search(queries_QD, table, k)
    found_QK = index.search(queries_QD, k)[1]
    at_1 = float((exact_QK[:, :1] == found_QK[:, :1]).mean())
    at_k = float(np.mean([len(set(e) & set(f)) / k for e, f in zip(exact_QK, found_QK, strict=True)]))
    return {"recall_at_1": at_1, "recall_at_10": at_k, "recall_queries": len(queries_QD)}


def exact_search(queries_QD: Floats, table: FeatureTable, k: int) -> npt.NDArray[np.int64]:
    """Row numbers (Q, K) of the rows with the highest inner products, block by block."""
    heap = faiss.ResultHeap(len(queries_QD), k, keep_max=True)
    start = 0
    for block_BD in table.blocks():
        flat = faiss.IndexFlatIP(table.dimension)
        flat.add(block_BD)
        scores, rows = flat.search(queries_QD, min(k, len(block_BD)))
        heap.add_result(scores, rows + start)
        start += len(block_BD)
    heap.finalize()
    found: npt.NDArray[np.int64] = heap.I
    return found


def _write(index: Any, labels: Labels, table: FeatureTable, out: str) -> int:
    rows = pa.table({
        "row": pa.array(np.arange(len(labels.keys))), "key": pa.array(labels.keys), "location": pa.array(labels.locations),
        "lat": pa.array(labels.lats, from_pandas=True), "lon": pa.array(labels.lons, from_pandas=True),
    })  # fmt: skip
    with storage.atomic(storage.join(out, IDS)) as stream:
        pq.write_table(rows, stream)
    with tempfile.TemporaryDirectory() as scratch:
        local = Path(scratch) / INDEX  # FAISS writes to local paths only
        faiss.write_index(index, str(local))
        data = local.read_bytes()
    storage.write_bytes(storage.join(out, INDEX), data)
    return len(data)


@dataclass(frozen=True, kw_only=True)
class Hit:
    """One row that a search found."""

    key: str
    location: str
    lat: float | None
    lon: float | None
    score: float
    "Cosine similarity, -1 to 1."


class Index:
    """An index on disk, opened for searching."""

    def __init__(self, path: str) -> None:
        """Raises InputError when there is no index at `path`."""
        if not storage.exists(storage.join(path, FACTS)):
            raise InputError(f"no index at {path}: found no {FACTS}; make one with jobs/build_index.py")
        self.facts: dict[str, Any] = storage.read_json(storage.join(path, FACTS))
        with storage.open_read(storage.join(path, IDS)) as stream:
            self._rows = pq.read_table(stream).to_pylist()
        with tempfile.TemporaryDirectory() as scratch:
            local = Path(scratch) / INDEX
            local.write_bytes(storage.read_bytes(storage.join(path, INDEX)))
            self._index = faiss.read_index(str(local))

    def search(self, queries_QD: Floats, k: int = 10) -> list[list[Hit]]:
        """The K best rows of each query, best first."""
        scores_QK, rows_QK = self._index.search(np.ascontiguousarray(queries_QD, np.float32), min(k, len(self._rows)))
        return [
            [self._hit(int(row), float(score)) for row, score in zip(rows, scores, strict=True) if row >= 0]
            for rows, scores in zip(rows_QK, scores_QK, strict=True)
        ]

    def _hit(self, row: int, score: float) -> Hit:
        found = self._rows[row]
        return Hit(key=found["key"], location=found["location"], lat=found["lat"], lon=found["lon"], score=score)
