"""Graphs of scalable-vs beside indexes of FAISS, over the same rows in one run.

Prints one line per index: recall@10, queries/s as a ratio to the first one's, single queries, bytes
a row and seconds to build, each with the least effort that reaches the target. scalable-vs is no
dependency (docs/decisions.md): without it, or on a CPU that its compressed vectors refuse, its
lines say so. `--table` takes the embeddings of a network (`benchmarks/embeddings.py`).
"""

import argparse
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Any

import faiss
import numpy as np
from made_table import make_table

from pipeline.core.arrays import Floats, Ints
from pipeline.core.records import Split
from pipeline.features.table import open_table
from pipeline.index.faiss_io import faiss_parameters
from pipeline.index.train import new_index, train_index
from pipeline.index.tuning.ground_truth import NEIGHBOURS
from pipeline.index.tuning.recall import measure_speed, share_found

BLOCK_ROWS = 1_024
EFFORTS = (1, 2, 4, 8, 10, 16, 24, 32, 48, 64, 96, 128, 256)
"nprobe of lists, efSearch or search window of graphs."
DEGREE, WINDOW = 64, 128
"Of the Vamana graph: edges a row, and candidates while it is built."
LEANVEC_DIMENSION = 256
SVS_STORES = ("LVQ8", "LVQ4x4", "LeanVec4x8")
HEADINGS = (
    "index", "recall@10", "queries/s", "over the first", "single p50, p99 ms", "bytes a row",
    "built in", "effort",
)  # fmt: skip


@dataclass(kw_only=True)
class Tried:
    """An index with the effort that it needs, and its speed by round."""

    name: str
    search: Callable[[Floats], Ints]
    recall: float
    effort: int
    bytes_per_row: float
    seconds: float
    speeds: list[dict[str, float]] = field(default_factory=list)


def least_effort(
    search: Callable[[int, Floats], Ints], exact_QK: Ints, queries_QD: Floats, target: float
) -> tuple[int, float]:
    """The least effort that reaches the target, or the most, and its recall."""
    for effort in EFFORTS:
        recall = share_found(exact_QK, search(effort, queries_QD))
        if recall >= target:
            break
    return effort, recall


def build_faiss(factory: str, rows_ND: Floats) -> tuple[Callable[[int, Floats], Ints], int]:
    """The search of a FAISS index by its effort, and its bytes."""
    index = new_index(factory, rows_ND.shape[1])
    train_index(index, factory, rows_ND)
    index.add(rows_ND)

    def search(effort: int, queries_QD: Floats) -> Ints:
        params = faiss_parameters(index, effort, None)
        rows_QK: Ints = index.search(queries_QD, NEIGHBOURS, params=params)[1]
        return rows_QK

    return search, len(faiss.serialize_index(index))


def build_svs(svs: Any, store: str, rows_ND: Floats) -> tuple[Callable[[int, Floats], Ints], int]:
    """The same of a Vamana graph of scalable-vs, over vectors compressed as `store` says."""
    dimension = rows_ND.shape[1]
    with tempfile.TemporaryDirectory() as folder:
        svs.write_vecs(rows_ND, f"{folder}/rows.fvecs")
        rows = svs.VectorDataLoader(f"{folder}/rows.fvecs", svs.DataType.float32, dims=dimension)
        four, eight = svs.LeanVecKind.lvq4, svs.LeanVecKind.lvq8
        compressed = {
            "LVQ8": lambda: svs.LVQLoader(rows, primary=8, residual=0),
            "LVQ4x4": lambda: svs.LVQLoader(rows, primary=4, residual=4),
            "LeanVec4x8": lambda: svs.LeanVecLoader(
                rows,
                leanvec_dims=min(LEANVEC_DIMENSION, dimension),
                primary_kind=four,
                secondary_kind=eight,
            ),
        }[store]()
        graph = svs.VamanaBuildParameters(alpha=0.95, graph_max_degree=DEGREE, window_size=WINDOW)
        index = svs.Vamana.build(
            graph, compressed, svs.DistanceType.MIP, num_threads=os.cpu_count() or 1
        )
        index.save(f"{folder}/config", f"{folder}/graph", f"{folder}/data")
        size = sum(
            path.stat().st_size
            for part in ("config", "graph", "data")
            for path in Path(folder, part).rglob("*")
        )

    def search(effort: int, queries_QD: Floats) -> Ints:
        index.search_window_size = max(effort, NEIGHBOURS)
        rows_QK: Ints = index.search(queries_QD, NEIGHBOURS)[0].astype(np.int64)
        return rows_QK

    return search, size


def builders(factories: list[str]) -> Iterator[tuple[str, Callable[[Floats], Any]]]:
    """Names of indexes with what builds each."""
    for factory in factories:
        yield factory, partial(build_faiss, factory)
    try:
        svs = import_module("svs")
    except ModuleNotFoundError:
        print("scalable-vs is not installed, expected for its lines: pip install scalable-vs")
        return
    for store in SVS_STORES:
        yield f"Vamana{DEGREE},{store}", partial(build_svs, svs, store)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    add = parser.add_argument
    add("--table", help="feature table; made vectors by default")
    add("--rows", type=int, default=65_536)
    add("--dimension", type=int, default=512, help="of made vectors")
    add("--target-recall", type=float, default=0.95)
    add("--rounds", type=int, default=5)
    add("--seconds", type=float, default=1.0, help="length of a timing")
    add("--factories", nargs="+", default=["HNSW32,SQ8", "IVF1024,SQ8"])
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = args.table or f"{scratch}/table"
        if not args.table:
            make_table(Path(folder), args.rows, args.dimension)
        table = open_table(folder)
        blocks = table.select(Split.GALLERY).blocks(BLOCK_ROWS)
        some = islice(blocks, -(-args.rows // BLOCK_ROWS))
        rows_ND = np.concatenate(list(some), dtype=np.float32)[: args.rows]
        queries_QD = table.select(Split.QUERY).embeddings()
    exact_QK = faiss.knn(queries_QD, rows_ND, NEIGHBOURS, faiss.METRIC_INNER_PRODUCT)[1]
    found: list[Tried] = []
    for name, build in builders(args.factories):
        begin = time.perf_counter()
        try:
            search, size = build(rows_ND)
        except RuntimeError as error:
            print(f"{name} cannot be built here: {error}")
            continue
        seconds = time.perf_counter() - begin
        effort, recall = least_effort(search, exact_QK, queries_QD, args.target_recall)
        found.append(
            Tried(
                name=name, search=partial(search, effort), recall=recall, effort=effort,
                bytes_per_row=size / len(rows_ND), seconds=seconds,
            )
        )  # fmt: skip
    for _ in range(args.rounds):
        for one in found:
            one.speeds.append(measure_speed(one.search, queries_QD, 1, args.seconds))
    shape = f"{len(rows_ND):,} x {rows_ND.shape[1]}"
    print(f"{shape}, target {args.target_recall}, {os.cpu_count()} cores")
    print(f"| {' | '.join(HEADINGS)} |\n|{'---|' * len(HEADINGS)}")
    first = None
    for one in found:
        rate, p50, p99 = (
            float(np.median([speed[name] for speed in one.speeds]))
            for name in ("queries_per_second", "p50_ms", "p99_ms")
        )
        first = first or rate
        cells = (
            one.name, f"{one.recall:.4f}", f"{rate:,.0f}", f"{rate / first:.2f} x",
            f"{p50:.3f}, {p99:.3f}", f"{one.bytes_per_row:,.0f}", f"{one.seconds:.0f} s",
            f"{one.effort}",
        )  # fmt: skip
        print(f"| {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
