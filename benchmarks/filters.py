"""Recall and speed of filtered searches over the share of the rows that the filter leaves.

For each share a box of the map that holds so many rows; exact search over the same rows is the
truth. Prints one line per share and index: recall@10, queries/s, and these as a ratio to the search
without a filter in the same run. `--table` takes a table of `index.py` or `embeddings.py`.
"""

import argparse
import os
import tempfile
import time
from pathlib import Path

import faiss
import numpy as np
from index import make_table

from pipeline.core.filters import Filter
from pipeline.core.geo import Box
from pipeline.core.records import Split
from pipeline.features.table import open_table
from pipeline.index.build import build_index
from pipeline.index.searcher import Index
from pipeline.index.settings import IndexSettings

SELECTIVITIES = [1e-5, 1e-4, 1e-3, 1e-2, 0.03, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0]
HEADINGS = ("share of the rows", "rows", "index", "recall@10", "queries/s", "over no filter")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    add = parser.add_argument
    add("--rows", type=int, default=200_000)
    add("--dimension", type=int, default=512)
    add("--target-recall", type=float, default=0.95)
    add("--rounds", type=int, default=3)
    add("--table", help="feature table: used if it exists, written otherwise")
    add("--selectivities", type=float, nargs="*", default=SELECTIVITIES)
    add("--factories", nargs="*", default=["IVF1024,SQ8", "IVF1024,RaBitQ+table", "HNSW32,SQ8"])
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(args.table or f"{scratch}/table")
        if not any(folder.glob("*.parquet")):
            make_table(folder, args.rows, args.dimension)
        table = open_table(str(folder))
        gallery, queries_QD = table.select(Split.GALLERY), table.select(Split.QUERY).embeddings()
        queries_QD = queries_QD.astype(np.float32)
        labels, rows = gallery.labels(), gallery.rows
        vectors_ND = gallery.embeddings().astype(np.float32)
        faiss.omp_set_num_threads(os.cpu_count() or 1)
        print(f"{rows:,} x {table.dimension}, target {args.target_recall}, {os.cpu_count()} cores")
        print(f"| {' | '.join(HEADINGS)} |\n|{'---|' * len(HEADINGS)}", flush=True)
        order_N = np.lexsort((labels.lats, labels.lons))
        indexes = {}
        for number, factory in enumerate(args.factories):
            out = f"{scratch}/index-{number}"
            settings = IndexSettings(
                table=str(folder),
                out=out,
                split=Split.GALLERY,
                target_recall=args.target_recall,
                factory=factory.removesuffix("+table"),
                refine=factory.endswith("+table"),
            )
            build_index(settings)
            indexes[factory] = Index(out)
        unfiltered: dict[str, float] = {}
        for share in sorted(args.selectivities, reverse=True):
            wanted = max(1, round(share * rows))
            last = order_N[wanted - 1]
            east, north, west = float(labels.lons[last]), 90.0, -180.0
            if np.count_nonzero(labels.lons <= east) > 2 * wanted:  # many rows of one longitude
                west, north = east, float(labels.lats[last])
            box = Box(south=-90, north=north, west=west, east=east)
            inside_N = (labels.lons >= west) & (labels.lons <= east) & (labels.lats <= north)
            row_M = np.flatnonzero(inside_N)
            flat = faiss.IndexFlatIP(table.dimension)
            flat.add(vectors_ND[row_M])
            k = min(10, len(row_M))
            exact_QK = row_M[flat.search(queries_QD, k)[1]]
            where = None if share >= 1 else Filter(box=box)
            for factory, index in indexes.items():
                times = []
                for _ in range(args.rounds):
                    start = time.perf_counter()
                    found_QK = index.search_rows(queries_QD, k, where)[1]
                    times.append(time.perf_counter() - start)
                pairs = zip(exact_QK.tolist(), found_QK.tolist(), strict=True)
                recall = np.mean([len({*a} & {*b}) / k for a, b in pairs])
                rate = len(queries_QD) / float(np.median(times))
                ratio = rate / unfiltered.setdefault(factory, rate)
                cells = (
                    f"{share:g}", f"{len(row_M):,}", factory.replace("+", " + "),
                    f"{recall:.4f}", f"{rate:,.0f}", f"{ratio:.2f} x",
                )  # fmt: skip
                print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
