"""The cost of detecting damage, as a ratio to the same work without checks in the same run.

The input is synthetic vectors and networks in a temporary folder, read from the page cache. Prints
one line per figure.

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

DIMENSION, NEIGHBOURS, QUERIES = 2048, 30, 300
REPEATS = 7
"Runs of which the median counts."


def median_seconds(work: Callable[[], Any], repeats: int = REPEATS) -> float:
    durations = []
    for _ in range(repeats):
        begin = time.perf_counter()
        work()
        durations.append(time.perf_counter() - begin)
    return statistics.median(durations)


def synthetic_rows(count: int) -> PartRows:
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


def measure_table(folder: Path, count: int, repeats: int) -> None:
    """A part of a feature table: written, read in blocks, verified, opened, read by rows."""
    rows = synthetic_rows(count)
    footer = PartFooter(fingerprint="f", shard_sha256="s", rows=count)
    path, plain_path = str(folder / "part.parquet"), str(folder / "plain.parquet")
    write_part(path, rows, footer, "float16")
    table = pq.read_table(path)
    text = [name for name in table.column_names if name != "embedding"]

    def write_plain() -> None:
        options = {"compression": "none", "write_statistics": text, "use_dictionary": text}
        pq.write_table(table, plain_path, row_group_size=ROW_GROUP, **options)

    def write_checked() -> None:
        options = {"compression": "none", "write_statistics": text, "data_page_size": PAGE_BYTES}
        parquet_files.write_table(path, table, ROW_GROUP, **options)

    def read_plain() -> None:
        with open(plain_path, "rb") as stream:
            parquet = pq.ParquetFile(stream, buffer_size=1 << 20)
            for _ in parquet.iter_batches(columns=["embedding"]):
                pass

    def read_checked() -> None:
        with parquet_files.open_parquet(path) as parquet:
            for _ in parquet.iter_batches(columns=["embedding"]):
                pass

    megabytes = Path(path).stat().st_size / 1e6
    writing, plain_writing = (
        median_seconds(work, repeats) for work in (write_checked, write_plain)
    )
    reading, plain_reading = (median_seconds(work, repeats) for work in (read_checked, read_plain))
    verifying = median_seconds(lambda: verify_part(path), repeats)
    print_ratio("Parquet written with checksums", writing, plain_writing, megabytes)
    print_ratio("embeddings read, checksums compared", reading, plain_reading, megabytes)
    print_ratio("every byte of a part (--verify)", verifying, plain_reading, megabytes)
    measure_opening(folder / "small", repeats)
    measure_single_rows(folder, count)


def measure_opening(folder: Path, repeats: int) -> None:
    """A table of one small part: opened by us, and its file opened by pyarrow."""
    folder.mkdir()
    footer = PartFooter(fingerprint="f", shard_sha256="s", rows=64)
    path = str(folder / "part.parquet")
    write_part(path, synthetic_rows(64), footer)
    ours = median_seconds(lambda: open_table(str(folder)), repeats)
    plain = median_seconds(lambda: pq.ParquetFile(path).close(), repeats)
    print(
        f"a table of one small part opened: {1e3 * ours:.2f} ms, {ours / plain:.2f} x pyarrow's "
        "opening of its file"
    )


def measure_single_rows(folder: Path, count: int) -> None:
    """Rows of search results: the first read of a page checks it, later reads do not."""
    Path(folder, "plain.parquet").unlink()
    rng = np.random.default_rng(1)
    queries = [np.sort(rng.choice(count, NEIGHBOURS, replace=False)) for _ in range(QUERIES)]
    reader = RowReader(str(folder), DIMENSION)
    reader.read("part.parquet", "s", queries[0][:1])
    seconds = []
    for _ in range(2):
        begin = time.perf_counter()
        for row_R in queries:
            reader.read("part.parquet", "s", row_R)
        seconds.append(time.perf_counter() - begin)
    first, later = seconds
    print(
        f"single rows: pages checked on their first read, {first / later:.2f} x the time of later "
        f"reads; {1e3 * later / QUERIES:.3f} ms per query of {NEIGHBOURS} rows afterwards"
    )


def measure_checkpoint(depth: Any, repeats: int) -> None:
    """A ResNet with its optimizer's momentum: loaded, with and without checking every byte."""
    network = PVDAConfig(backbone=f"resnet{depth}")
    weights = FeatureEncoder(network).state_dict()
    momentum = {name: torch.zeros_like(tensor) for name, tensor in weights.items()}
    state = {"modules": {"encoder": weights}, "optimizers": momentum}
    data = dumps(
        Checkpoint(network=network, recipe={}, locations=[], epoch=1, history=[], state=state)
    )
    plain = median_seconds(lambda: torch.load(io.BytesIO(data), weights_only=True), repeats)
    check = median_seconds(lambda: check_integrity(data, "it"), repeats)
    megabytes = len(data) / 1e6
    print(
        f"a checkpoint of {megabytes:.0f} MB: checked in {check:.3f} s, "
        f"{100 * check / megabytes:.3f} s per 100 MB"
    )
    print_ratio("a checkpoint loaded", check + plain, plain, megabytes)


def print_ratio(what: str, with_checks: float, without: float, megabytes: float) -> None:
    print(
        f"{what}: {with_checks / without:.2f} x the time without checks; "
        f"{100 * with_checks / megabytes:.3f} s per 100 MB"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--rows", type=int, default=32_768, help="rows of the part")
    add("--depth", type=int, default=50, choices=(18, 34, 50, 101), help="the checkpoint's ResNet")
    add("--repeats", type=int, default=REPEATS, help="runs of which the median counts")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        measure_table(Path(folder), args.rows, args.repeats)
    measure_checkpoint(args.depth, args.repeats)


if __name__ == "__main__":
    main()
