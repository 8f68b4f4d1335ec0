"""Recall and speed of filtered searches over the share of the rows that the filter leaves.

For each share the map is cut into boxes of so many rows, and each query searches the box around its
nearest row, as a photo with a rough position does; with `--boxes one` all search one box, which
most of them show nothing of. Exact search over the same rows is the truth. Prints one line per
share and index: recall@10, queries/s, and these as a ratio to the search without a filter in the
same run. `--table` takes a table of `index.py` or `embeddings.py`, `--kept` indexes of it that
`index.py --out` has built.
"""

import argparse
import os
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import faiss
import numpy as np
from made_table import make_table

from pipeline.core.arrays import Doubles, Floats, Ints
from pipeline.core.filters import Filter
from pipeline.core.geo import Box
from pipeline.core.prefetch import prefetch
from pipeline.core.records import Split
from pipeline.features.table import FeatureTable, open_table
from pipeline.index.build import build_index
from pipeline.index.part import NO_ROW
from pipeline.index.searcher import Index
from pipeline.index.settings import IndexSettings
from pipeline.index.tuning.ground_truth import NEIGHBOURS, exact_search
from pipeline.index.tuning.recall import share_found

SELECTIVITIES = [1e-5, 1e-4, 1e-3, 1e-2, 0.03, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0]
AROUND, ONE = "around", "one"
HEADINGS = ("share of the rows", "rows", "index", "recall@10", "queries/s", "over no filter")


@dataclass(frozen=True, kw_only=True)
class Boxes:
    """Boxes of the map, each with about the same share of the rows, and each query's."""

    share: float
    box_of_row_N: Ints
    boxes: list[Box]
    box_of_query_Q: Ints


