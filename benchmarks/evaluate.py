"""Exact ranking at University-1652's size, as a ratio to the matrix products that it consists of.

Prints one line per figure: seconds, and the ratio to the float32 products of the same blocks in the
same run. `--large` ranks a gallery of University160k's size, streamed from a table on disk, and
prints by how much memory grew.
"""

import argparse
import multiprocessing
import resource
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from pipeline.core.arrays import Floats, Ints
from pipeline.features.part import PartFooter, PartRows, write_part
from pipeline.features.table import open_table
from pipeline.retrieval.embedding_set import (
    EmbeddingSet,
    embedding_set_from_array,
    embedding_set_from_table,
)
from pipeline.retrieval.ranking import BlockSizes, rank

DIMENSION = 2048
TASKS = {"drone->satellite": (701, 54, 951, 1), "satellite->drone": (701, 1, 951, 54)}
LARGE_GALLERY = 168_437
"University-1652's 951 satellite images and University160k's 167,486 distractors."
PART_ROWS = 8_192
ROUNDS = 3
"Alternating rounds, of which the best counts: other work on the machine slows some of them."


def made_vectors(label_Q: Ints, centres_LD: Floats, seed: int, noise: float = 3) -> Floats:
    """Unit vectors around the centre of each label: cosines near 0.1 for true matches, else 0."""
    vectors_QD = np.random.default_rng(seed).standard_normal(
        (len(label_Q), DIMENSION), dtype=np.float32
    )
    vectors_QD *= noise
    vectors_QD += centres_LD[label_Q]
    vectors_QD /= np.linalg.norm(vectors_QD, axis=1, keepdims=True)
    return vectors_QD


def made_side(locations: int, each: int, centres_LD: Floats, seed: int) -> EmbeddingSet:
    """`each` vectors of each of the first `locations` locations."""
    label_Q: Ints = np.repeat(np.arange(locations), each)
    keys, names = np.arange(len(label_Q)).astype(np.str_), label_Q.astype(np.str_)
    return embedding_set_from_array(keys, names, made_vectors(label_Q, centres_LD, seed))


def product_seconds(queries: EmbeddingSet, gallery: EmbeddingSet) -> float:
    """Seconds of the bare float32 products of the ranking's blocks, without reading."""
    size = BlockSizes()
    out = np.empty((size.query_rows, size.gallery_rows), np.float32)
    query_blocks = list(queries.blocks(size.query_rows))
    seconds = 0.0
    for gallery_BD in gallery.blocks(size.gallery_rows):
        begin = time.perf_counter()
        for query_QD in query_blocks:
            np.matmul(query_QD, gallery_BD.T, out=out[: len(query_QD), : len(gallery_BD)])
        seconds += time.perf_counter() - begin
    return seconds


def measure(name: str, queries: EmbeddingSet, gallery: EmbeddingSet, rounds: int = ROUNDS) -> None:
    products, totals, ranks_alone = [], [], []
    for _ in range(rounds):
        products.append(product_seconds(queries, gallery))
        begin = time.perf_counter()
        found = rank(queries, gallery)
        middle = time.perf_counter()
        rank(queries, gallery, top=0)
        totals.append(middle - begin)
        ranks_alone.append(time.perf_counter() - middle)
    ratios = ", ".join(
        f"{total / product:.2f}" for total, product in zip(totals, products, strict=True)
    )
    print(
        f"{name} {len(queries.keys)} x {len(gallery.keys)} x {DIMENSION}: {min(totals):.1f} s, "
        f"{min(totals) / min(products):.2f} x the float32 products (round by round {ratios}), "
        f"without the ten best rows {min(ranks_alone) / min(products):.2f} x "
        f"(R@1 {np.mean(found.first_rank_Q == 1):.3f})",
        flush=True,
    )


