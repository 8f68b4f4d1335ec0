"""What it costs to find damage: one line per figure, each a ratio to the same work without, in one
run.

In: made vectors, networks and images in a temporary folder. Files are read from the page cache.

    python benchmarks/damage.py [--rows 32768]
"""

import argparse
import io
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import torch

from model.checkpoint import Checkpoint, check_integrity, dumps
from model.config import PVDAConfig
from model.pvda import FeatureEncoder
from pipeline.core import parquet as parquet_files
from pipeline.features.part import (
    PAGE_BYTES,
    ROW_GROUP,
    PartFooter,
    PartRows,
    verify_part,
    write_part,
)
from pipeline.features.row_reader import RowReader
from pipeline.features.table import open_table

DIMENSION, REPEATS, NEIGHBOURS = 2048, 7, 30


def seconds(work: Callable[[], Any]) -> float:
    """Median over some runs."""
    taken = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        work()
        taken.append(time.perf_counter() - start)
    return statistics.median(taken)


def make_rows(count: int) -> PartRows:
    vectors = np.random.default_rng(0).normal(size=(count, DIMENSION)).astype(np.float32)
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    keys = [f"gallery-drone-{number:08d}" for number in range(count)]
    return PartRows(
        keys=keys,
        locations=[key[-8:-2] for key in keys],
        views=["drone"] * count,
        splits=["gallery"] * count,
        lats=[47.0] * count,
        lons=[8.0] * count,
        embeddings_BD=vectors,
    )


def table(folder: Path, count: int) -> None:
    """A part of a feature table: written, read in blocks, by single rows, and looked at whole."""
    rows, footer = make_rows(count), PartFooter(fingerprint="f", shard_sha256="s", rows=count)
    path, plain = str(folder / "part.parquet"), str(folder / "plain.parquet")
    write_part(path, rows, footer, "float16")
    whole = pq.read_table(path)
    text = [name for name in whole.column_names if name != "embedding"]

    def write_plain() -> None:
        options = {"compression": "none", "write_statistics": text, "use_dictionary": text}
        pq.write_table(whole, plain, row_group_size=ROW_GROUP, **options)

    def write_sealed() -> None:
        options = {"compression": "none", "write_statistics": text, "data_page_size": PAGE_BYTES}
        parquet_files.write_table(path, whole, ROW_GROUP, **options)

    def read_plain() -> None:
        with open(plain, "rb") as stream:
            for _ in pq.ParquetFile(stream, buffer_size=1 << 20).iter_batches(
                columns=["embedding"]
            ):
                pass

    def read_sealed() -> None:
        with parquet_files.open_parquet(path) as parquet:
            for _ in parquet.iter_batches(columns=["embedding"]):
                pass

    megabytes = Path(path).stat().st_size / 1e6
    say(
        "Parquet written, with seal and checksums",
        seconds(write_sealed),
        seconds(write_plain),
        megabytes,
    )
    say("embeddings read, checksums compared", seconds(read_sealed), seconds(read_plain), megabytes)
    say(
        "every byte of a part (--verify)",
        seconds(lambda: verify_part(path)),
        seconds(read_plain),
        megabytes,
    )
    small = folder / "small"
    small.mkdir()
    write_part(
        str(small / "part.parquet"),
        make_rows(64),
        PartFooter(fingerprint="f", shard_sha256="s", rows=64),
    )
    print(
        f"a table of one small part opened: {1e3 * seconds(lambda: open_table(str(small))):.2f} ms"
    )
    single_rows(folder, count)


def single_rows(folder: Path, count: int) -> None:
    Path(folder, "plain.parquet").unlink()
    rng = np.random.default_rng(1)
    queries = [np.sort(rng.choice(count, NEIGHBOURS, replace=False)) for _ in range(300)]
    cold = RowReader(str(folder), DIMENSION)
    cold.read("part.parquet", "s", queries[0][:1])
    taken = []
    for _ in range(2):
        start = time.perf_counter()
        for row_R in queries:
            cold.read("part.parquet", "s", row_R)
        taken.append(time.perf_counter() - start)
    each = 1e6 * (taken[0] - taken[1]) / len(cold._part("part.parquet", "s").sound_P)
    print(
        f"single rows: {each:.0f} us for a page's first row; {1e3 * taken[1] / 300:.3f} ms a query of 30 rows afterwards"
    )


def checkpoint() -> None:
    """A ResNet-50 with its optimiser's momentum: loaded, with and without a look at every byte."""
    network = FeatureEncoder(PVDAConfig(depth=50))
    weights = network.state_dict()
    momentum = {name: torch.zeros_like(tensor) for name, tensor in weights.items()}
    data = dumps(
        Checkpoint(
            network=PVDAConfig(depth=50), recipe={}, locations=[], epoch=1, history=[],
            state={"modules": {"encoder": weights}, "optimizers": momentum},
        )
    )  # fmt: skip
    plain = seconds(lambda: torch.load(io.BytesIO(data), weights_only=True))
    look = seconds(lambda: check_integrity(data, "it"))
    megabytes = len(data) / 1e6
    print(
        f"a checkpoint of {megabytes:.0f} MB: looked at in {look:.3f} s, {100 * look / megabytes:.3f} s per 100 MB"
    )
    say("a checkpoint loaded", look + plain, plain, megabytes)


def say(what: str, with_it: float, without: float, megabytes: float) -> None:
    print(
        f"{what}: {with_it / without:.2f} x the time without; {100 * with_it / megabytes:.3f} s per 100 MB"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rows", type=int, default=32_768)
    rows = parser.parse_args().rows
    with tempfile.TemporaryDirectory() as folder:
        table(Path(folder), rows)
    checkpoint()


if __name__ == "__main__":
    main()
