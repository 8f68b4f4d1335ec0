"""A map in, answers out, without training: the built-in encoder on a mosaic that nobody trained on.

    python benchmarks/own_map.py --imagery DIR --out DIR [--tiles 12] [--photos 60]

Puts overhead images together into a GeoTIFF, flies over it (any heading, 45 to 90 degrees below the
horizon, 60 to 120 m high, another day), and walks the road of the README: tiles, embeddings, index,
locate. Prints how far the answers are from the photos' places: with the camera's pose in the tags
(heading wrong by 3 degrees, pitch by 1, height by 3 %), without it, by tiles alone; and as control
by tiles with ImageNet's weights (and a random refinement).
"""

import argparse
import csv
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np
import rasterio
import torch
from PIL import Image
from rasterio.transform import Affine

from jobs.encoding.encoder import make_encoder_spec, read_checkpoint_bytes
from jobs.stages.locate import locate_photos
from jobs.stages.settings import LocateSettings
from jobs.training.recipes.builtin import builtin
from model.checkpoint import Checkpoint, dumps
from model.pvda import FeatureEncoder
from model.weights.builtin import BUILTIN
from model.weights.start import load_start
from pipeline.core import cluster
from pipeline.core.arrays import Pixels
from pipeline.features.embed import embed_gallery
from pipeline.features.settings import EmbeddingSettings
from pipeline.index.build import build_index
from pipeline.index.settings import IndexSettings
from pipeline.locate.page import LatLon, distance_to_m
from pipeline.shards.pack import pack
from pipeline.shards.settings import PackingSettings
from pipeline.simulation.over_map.fly import fly
from pipeline.simulation.over_map.settings import MapFlightSettings
from pipeline.sources.geotiff import GeoTiff

TILE_PX, METRES_PER_PIXEL = 256, 0.3
TILE_M = 55.0
"The satellite images of the encoder's training show as much."


def make_map(imagery: Path, side: int, seed: int) -> Pixels:
    """A mosaic of side x side images, (H, W, 3)."""
    files = sorted(path for path in imagery.iterdir() if path.suffix == ".jpg")
    order = np.random.default_rng(seed).permutation(len(files))[: side * side]
    if len(order) < side * side:
        raise SystemExit(f"{imagery} has {len(files)} images, expected {side * side}")
    tiles = [
        np.asarray(Image.open(files[at]).convert("RGB").resize((TILE_PX, TILE_PX))) for at in order
    ]
    rows = [np.concatenate(tiles[row * side : (row + 1) * side], axis=1) for row in range(side)]
    return np.concatenate(rows)


def write_map(mosaic_HW3: Pixels, path: Path) -> None:
    """Write the GeoTIFF, in UTM."""
    transform = Affine(METRES_PER_PIXEL, 0, 500_000, 0, -METRES_PER_PIXEL, 5_200_000)
    height, width, _ = mosaic_HW3.shape
    with rasterio.open(
        path, "w", driver="GTiff", width=width, height=height, count=3, dtype="uint8",
        crs="EPSG:32632", transform=transform, photometric="RGB",
    ) as opened:  # fmt: skip
        opened.write(mosaic_HW3.transpose(2, 0, 1))


def imagenet_checkpoint() -> bytes:
    """The built-in encoder's network before its training."""
    recipe = builtin()
    torch.manual_seed(0)
    encoder = FeatureEncoder(recipe.network)
    load_start(encoder, recipe.network.backbone, "imagenet", None)
    state = {"modules": {"encoder": encoder.state_dict()}}
    return dumps(
        Checkpoint(
            network=recipe.network, recipe=asdict(recipe), locations=[], epoch=0, history=[],
            state=state,
        )
    )  # fmt: skip


def make_index(out: Path, tiles: str, checkpoint: str) -> str:
    """Embed and index the tiles by one encoder; the index."""
    out.mkdir(parents=True, exist_ok=True)
    table, index = str(out / "table"), str(out / "index")
    embedding = EmbeddingSettings(shards=tiles, out=table)
    spec = make_encoder_spec(read_checkpoint_bytes(checkpoint), checkpoint, embedding)
    embed_gallery(embedding, spec)
    build_index(IndexSettings(table=table, out=index))
    return index


def print_errors(
    name: str, settings: LocateSettings, truth: dict[str, LatLon], baseline: float
) -> float:
    """Locate the photos and print how far off the answers are; the share within 25 m."""
    begin = time.perf_counter()
    located = locate_photos(settings)
    seconds = time.perf_counter() - begin
    error_P = np.array(
        [
            np.inf if one.answer is None else distance_to_m(one.answer, truth[Path(one.name).name])
            for one in located
        ]
    )
    share = float((error_P <= 25).mean())
    within = ", ".join(
        f"{(error_P <= metres).mean():.1%} within {metres} m" for metres in (1, 5, 25)
    )
    ratio = share / max(baseline or share, 1 / len(error_P))
    wrong = sum(
        error > 25 and one.answer is not None and one.answer.refinement is not None
        for error, one in zip(error_P, located, strict=True)
    )
    print(
        f"{name}: {within} of {len(error_P)} photos, {ratio:.2f} x ImageNet's tiles within 25 m; "
        f"median {np.median(error_P):.2f} m; {wrong} refined and more than 25 m off; "
        f"{seconds / len(error_P):.2f} s a photo"
    )
    return share


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--imagery", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--tiles", type=int, default=12, help="images along a side of the map")
    parser.add_argument("--photos", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--height", type=float, nargs=2, default=(60.0, 120.0), help="metres")
    options = parser.parse_args()
    out = options.out
    (out / "map").mkdir(parents=True, exist_ok=True)
    cluster.connect()
    mosaic_HW3 = make_map(options.imagery, options.tiles, options.seed)
    mosaic = out / "map" / "map.tif"
    write_map(mosaic_HW3, mosaic)
    flight = fly(
        MapFlightSettings(
            mosaic=str(mosaic), out=str(out / "flight"), photos=options.photos,
            height=tuple(options.height), seed=options.seed,
        )
    )  # fmt: skip
    with (flight / "photos.csv").open() as table:
        truth = {
            Path(row["path"]).name: (float(row["lat"]), float(row["lon"]))
            for row in csv.DictReader(table)
        }
    tiles = str(out / "tiles")
    pack(GeoTiff(tile_m=TILE_M, overlap=0.5), PackingSettings(root=str(out / "map"), out=tiles))
    start = out / "imagenet.pt"
    start.write_bytes(imagenet_checkpoint())
    print(f"map of {mosaic_HW3.shape[1] * METRES_PER_PIXEL / 1000:.2f} km a side")
    baseline = 0.0
    for name, checkpoint, match, pose in (
        ("ImageNet's weights, tiles", str(start), False, True),
        ("built-in, tiles", BUILTIN, False, True),
        ("built-in, matched, no pose", BUILTIN, True, False),
        ("built-in, matched, pose", BUILTIN, True, True),
    ):
        index = make_index(out / name.partition(",")[0].replace(" ", "-"), tiles, checkpoint)
        settings = LocateSettings(
            photos=(str(flight / "photos"),), checkpoint=checkpoint, index=index, shards=tiles,
            out=str(out / "where.geojson"), page=str(out / "where.html"), match=match, pose=pose,
        )  # fmt: skip
        share = print_errors(name, settings, truth, baseline)
        baseline = baseline or share


if __name__ == "__main__":
    main()
