"""What an index of a million embeddings costs and gives: build time, memory, size, recall, and
speed against exact search.

Prints one line per index. Each is built by the stage itself in a process of its own, whose memory
is watched; then it and exact search in memory answer the same queries in turn. `--table` keeps the
vectors for the next call; `--embeddings` of a trained network (see `embeddings.py` beside this
file) take the place of made-up clusters.
"""

import argparse
import multiprocessing
import os
import tempfile
import threading
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import faiss
import numpy as np

from pipeline.core.records import Split
from pipeline.features.table import Floats, PartFooter, PartRows, open_table, write_part
from pipeline.index.build import build_index
from pipeline.index.recall import RECALL_QUERIES, exact_search
from pipeline.index.searcher import Index
from pipeline.index.settings import IndexSettings

PART_ROWS = 16_384
IMAGES_OF_PLACE = 20
KINDS = 500  # of places: towns, woods, fields
FLAT_ROWS = 131_072  # searched exactly in memory; the time of a product grows with its rows
ROUNDS = 7
PLANNED = "planned"
HEADINGS = (
    "index",
    "built in",
    "memory while building",
    "with mapped files",
    "bytes a vector",
    "memory to search",
    "recall@10",
    "breadth, candidates",
    "queries/s",
    "over exact search",
)