def boxes_of_share(share: float, lats_N: Doubles, lons_N: Doubles) -> tuple[Ints, list[Box]]:
    """Each row's box, and the boxes: some meridians, or pieces of one where it has many rows."""
    wanted = max(1, round(share * len(lats_N)))
    order_N = np.lexsort((lats_N, lons_N))
    lat_N, lon_N = lats_N[order_N], lons_N[order_N]
    first_M = np.flatnonzero(np.diff(lon_N, prepend=-np.inf))
    count_M = np.diff(first_M, append=len(lon_N))
    if count_M.max() <= wanted:
        starts = first_M[np.flatnonzero(np.diff(first_M // wanted, prepend=-1))]
    else:
        nth_N = np.arange(len(lon_N)) - np.repeat(first_M, count_M)
        starts = np.flatnonzero(nth_N % wanted == 0)
    box_of_row_N = np.empty(len(order_N), np.int64)
    box_of_row_N[order_N] = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(lon_N)))
    edges = zip(
        np.minimum.reduceat(lat_N, starts).tolist(),
        np.maximum.reduceat(lat_N, starts).tolist(),
        np.minimum.reduceat(lon_N, starts).tolist(),
        np.maximum.reduceat(lon_N, starts).tolist(),
        strict=True,
    )
    return box_of_row_N, [
        Box(south=south, north=north, west=west, east=east) for south, north, west, east in edges
    ]


def plan_boxes(
    shares: Sequence[float], lats_N: Doubles, lons_N: Doubles, nearest_Q: Ints, kind: str
) -> list[Boxes]:
    """For each share a box for each query: around its nearest row, or the same for all."""
    planned = []
    for share in shares:
        box_of_row_N, boxes = boxes_of_share(share, lats_N, lons_N)
        around_Q = box_of_row_N[nearest_Q]
        box_of_query_Q = around_Q if kind == AROUND else np.zeros_like(around_Q)
        planned.append(
            Boxes(
                share=share, box_of_row_N=box_of_row_N, boxes=boxes, box_of_query_Q=box_of_query_Q
            )
        )
    return planned


def exact_rows(queries_QD: Floats, gallery: FeatureTable, planned: Sequence[Boxes]) -> list[Ints]:
    """Rows (Q, K) of the nearest in each query's box, from one reading of the gallery; NO_ROW where
    it has fewer."""
    heaps = [faiss.ResultHeap(len(queries_QD), NEIGHBOURS, keep_max=True) for _ in planned]
    first = 0
    for block_BD in prefetch(gallery.blocks(), 1):
        scores_QB = queries_QD @ block_BD.T
        nearest = min(NEIGHBOURS, len(block_BD))
        for one, heap in zip(planned, heaps, strict=True):
            box_B = one.box_of_row_N[first : first + len(block_BD)]
            within_QB = np.where(box_B == one.box_of_query_Q[:, None], scores_QB, -np.inf)
            row_QK = np.argpartition(within_QB, -nearest, axis=1)[:, -nearest:]
            score_QK = np.take_along_axis(within_QB, row_QK, axis=1)
            row_QK = np.where(np.isneginf(score_QK), NO_ROW, row_QK + first)
            heap.add_result(score_QK.astype(np.float32), row_QK)
        first += len(block_BD)
    for heap in heaps:
        heap.finalize()
    return [heap.I for heap in heaps]


def search_in_boxes(index: Index, queries_QD: Floats, one: Boxes) -> Ints:
    """Rows (Q, K) that the index finds for each query in its box."""
    if one.share >= 1:
        return index.search_rows(queries_QD, NEIGHBOURS)[1]
    found_QK = np.empty((len(queries_QD), NEIGHBOURS), np.int64)
    for box in np.unique(one.box_of_query_Q).tolist():
        of_box = one.box_of_query_Q == box
        where = Filter(box=one.boxes[box])
        found_QK[of_box] = index.search_rows(queries_QD[of_box], NEIGHBOURS, where)[1]
    return found_QK


def build(folder: Path, out: str, factory: str, target_recall: float) -> Index:
    settings = IndexSettings(
        table=str(folder),
        out=out,
        split=Split.GALLERY,
        target_recall=target_recall,
        factory=factory.removesuffix("+table"),
        refine=factory.endswith("+table"),
    )
    build_index(settings)
    return Index(out)


def label_of(index: Index) -> str:
    return index.metadata.factory + " + table" * (index.metadata.refine == "table")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    add = parser.add_argument
    add("--rows", type=int, default=200_000)
    add("--dimension", type=int, default=512)
    add("--target-recall", type=float, default=0.95)
    add("--rounds", type=int, default=3)
    add("--table", help="feature table: used if it exists, written otherwise")
    add("--kept", nargs="*", default=[], help="folders of indexes of that table")
    add("--boxes", choices=[AROUND, ONE], default=AROUND, help="each query's, or one for all")
    add("--selectivities", type=float, nargs="*", default=SELECTIVITIES)
    add("--factories", nargs="*", default=["IVF1024,SQ8", "IVF1024,RaBitQ+table", "HNSW32,SQ8"])
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(args.table or f"{scratch}/table")
        if not any(folder.glob("*.parquet")):
            make_table(folder, args.rows, args.dimension)
        table = open_table(str(folder))
        gallery, queries_QD = table.select(Split.GALLERY), table.select(Split.QUERY).embeddings()
        faiss.omp_set_num_threads(os.cpu_count() or 1)
        columns = [rows for _, rows in gallery.numbered_rows(["lat", "lon"])]
        lats_N, lons_N = (
            np.concatenate([rows[name].to_numpy() for rows in columns]) for name in ("lat", "lon")
        )
        nearest_Q = exact_search(queries_QD, gallery, 1)[:, 0]
        shares = sorted(args.selectivities, reverse=True)
        planned = plan_boxes(shares, lats_N, lons_N, nearest_Q, args.boxes)
        exact = exact_rows(queries_QD, gallery, planned)
        indexes = [Index(path) for path in args.kept] + [
            build(folder, f"{scratch}/index-{number}", factory, args.target_recall)
            for number, factory in enumerate(args.factories)
        ]
        print(
            f"{gallery.rows:,} x {table.dimension}, target {args.target_recall}, "
            f"{os.cpu_count()} cores"
        )
        print(f"| {' | '.join(HEADINGS)} |\n|{'---|' * len(HEADINGS)}", flush=True)
        unfiltered: dict[int, float] = {}
        for one, exact_QK in zip(planned, exact, strict=True):
            rows = len(one.box_of_row_N) / len(one.boxes)
            for number, index in enumerate(indexes):
                times = []
                for _ in range(args.rounds):
                    start = time.perf_counter()
                    found_QK = search_in_boxes(index, queries_QD, one)
                    times.append(time.perf_counter() - start)
                rate = len(queries_QD) / float(np.median(times))
                ratio = rate / unfiltered.setdefault(number, rate)
                cells = (
                    f"{one.share:g}", f"{rows:,.0f}", label_of(index),
                    f"{share_found(exact_QK, found_QK):.4f}", f"{rate:,.0f}", f"{ratio:.2f} x",
                )  # fmt: skip
                print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
