"""What exact ranking costs at University-1652's size, as a ratio to the bare matrix products it
cannot do without.

Prints one line per figure: seconds, and the ratio to the float32 products of the same blocks in the
same run. `--large` ranks a gallery of the size of University160k's, streamed from a table on disk,
and says how far memory grew beyond the start.
"""

import argparse
import multiprocessing
import resource
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from pipeline.core.arrays import Ints
from pipeline.features.table import Floats, PartFooter, PartRows, open_table, write_part
from pipeline.retrieval.ranking import Blocks, Side, rank, side_of_array
from pipeline.retrieval.tasks import side_of

DIMENSION = 2048
TASKS = {"drone->satellite": (701, 54, 951, 1), "satellite->drone": (701, 1, 951, 54)}
LARGE_GALLERY = (
    168_437  # University-1652's 951 satellite images and University160k's 167,486 distractors
)
PART_ROWS = 8_192
ROUNDS = 3  # the best of so many, in turn: other work on the machine slows some of them


def made_vectors(label_Q: Ints, centres_LD: Floats, seed: int, noise: float = 3) -> Floats:
    """Unit vectors round the centre of each label; cosines of true matches are near 0.1, of others
    near 0.
    """
    vectors_QD = np.random.default_rng(seed).standard_normal(
        (len(label_Q), DIMENSION), dtype=np.float32
    )
    vectors_QD *= noise
    vectors_QD += centres_LD[label_Q]
    vectors_QD /= np.linalg.norm(vectors_QD, axis=1, keepdims=True)
    return vectors_QD


def made_side(locations: int, each: int, centres_LD: Floats, seed: int) -> Side:
    """`each` vectors of each of the first `locations` locations."""
    label_Q: Ints = np.repeat(np.arange(locations), each)
    keys, names = np.arange(len(label_Q)).astype(np.str_), label_Q.astype(np.str_)
    return side_of_array(keys, names, made_vectors(label_Q, centres_LD, seed))


def product_seconds(queries: Side, gallery: Side) -> float:
    """The bare float32 products of the blocks that the ranking multiplies; reading is not counted."""
    cut = Blocks()
    room = np.empty((cut.query_rows, cut.gallery_rows), np.float32)
    query_blocks = list(queries.blocks(cut.query_rows))
    seconds = 0.0
    for gallery_BD in gallery.blocks(cut.gallery_rows):
        begin = time.perf_counter()
        for query_QD in query_blocks:
            np.matmul(query_QD, gallery_BD.T, out=room[: len(query_QD), : len(gallery_BD)])
        seconds += time.perf_counter() - begin
    return seconds


def measure(name: str, queries: Side, gallery: Side, rounds: int = ROUNDS) -> None:
    products, totals = [], []
    for _ in range(rounds):
        products.append(product_seconds(queries, gallery))
        begin = time.perf_counter()
        found = rank(queries, gallery)
        totals.append(time.perf_counter() - begin)
    ratios = ", ".join(
        f"{total / product:.2f}" for total, product in zip(totals, products, strict=True)
    )
    print(
        f"{name} {len(queries.keys)} x {len(gallery.keys)} x {DIMENSION}: {min(totals):.1f} s, "
        f"{min(totals) / min(products):.2f} x the float32 products (round by round {ratios}; "
        f"R@1 {np.mean(found.first_rank_Q == 1):.3f})",
        flush=True,
    )


def write_tables(folder: str, query_rows: int, gallery_rows: int) -> None:
    """Queries of 54 a location, and a gallery whose first 951 rows show the locations."""
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
    """A gallery that keeps its last blocks, and multiplies each with each block of queries right
    after that was ranked.

    On a machine with other work, products measured minutes before or after the ranking say little;
    these share its minutes.
    """

    def __init__(self, queries: Side, gallery: Side) -> None:
        self._gallery, self.seconds = gallery, 0.0
        self._query_blocks = list(queries.blocks(Blocks().query_rows))
        self._room = np.empty((Blocks().query_rows, Blocks().gallery_rows), np.float32)
        self._kept: dict[int, Floats] = {}
        self._done = 0
        self.side = replace(gallery, blocks=self._blocks)

    def _blocks(self, rows: int) -> Iterator[Floats]:
        """The ranking reads twice: first for the true matches alone."""
        for number, gallery_BD in enumerate(self._gallery.blocks(rows)):
            self._kept[number] = gallery_BD
            self._kept.pop(number - 3, None)  # the ranking reads a block ahead
            yield gallery_BD

    def advance(self, scores: int) -> None:
        """The ranking has done a block of queries x gallery."""
        number, part = divmod(self._done, len(self._query_blocks))
        query_QD, gallery_BD = self._query_blocks[part], self._kept[number]
        assert scores == len(query_QD) * len(gallery_BD)
        begin = time.perf_counter()
        np.matmul(query_QD, gallery_BD.T, out=self._room[: len(query_QD), : len(gallery_BD)])
        self.seconds += time.perf_counter() - begin
        self._done += 1


def large(scale: float) -> None:
    """Queries and gallery in tables on disk."""
    gallery_rows, query_rows = int(LARGE_GALLERY * scale), int(701 * scale) * 54
    with tempfile.TemporaryDirectory() as folder:
        # In a process of its own: what making the tables takes is not what ranking takes.
        maker = multiprocessing.get_context("spawn").Process(
            target=write_tables, args=(folder, query_rows, gallery_rows)
        )
        maker.start()
        maker.join()
        queries, gallery = (
            side_of(open_table(f"{folder}/{split}")) for split in ("query", "gallery")
        )
        beside = Interleaved(queries, gallery)
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        begin = time.perf_counter()
        rank(queries, beside.side, advance=beside.advance)
        total = time.perf_counter() - begin - beside.seconds
        grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 2**20
        print(
            f"streamed {query_rows} x {gallery_rows} x {DIMENSION}: {total:.1f} s, {total / beside.seconds:.2f} x the float32 "
            f"products ({beside.seconds:.1f} s, block by block between the ranking), reading twice included; memory grew by "
            f"{grown:.2f} GiB",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scale", type=float, default=1.0, help="share of the locations to rank")
    parser.add_argument(
        "--large", action="store_true", help="a gallery of 168,437 images from disk; takes minutes"
    )
    arguments = parser.parse_args()
    scale: float = arguments.scale
    if arguments.large:
        large(scale)
        return
    centres_LD = np.random.default_rng(0).standard_normal((951, DIMENSION), dtype=np.float32)
    for task, (queried, queries_each, shown, gallery_each) in TASKS.items():
        queries = made_side(int(queried * scale), queries_each, centres_LD, 1)
        gallery = made_side(int(shown * scale), gallery_each, centres_LD, 2)
        measure(task, queries, gallery)


if __name__ == "__main__":
    main()
