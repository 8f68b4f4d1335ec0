"""Recall, queries/s, p99 and bytes a row of indexes, as a ratio to exact search in one run; with
the time and memory to build each.

Prints one line per index: `planned` is the planner's, `former` that of the rule by rows and memory
before plans were tried, any other word a FAISS factory string. The stage builds each in a separate
process, whose memory is sampled; then the index and exact search in memory answer the same queries,
alternating. `--table` keeps the synthetic vectors for the next call, or takes the embeddings of a
network (`benchmarks/embeddings.py`); with `--out` a killed run resumes its builds.
"""

import argparse
import multiprocessing
import os
import tempfile
import threading
import time
from dataclasses import dataclass
from itertools import islice
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import faiss
import numpy as np
from made_table import make_table
from page_cache import drop_from_cache

from pipeline.core.arrays import Floats
from pipeline.core.records import Split
from pipeline.features.table import open_table
from pipeline.index.build import build_index
from pipeline.index.metadata import METADATA_FILE
from pipeline.index.searcher import Index
from pipeline.index.settings import IndexSettings
from pipeline.index.train import SPECTRUM_ROWS, effective_dimension, sample_rows
from pipeline.index.tuning.ground_truth import exact_search
from pipeline.index.tuning.recall import measure_speed, share_found
from pipeline.index.workspace import rows_by_part

BLOCK_ROWS = 8_192
FLAT_ROWS = 131_072
"Rows of the exact search in memory; its time is scaled to all rows, which it is linear in."
PLANNED, FORMER = "planned", "former"
FORMER_EXACT_ROWS, FORMER_GRAPH_ROWS = 100_000, 500_000
HEADINGS = (
    "index",
    "recall@10",
    "queries/s",
    "single p50, p99 ms",
    "the same, cold",
    "bytes a row",
    "over exact search",
    "breadth, candidates, ratio",
    "built in, training",
    "memory while building",
    "with mapped files",
    "memory to search",
)


def memory_of(kind: str) -> int:
    """Memory of this process in bytes, by a field of /proc/self/status.

    RssAnon excludes mapped files, whose pages the system can drop; VmHWM is the peak of all.
    """
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(status[kind].split()[0]) * 1024


def build(settings: IndexSettings, answer: Connection) -> None:
    """Build an index; send its metadata, the peak of RssAnon, and VmHWM."""
    peak, done = 0, threading.Event()

    def sample() -> None:
        nonlocal peak
        while not done.wait(0.02):
            peak = max(peak, memory_of("RssAnon"))

    sampler = threading.Thread(target=sample)
    sampler.start()
    try:
        metadata = build_index(settings)
    finally:
        done.set()
        sampler.join()
    answer.send((metadata, peak, memory_of("VmHWM")))


def in_a_process(target: Any, *arguments: Any) -> Any:
    """Call `target` with a connection as its last argument in a new process; what it sends."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=target, args=(*arguments, theirs))
    process.start()
    theirs.close()
    try:
        return ours.recv()
    finally:
        process.join()


@dataclass(frozen=True, kw_only=True)
class Queries:
    """What every index answers."""

    queries_QD: Floats
    exact_QK: Any
    """Rows of the ten best of the whole gallery, by exact search."""
    flat_ND: Floats
    """The gallery's first rows, for the exact search that is timed."""
    rounds: int
    cpu: bool
    """Whether times are CPU seconds of one thread."""
    cold: int
    """How many of them are also answered one by one, each after the table and the index were
    dropped from the page cache."""


def cold_latency(index: Index, folders: tuple[str, str], queries_QD: Floats) -> tuple[float, float]:
    """Milliseconds, p50 and p99, of single queries that find nothing of the folders in the page
    cache, each its pages for the first time, whose checksums it compares.
    """
    times = []
    for query_1D in np.split(queries_QD, len(queries_QD)):
        drop_from_cache(*folders)
        start = time.perf_counter()
        index.search_rows(query_1D, 10)
        times.append(1e3 * (time.perf_counter() - start))
    p50, p99 = np.quantile(times, [0.5, 0.99])
    return float(p50), float(p99)


def search(table: str, path: str, given: Queries, scale: float, answer: Connection) -> None:
    """Send recall@10, queries per second, their ratio to exact search, the memory to search, and
    p50 and p99 of single queries, warm and cold.

    `scale` is the number of rows of the index over those of the exact search.
    """
    before = memory_of("RssAnon")
    clock = time.process_time if given.cpu else time.perf_counter
    index = Index(path, threads=1 if given.cpu else None)
    index.search(given.queries_QD[:4])
    memory = memory_of("RssAnon") - before
    cold = (float("nan"),) * 2
    if given.cold:
        cold = cold_latency(index, (table, path), given.queries_QD[: given.cold])
    flat = faiss.IndexFlatIP(given.flat_ND.shape[1])
    flat.add(given.flat_ND)
    ours, exact = [], []
    for _ in range(given.rounds):
        start = clock()
        found = index.search_rows(given.queries_QD, 10)[1]
        ours.append(clock() - start)
        start = clock()
        flat.search(given.queries_QD, 10)
        exact.append((clock() - start) * scale)
    recall = share_found(given.exact_QK, found)
    ratio = np.median([one / other for one, other in zip(exact, ours, strict=True)])
    rate = len(given.queries_QD) / float(np.median(ours))
    speed = measure_speed(index.search_rows, given.queries_QD, 1, 1.0, clock)
    warm = speed["p50_ms"], speed["p99_ms"]
    answer.send((recall, rate, float(ratio), memory, warm, cold))


