"""What exact ranking costs at University-1652's size, as a ratio to the bare matrix products it cannot do without.

Prints one line per figure: seconds, and the ratio to the float32 and the float64 product of the same blocks.
"""

import argparse
import time

import numpy as np
import numpy.typing as npt

from pipeline.features import Floats
from pipeline.metrics import Whole
from pipeline.ranking import Blocks, Side, rank, side_of_array

DIMENSION = 2048
TASKS = {"drone->satellite": (701, 54, 951, 1), "satellite->drone": (701, 1, 951, 54)}


def made_side(locations: int, each: int, centres_LD: Floats, noise: float, seed: int) -> Side:
    """`each` unit vectors round the centre of each of the first `locations` locations."""
    label_Q: Whole = np.repeat(np.arange(locations), each)
    vectors_QD = np.random.default_rng(seed).standard_normal((len(label_Q), DIMENSION), dtype=np.float32)
    vectors_QD = centres_LD[label_Q] + noise * vectors_QD
    vectors_QD /= np.linalg.norm(vectors_QD, axis=1, keepdims=True)
    return side_of_array(np.arange(len(label_Q)).astype(np.str_), label_Q.astype(np.str_), vectors_QD)


def product_seconds(queries: Side, gallery: Side, dtype: npt.DTypeLike) -> float:
    """The bare products of the blocks that the ranking multiplies."""
    cut = Blocks()
    gallery_blocks = [block_BD.astype(dtype).T for block_BD in gallery.blocks(cut.gallery_rows)]
    seconds = 0.0
    for query_QD in (block_QD.astype(dtype) for block_QD in queries.blocks(cut.query_rows)):
        begin = time.perf_counter()
        for gallery_DB in gallery_blocks:
            query_QD @ gallery_DB
        seconds += time.perf_counter() - begin
    return seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scale", type=float, default=1.0, help="share of the locations to rank")
    scale = parser.parse_args().scale
    centres_LD = np.random.default_rng(0).standard_normal((951, DIMENSION), dtype=np.float32)
    for task, (queried, queries_each, shown, gallery_each) in TASKS.items():
        queries = made_side(int(queried * scale), queries_each, centres_LD, 3, 1)
        gallery = made_side(int(shown * scale), gallery_each, centres_LD, 3, 2)
        single, double = (product_seconds(queries, gallery, dtype) for dtype in (np.float32, np.float64))
        begin = time.perf_counter()
        found = rank(queries, gallery)
        seconds = time.perf_counter() - begin
        print(
            f"{task} {len(queries.keys)} x {len(gallery.keys)} x {DIMENSION}: {seconds:.1f} s, {seconds / single:.2f} x the "
            f"float32 products, {seconds / double:.2f} x the float64 products (R@1 {np.mean(found.first_rank_Q == 1):.3f})"
        )


if __name__ == "__main__":
    main()