def made_vectors(first: int, count: int, dimension: int, seed: int) -> Floats:
    """Unit vectors of rows first .. first + count: images of places (cosines near 0.5), places of
    kinds (0.2).
    """
    kinds_KD = np.random.default_rng(0).standard_normal((KINDS, dimension), dtype=np.float32)
    place_N = (np.arange(first, first + count) // IMAGES_OF_PLACE).astype(np.int64)
    places, inverse_N = np.unique(place_N, return_inverse=True)
    own_PD = np.stack(
        [
            np.random.default_rng([1, int(p)]).standard_normal(dimension, dtype=np.float32)
            for p in places
        ]
    )
    own_PD = 0.8 * own_PD + 0.65 * kinds_KD[places % KINDS]
    vectors_ND = own_PD[inverse_N]
    vectors_ND += np.random.default_rng([2, seed, first]).standard_normal(
        vectors_ND.shape, dtype=np.float32
    )
    vectors_ND /= np.linalg.norm(vectors_ND, axis=1, keepdims=True)
    return vectors_ND


def write_rows(
    folder: Path, split: str, view: str, number: int, vectors_ND: Floats, first: int
) -> None:
    count = len(vectors_ND)
    rows = PartRows(
        keys=[f"{split}-{view}-{first + i:09d}" for i in range(count)],
        locations=[f"{(first + i) // IMAGES_OF_PLACE:07d}" for i in range(count)],
        views=[view] * count,
        splits=[split] * count,
        lats=[(first + i) % 1000 / 1e4 for i in range(count)],
        lons=[(first + i) // 1000 / 1e4 for i in range(count)],
        embeddings_BD=vectors_ND,
    )
    footer = PartFooter(fingerprint="f" * 64, shard_sha256=f"{number}", rows=count)
    write_part(str(folder / f"{split}-{view}-{number:06d}.parquet"), rows, footer, "float16")


def make_table(folder: Path, rows: int, dimension: int) -> None:
    """A gallery of `rows` images in places of twenty, and HELD_QUERIES other images of its places,
    in float16.
    """
    for number, first in enumerate(range(0, rows, PART_ROWS)):
        count = min(PART_ROWS, rows - first)
        write_rows(
            folder, "gallery", "satellite", number, made_vectors(first, count, dimension, 0), first
        )
    spread = np.linspace(0, rows - 1, RECALL_QUERIES).astype(int)
    queries = np.concatenate([made_vectors(int(first), 1, dimension, 1) for first in spread])
    write_rows(folder, "query", "drone", 0, queries, 0)


def memory_of(kind: str) -> int:
    """Bytes of this process: RssAnon, without the files that it maps, which the system takes back;
    VmHWM, the most so far.
    """
    said = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(said[kind].split()[0]) * 1024


def built(settings: IndexSettings, answer: Connection) -> None:
    """Build an index, and say its facts and the most memory it took."""
    peak, done = 0, threading.Event()

    def watch() -> None:
        nonlocal peak
        while not done.wait(0.02):
            peak = max(peak, memory_of("RssAnon"))

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        facts = build_index(settings)
    finally:
        done.set()
        watcher.join()
    answer.send((facts, peak, memory_of("VmHWM")))


def in_a_process(target: Any, *arguments: Any) -> Any:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=target, args=(*arguments, theirs))
    process.start()
    theirs.close()
    try:
        return ours.recv()
    finally:
        process.join()


def searched(
    path: str, queries_QD: Floats, flat_QD: Floats, scale: float, exact_QK: Any, answer: Connection
) -> None:
    """Recall, queries a second and their ratio to exact search, which answers in turn; and the
    memory that searching takes.
    """
    before = memory_of("RssAnon")
    index = Index(path)
    index.search(queries_QD[:4])
    memory = memory_of("RssAnon") - before
    flat = faiss.IndexFlatIP(flat_QD.shape[1])
    flat.add(flat_QD)
    ours, exact = [], []
    for _ in range(ROUNDS):
        start = time.perf_counter()
        found = index.search_rows(queries_QD, 10)[1]
        ours.append(time.perf_counter() - start)
        start = time.perf_counter()
        flat.search(queries_QD, 10)
        exact.append((time.perf_counter() - start) * scale)
    at_10 = np.mean(
        [len({*a} & {*b}) / 10 for a, b in zip(exact_QK.tolist(), found.tolist(), strict=True)]
    )
    ratio = np.median([one / other for one, other in zip(exact, ours, strict=True)])
    answer.send((float(at_10), len(queries_QD) / float(np.median(ours)), float(ratio), memory))


def report(
    table: str, out: str, factory: str, asked: argparse.Namespace, held: tuple[Floats, Any, Floats]
) -> None:
    """Build one index, let it answer, and print its line."""
    name, refined = factory.removesuffix("+table"), factory.endswith("+table")
    settings = IndexSettings(
        table=table,
        out=out,
        split=Split.GALLERY,
        memory_budget=asked.memory_budget,
        target_recall=asked.target_recall,
        factory=None if name == PLANNED else name,
        refine=refined,
    )
    start = time.perf_counter()
    facts, anonymous, resident = in_a_process(built, settings)
    total = time.perf_counter() - start
    queries_QD, exact_QK, flat_QD = held
    at_10, speed, ratio, memory = in_a_process(
        searched, out, queries_QD, flat_QD, facts["rows"] / len(flat_QD), exact_QK
    )
    said = (
        facts["factory"] + " + table" * (facts["refine"] == "table") + " on disk" * facts["on_disk"]
    )
    cells = [
        said + " (the planner)" * (name == PLANNED),
        f"{total:.0f} s",
        f"{anonymous / 1e9:.2f} GB",
        f"{resident / 1e9:.2f} GB",
        f"{facts['bytes_per_vector']:,.0f}",
        f"{memory / 1e9:.2f} GB",
        f"{at_10:.4f}",
        f"{facts['effort']['breadth']}, {facts['effort']['candidates']}",
        f"{speed:,.0f}",
        f"{ratio:.1f} x",
    ]
    print(f"| {' | '.join(cells)} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=200_000)
    parser.add_argument("--dimension", type=int, default=2048)
    parser.add_argument("--memory-budget", default="4GB")
    parser.add_argument("--target-recall", type=float, default=0.95)
    parser.add_argument(
        "--table", help="feature table: used where it is there, made there otherwise"
    )
    parser.add_argument(
        "--factories",
        nargs="*",
        default=[PLANNED, "IVF1024,SQ8", "IVF1024,RaBitQ+table"],
        help="FAISS factory strings; +table: candidates are scored again by the table",
    )
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(arguments.table or f"{scratch}/table")
        if not any(folder.glob("*.parquet")):
            start = time.perf_counter()
            make_table(folder, arguments.rows, arguments.dimension)
            print(
                f"made {arguments.rows:,} x {arguments.dimension} in {time.perf_counter() - start:.0f} s"
            )
        table = open_table(str(folder))
        gallery, queries_QD = table.select(Split.GALLERY), table.select(Split.QUERY).embeddings()
        faiss.omp_set_num_threads(os.cpu_count() or 1)
        exact_QK = exact_search(queries_QD, gallery, 10)
        flat_QD = np.concatenate(
            [
                block
                for _, block in zip(range(FLAT_ROWS // 8192), gallery.blocks(8192), strict=False)
            ]
        )
        print(
            f"{gallery.rows:,} x {table.dimension} in {table.dtype}, budget {arguments.memory_budget}, "
            f"{len(queries_QD)} queries, exact search timed on {len(flat_QD):,} rows, {os.cpu_count()} cores"
        )
        print(f"| {' | '.join(HEADINGS)} |\n|{'---|' * len(HEADINGS)}", flush=True)
        for number, factory in enumerate(arguments.factories):
            report(
                str(folder),
                f"{scratch}/index-{number}",
                factory,
                arguments,
                (queries_QD, exact_QK, flat_QD),
            )


if __name__ == "__main__":
    main()