def former_plan(rows: int, dimension: int, effective: int) -> str:
    """The factory that the former rule took, where the memory was no limit; +table: refined."""
    lists = 2 ** round(np.log2(2 * np.sqrt(rows)))
    if rows <= FORMER_EXACT_ROWS:
        return "Flat"
    if effective <= dimension // 2:
        return f"PCA{effective},IVF{lists},SQ8+table"
    if rows <= FORMER_GRAPH_ROWS:
        return "HNSW32,SQ8"
    return f"IVF{lists},PQ{dimension // 8}x4fs+table"


def report(table: str, out: str, factory: str, args: argparse.Namespace, given: Queries) -> None:
    """Build one index, search it, and print its line."""
    said = {PLANNED: "the planner", FORMER: "the former rule"}.get(factory, "")
    if factory == FORMER:
        factory = args.former
    name, refined = factory.removesuffix("+table"), factory.endswith("+table")
    settings = IndexSettings(
        table=table,
        out=out,
        split=Split.GALLERY,
        memory_budget=args.memory_budget,
        target_recall=args.target_recall,
        factory=None if name == PLANNED else name,
        refine=refined,
    )
    kept, start = Path(out, METADATA_FILE).exists(), time.perf_counter()
    metadata, anonymous, resident = in_a_process(build, settings)
    seconds = metadata.build_seconds if kept else time.perf_counter() - start
    scale = metadata.rows / len(given.flat_ND)
    recall, rate, ratio, memory, warm, cold = in_a_process(search, table, out, given, scale)
    label = metadata.factory
    label += " + table" * (metadata.refine == "table") + " on disk" * metadata.on_disk
    params = metadata.search_params
    cells = [
        label + f" ({said})" * bool(said),
        f"{recall:.4f}",
        f"{rate:,.0f}",
        *(f"{p50:.2f}, {p99:.2f}" for p50, p99 in (warm, cold)),
        f"{metadata.bytes_per_vector:,.0f}",
        f"{ratio:.1f} x",
        f"{params.nprobe_or_ef}, {params.rerank_factor}, {params.list_ratio}",
        f"{seconds:.0f}, {metadata.measured.get('training_seconds', 0):.0f} s",
        *("kept" if kept else f"{peak / 1e9:.2f} GB" for peak in (anonymous, resident)),
        f"{memory / 1e9:.2f} GB",
    ]
    for rejected, why in metadata.measured["rejected"].items():
        print(f"rejected {rejected}: {why}")
    print(f"| {' | '.join(cells)} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    add = parser.add_argument
    add("--rows", type=int, default=200_000)
    add("--dimension", type=int, default=2048)
    add("--memory-budget", default="4GB")
    add("--target-recall", type=float, default=0.95)
    add("--rounds", type=int, default=7, help="alternating rounds of search")
    add("--cpu", action="store_true", help="CPU seconds of one thread: on a machine that is shared")
    add("--out", help="folder where the indexes are kept, and taken from the next time")
    add("--cold", type=int, default=0, help="single queries from a cold disk; 0: none")
    add("--table", help="feature table: used if it exists, written otherwise")
    factories = [PLANNED, FORMER, "IVF1024,SQ8", "IVF1024,RaBitQ+table"]
    add(
        "--factories",
        nargs="*",
        default=factories,
        help="FAISS factory strings; +table: candidates are scored again by the table",
    )
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(args.table or f"{scratch}/table")
        if not any(folder.glob("*.parquet")):
            start = time.perf_counter()
            make_table(folder, args.rows, args.dimension)
            print(f"wrote {args.rows:,} x {args.dimension} in {time.perf_counter() - start:.0f} s")
        table = open_table(str(folder))
        gallery, queries_QD = table.select(Split.GALLERY), table.select(Split.QUERY).embeddings()
        faiss.omp_set_num_threads(os.cpu_count() or 1)
        exact_QK = exact_search(queries_QD, gallery, 10)
        counts = rows_by_part(gallery)
        _, sample_SD = sample_rows(gallery, counts, SPECTRUM_ROWS)
        args.former = former_plan(gallery.rows, table.dimension, effective_dimension(sample_SD))
        blocks = islice(gallery.blocks(BLOCK_ROWS), FLAT_ROWS // BLOCK_ROWS)
        given = Queries(
            queries_QD=queries_QD,
            exact_QK=exact_QK,
            flat_ND=np.concatenate(list(blocks)),
            rounds=args.rounds,
            cpu=args.cpu,
            cold=args.cold,
        )
        print(
            f"{gallery.rows:,} x {table.dimension} in {table.dtype}, budget {args.memory_budget}, "
            f"{len(queries_QD)} queries, exact search timed on {len(given.flat_ND):,} rows, "
            f"{os.cpu_count()} cores{', CPU seconds of one thread' * args.cpu}"
        )
        print(f"| {' | '.join(HEADINGS)} |\n|{'---|' * len(HEADINGS)}", flush=True)
        for number, factory in enumerate(args.factories):
            report(str(folder), f"{args.out or scratch}/index-{number}", factory, args, given)


if __name__ == "__main__":
    main()
