"""How much memory the steps from a map to an answer take, on a map that no memory holds.

    python benchmarks/big_map.py --out DIR [--side-px 50000] [--resolution 0.05] [--photos 40]

Makes a GeoTIFF of so many pixels a side and one of a tenth of it, walks the road of `adapt` on both
(tiles, flights, embeddings, index, locate), each step in a process of its own, and prints each
step's time and largest resident memory, and that memory as a ratio to the small map's.
"""

import argparse
import resource
import time
from collections.abc import Callable
from functools import partial
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path

import cv2
import numpy as np
import rasterio
from rasterio.transform import Affine
from rasterio.windows import Window

from jobs.encoding.encoder import make_encoder_spec, read_checkpoint_bytes
from jobs.stages.locate import locate_photos
from jobs.stages.settings import LocateSettings
from model.weights.builtin import BUILTIN
from pipeline.core.arrays import Pixels
from pipeline.features.embed import embed_gallery
from pipeline.features.settings import EmbeddingSettings
from pipeline.index.build import build_index
from pipeline.index.settings import IndexSettings
from pipeline.shards.pack import pack
from pipeline.shards.settings import PackingSettings
from pipeline.simulation.over_map.fly import fly
from pipeline.simulation.over_map.settings import MapFlightSettings
from pipeline.sources.geotiff import GeoTiff

TILE_M, OVERLAP = 55.0, 0.5
"As `adapt` makes them."
BLOCK_PX, ROOFS = 1000, 120
"Side of a block of the made map, and rectangles in it."


def block(seed: int, number: int) -> Pixels:
    """Ground that is like no other block's: soft colours with rectangles of any direction."""
    rng = np.random.default_rng((seed, number))
    coarse_HW3 = rng.integers(60, 200, (16, 16, 3)).astype(np.uint8)
    ground_HW3 = cv2.resize(coarse_HW3, (BLOCK_PX, BLOCK_PX), interpolation=cv2.INTER_CUBIC)
    for _ in range(ROOFS):
        middle, size = rng.uniform(0, BLOCK_PX, 2), rng.uniform(15, 90, 2)
        corners_42 = cv2.boxPoints((middle.tolist(), size.tolist(), float(rng.uniform(0, 90))))
        colour = rng.integers(30, 240, 3).tolist()
        cv2.fillConvexPoly(ground_HW3, corners_42.astype(np.int32), colour, lineType=cv2.LINE_AA)
    return np.asarray(ground_HW3, np.uint8)


def make_map(path: Path, side_px: int, resolution: float) -> None:
    """Write the GeoTIFF in UTM, block by block."""
    if path.exists():
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part.tif")
    with rasterio.open(
        part, "w", driver="GTiff", width=side_px, height=side_px, count=3, dtype="uint8",
        crs="EPSG:32632", transform=Affine(resolution, 0, 500_000, 0, -resolution, 5_200_000),
        photometric="YCBCR", compress="JPEG", tiled=True, blockxsize=512, blockysize=512,
        BIGTIFF="IF_SAFER",
    ) as opened:  # fmt: skip
        for row in range(0, side_px, BLOCK_PX):
            blocks = [block(row, column) for column in range(0, side_px, BLOCK_PX)]
            strip_HW3 = np.concatenate(blocks, axis=1)[: side_px - row, :side_px]
            window = Window(0, row, side_px, len(strip_HW3))
            opened.write(strip_HW3.transpose(2, 0, 1), window=window)
    part.rename(path)


def embed(tiles: str, table: str) -> None:
    settings = EmbeddingSettings(shards=tiles, out=table, workers=0)
    spec = make_encoder_spec(read_checkpoint_bytes(BUILTIN), BUILTIN, settings)
    embed_gallery(settings, spec)


def steps(mosaic: Path, out: Path, photos: int) -> dict[str, Callable[[], object]]:
    """The road on one map, each step's work by its name, in this process without Ray."""
    tiles, table, index, flight = (str(out / name) for name in ("tiles", "table", "index", "fly"))
    where = str(out / "where.geojson")
    return {
        "make_shards": partial(
            pack,
            GeoTiff(tile_m=(TILE_M,), overlap=OVERLAP),
            PackingSettings(root=str(mosaic), out=tiles, workers=0),
        ),
        "fly": partial(
            fly, MapFlightSettings(mosaic=str(mosaic), out=flight, photos=photos, workers=0)
        ),
        "embed_gallery": partial(embed, tiles, table),
        "build_index": partial(build_index, IndexSettings(table=table, out=index)),
        "locate": partial(
            locate_photos,
            LocateSettings(photos=(f"{flight}/photos",), index=index, shards=tiles, out=where),
        ),
    }


def report(work: Callable[[], object], end: Connection) -> None:
    begin = time.perf_counter()
    work()
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    end.send((time.perf_counter() - begin, peak_mb))


def measured(work: Callable[[], object]) -> tuple[float, float]:
    """Seconds and largest resident memory in MB of a step in a process of its own."""
    context = get_context("fork")  # this process has no threads: all work is in others
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=report, args=(work, sender))
    process.start()
    sender.close()
    try:
        seconds, peak_mb = receiver.recv()
    except EOFError:
        raise SystemExit("a step failed, see above") from None
    process.join()
    return seconds, peak_mb


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--side-px", type=int, default=50_000)
    parser.add_argument("--resolution", type=float, default=0.05, help="metres per pixel")
    parser.add_argument("--photos", type=int, default=40)
    options = parser.parse_args()
    peaks: dict[str, float] = {}
    print(
        "| step | pixels a side | seconds | memory, MB | x the small map's |\n|---|---|---|---|---|"
    )
    for side_px in (options.side_px // 10, options.side_px):
        # The small map has the same ground and fewer pixels.
        resolution = options.resolution * options.side_px / side_px
        out = options.out / str(side_px)
        mosaic = out / "map" / "map.tif"
        measured(partial(make_map, mosaic, side_px, resolution))
        for name, work in steps(mosaic, out, options.photos).items():
            seconds, peak_mb = measured(work)
            ratio = peak_mb / peaks.setdefault(name, peak_mb)
            print(
                f"| {name} | {side_px:,} | {seconds:.0f} | {peak_mb:,.0f} | {ratio:.2f} x |",
                flush=True,
            )


if __name__ == "__main__":
    main()