def write_tables(folder: str, query_rows: int, gallery_rows: int) -> None:
    """54 queries per location, and a gallery whose first 951 rows show the locations."""
    centres_LD = np.random.default_rng(0).standard_normal((951, DIMENSION), dtype=np.float32)
    around_LD = np.concatenate([centres_LD, np.zeros((1, DIMENSION), np.float32)])
    for split, view, rows, each in (
        ("query", "drone", query_rows, 54),
        ("gallery", "satellite", gallery_rows, 1),
    ):
        for first in range(0, rows, PART_ROWS):
            label = np.arange(first, min(first + PART_ROWS, rows)) // each
            count = len(label)
            write_part(
                f"{folder}/{split}/{first:07d}.parquet",
                PartRows(
                    keys=[f"{split}-{first + i}" for i in range(count)],
                    locations=[f"{i:06d}" for i in label],
                    views=[view] * count,
                    splits=[split] * count,
                    lats=[None] * count,
                    lons=[None] * count,
                    embeddings_BD=made_vectors(
                        np.minimum(label, len(centres_LD)), around_LD, first + each
                    ),
                ),
                PartFooter(fingerprint="f", shard_sha256=f"{first}", rows=count),
            )


class Interleaved:
    """A gallery that times the bare product of each block right after the block was ranked.

    On a machine with other work, products measured minutes before or after the ranking are no
    baseline.
    """

    def __init__(self, queries: EmbeddingSet, gallery: EmbeddingSet) -> None:
        self._gallery, self.seconds = gallery, 0.0
        self._query_blocks = list(queries.blocks(BlockSizes().query_rows))
        self._out = np.empty((BlockSizes().query_rows, BlockSizes().gallery_rows), np.float32)
        self._recent: dict[int, Floats] = {}
        self._done = 0
        self.side = replace(gallery, blocks=self._blocks)

    def _blocks(self, rows: int) -> Iterator[Floats]:
        """The ranking reads all blocks twice, the first time for the true matches alone."""
        for number, gallery_BD in enumerate(self._gallery.blocks(rows)):
            self._recent[number] = gallery_BD
            self._recent.pop(number - 3, None)  # the ranking prefetches one block
            yield gallery_BD

    def advance(self, scores: int) -> None:
        """Called when the ranking has done a block of queries x gallery."""
        number, part = divmod(self._done, len(self._query_blocks))
        query_QD, gallery_BD = self._query_blocks[part], self._recent[number]
        assert scores == len(query_QD) * len(gallery_BD)
        begin = time.perf_counter()
        np.matmul(query_QD, gallery_BD.T, out=self._out[: len(query_QD), : len(gallery_BD)])
        self.seconds += time.perf_counter() - begin
        self._done += 1


def large(scale: float) -> None:
    """Rank queries and a gallery in tables on disk."""
    gallery_rows, query_rows = int(LARGE_GALLERY * scale), int(701 * scale) * 54
    with tempfile.TemporaryDirectory() as folder:
        # In a separate process: the memory of writing the tables must not count as the ranking's.
        maker = multiprocessing.get_context("spawn").Process(
            target=write_tables, args=(folder, query_rows, gallery_rows)
        )
        maker.start()
        maker.join()
        queries, gallery = (
            embedding_set_from_table(open_table(f"{folder}/{split}"))
            for split in ("query", "gallery")
        )
        timed = Interleaved(queries, gallery)
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        begin = time.perf_counter()
        rank(queries, timed.side, advance=timed.advance)
        total = time.perf_counter() - begin - timed.seconds
        grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 2**20
        print(
            f"streamed {query_rows} x {gallery_rows} x {DIMENSION}: {total:.1f} s, "
            f"{total / timed.seconds:.2f} x the float32 products ({timed.seconds:.1f} s, block by "
            f"block between the ranking), reading twice included; memory grew by {grown:.2f} GiB",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scale", type=float, default=1.0, help="fraction of locations to rank")
    parser.add_argument(
        "--large", action="store_true", help="a gallery of 168,437 images from disk; takes minutes"
    )
    args = parser.parse_args()
    scale: float = args.scale
    if args.large:
        large(scale)
        return
    centres_LD = np.random.default_rng(0).standard_normal((951, DIMENSION), dtype=np.float32)
    for task, (queried, queries_each, shown, gallery_each) in TASKS.items():
        queries = made_side(int(queried * scale), queries_each, centres_LD, 1)
        gallery = made_side(int(shown * scale), gallery_each, centres_LD, 2)
        measure(task, queries, gallery)


if __name__ == "__main__":
    main()
