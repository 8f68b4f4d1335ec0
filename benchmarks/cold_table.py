"""Candidates' vectors from a feature table that is not in the page cache.

    python benchmarks/cold_table.py [--rows 1000000] [--dimension 1024] [--parts 100]

Writes a table (float16) and reads the rows that single queries rescore, drawn from all parts.
Before each query the table is dropped from the page cache, then it stays there; in turns rows are
read one after another, and as an index reads them (`RowReader.read_all`, which requests them at
once from a slow disk). Latencies are those of a query's rows, and a ratio to the first way.
"""

import argparse
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from made_table import write_rows
from page_cache import drop_from_cache

from pipeline.core.arrays import Floats, Ints
from pipeline.features.row_reader import RowReader

Query = list[tuple[int, Ints]]
"Numbers of parts, and rows of each, ascending."


def write_table(table: Path, parts: int, rows: int, dimension: int) -> None:
    """Parts of random vectors."""
    rng = np.random.default_rng(0)
    block: Floats = rng.standard_normal((rows, dimension), np.float32)
    for number in range(parts):
        vectors_ND = np.roll(block, number, axis=0)
        write_rows(table, "gallery", "satellite", number, vectors_ND, number * rows)


def draw_queries(count: int, candidates: int, parts: int, rows: int) -> list[Query]:
    rng = np.random.default_rng(1)
    queries = []
    for _ in range(count):
        part_C = np.sort(rng.integers(0, parts, candidates))
        row_C = rng.integers(0, rows, candidates)
        queries.append([(int(part), np.sort(row_C[part_C == part])) for part in np.unique(part_C)])
    return queries


def name_of(part: int) -> str:
    return f"gallery-satellite-{part:06d}.parquet"


def time_query(reader: RowReader, query: Query, at_once: bool) -> float:
    """Milliseconds until the rows of a query are there."""
    wanted = [(name_of(part), str(part), rows) for part, rows in query]
    begin = time.perf_counter()
    if at_once:
        reader.read_all(wanted)
    else:
        for one in wanted:
            reader.read(*one)
    return 1000 * (time.perf_counter() - begin)


def print_row(name: str, times_ms: Sequence[float], baseline: float) -> float:
    p50, p99 = np.percentile(times_ms, [50, 99])
    print(f"| {name} | {p50:.2f} | {p99:.2f} | {p50 / (baseline or p50):.3f} x |", flush=True)
    return float(p50)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--dimension", type=int, default=1024)
    parser.add_argument("--parts", type=int, default=100)
    parser.add_argument("--queries", type=int, default=400)
    parser.add_argument("--candidates", type=int, default=20)
    parser.add_argument("--folder", type=Path, help="where the table is written for a while")
    options = parser.parse_args()
    rows = max(1, options.rows // options.parts)
    with tempfile.TemporaryDirectory(dir=options.folder) as scratch:
        table = Path(scratch)
        write_table(table, options.parts, rows, options.dimension)
        reader = RowReader(scratch, options.dimension)
        for part in range(options.parts):  # opened, which reads the heads of its pages
            reader.read(name_of(part), str(part), np.zeros(0, np.int64))
        queries = draw_queries(options.queries, options.candidates, options.parts, rows)
        cold: dict[bool, list[float]] = {False: [], True: []}
        warm: dict[bool, list[float]] = {False: [], True: []}
        for number, query in enumerate(queries):
            at_once = bool(number % 2)
            drop_from_cache(scratch)  # a read brings in much around it
            cold[at_once].append(time_query(reader, query, at_once))
        for number, query in enumerate(queries):  # the first time to fill the cache
            time_query(reader, query, True)
            at_once = bool(number % 2)
            warm[at_once].append(time_query(reader, query, at_once))
        print(
            f"{options.parts} parts of {rows:,} rows of {options.dimension} numbers; "
            f"{options.candidates} rows a query"
        )
        print("| rows | p50, ms | p99, ms | x the first way's p50 |\n|---|---|---|---|")
        baseline = print_row("cold, one after another", cold[False], 0)
        print_row("cold, as an index reads", cold[True], baseline)
        print_row("warm, one after another", warm[False], baseline)
        print_row("warm, as an index reads", warm[True], baseline)


if __name__ == "__main__":
    main()
