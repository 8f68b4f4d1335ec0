"""A map in, answers out, without training: the built-in encoder on a mosaic that nobody trained on.

    python benchmarks/own_map.py --imagery DIR --out DIR [--tiles 12] [--photos 60]

Puts overhead images together into a GeoTIFF, renders UAV photos of random places of it (any
heading, 40 to 90 degrees below the horizon, another day), and walks the road of the README: tiles,
embeddings, index, locate. Prints how far the answers are from the photos' places and the seconds,
and as control the same road with ImageNet's weights alone (and a random refinement).
"""

import argparse
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np
import rasterio
import torch
from PIL import Image
from rasterio.transform import Affine, from_origin
from rasterio.warp import transform as transform_points

from jobs.encoding.encoder import make_encoder_spec, read_checkpoint_bytes
from jobs.stages.locate import locate_photos
from jobs.stages.settings import LocateSettings
from jobs.training.recipes.builtin import builtin
from model.checkpoint import Checkpoint, dumps
from model.pvda import FeatureEncoder
from model.weights.builtin import BUILTIN
from model.weights.start import load_start
from pipeline.core import cluster
from pipeline.core.arrays import Doubles, Pixels
from pipeline.features.embed import embed_gallery
from pipeline.features.settings import EmbeddingSettings
from pipeline.index.build import build_index
from pipeline.index.settings import IndexSettings
from pipeline.locate.page import LatLon, distance_to_m
from pipeline.shards.pack import pack
from pipeline.shards.settings import PackingSettings
from pipeline.simulation.location import LocationSpec, render_location
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


def write_map(mosaic_HW3: Pixels, path: Path) -> Affine:
    """Write the GeoTIFF, in UTM; its transform."""
    transform = from_origin(500_000, 5_200_000, METRES_PER_PIXEL, METRES_PER_PIXEL)
    height, width, _ = mosaic_HW3.shape
    with rasterio.open(
        path, "w", driver="GTiff", width=width, height=height, count=3, dtype="uint8",
        crs="EPSG:32632", transform=transform, photometric="RGB",
    ) as opened:  # fmt: skip
        opened.write(mosaic_HW3.transpose(2, 0, 1))
    return transform


def take_photos(mosaic_HW3: Pixels, folder: Path, count: int, seed: int) -> Doubles:
    """Photos of random places; columns and rows (P, 2) of what their location is."""
    rng = np.random.default_rng(seed)
    half = TILE_PX // 2
    places = np.stack(
        [rng.integers(half, extent - half, count) for extent in mosaic_HW3.shape[1::-1]], axis=1
    )
    folder.mkdir(parents=True, exist_ok=True)
    texture = folder.parent / "ground.png"
    for number, (column, row) in enumerate(places):
        window = mosaic_HW3[row - half : row + half, column - half : column + half]
        Image.fromarray(window).save(texture)
        flown = render_location(
            LocationSpec(
                seed=seed, location=number, views=1, size=384, flight="free", texture=str(texture),
                texture_metres_per_pixel=METRES_PER_PIXEL,
            )
        )  # fmt: skip
        (folder / f"{number:04d}.jpg").write_bytes(flown.drone[0])
    return places.astype(np.float64)


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


def walk_road(out: Path, tiles: str, checkpoint: str, positions: list[LatLon]) -> Doubles:
    """Embed, index and locate by one encoder; the answers' errors (P,) in metres."""
    out.mkdir(parents=True, exist_ok=True)
    table, index = str(out / "table"), str(out / "index")
    embedding = EmbeddingSettings(shards=tiles, out=table)
    spec = make_encoder_spec(read_checkpoint_bytes(checkpoint), checkpoint, embedding)
    embed_gallery(embedding, spec)
    build_index(IndexSettings(table=table, out=index))
    photos = sorted(str(path) for path in (out.parent / "photos").iterdir())
    settings = LocateSettings(
        photos=tuple(photos), checkpoint=checkpoint, index=index, shards=tiles,
        out=str(out / "where.geojson"), page=str(out / "where.html"),
    )  # fmt: skip
    found = locate_photos(settings)
    return np.array(
        [
            np.inf if one.answer is None else distance_to_m(one.answer, position)
            for one, position in zip(found, positions, strict=True)
        ]
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--imagery", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--tiles", type=int, default=12, help="images along a side of the map")
    parser.add_argument("--photos", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    cluster.connect()
    mosaic_HW3 = make_map(options.imagery, options.tiles, options.seed)
    (options.out / "map").mkdir(exist_ok=True)
    transform = write_map(mosaic_HW3, options.out / "map" / "map.tif")
    places = take_photos(mosaic_HW3, options.out / "photos", options.photos, options.seed)
    east, north = transform @ (places[:, 0], places[:, 1])
    lons, lats = transform_points("EPSG:32632", "EPSG:4326", east, north)
    positions = list(zip(lats, lons, strict=True))
    begin = time.perf_counter()
    tiles = str(options.out / "tiles")
    pack(
        GeoTiff(tile_m=TILE_M, overlap=0.5),
        PackingSettings(root=str(options.out / "map"), out=tiles),
    )
    packed = time.perf_counter() - begin
    start = options.out / "imagenet.pt"
    start.write_bytes(imagenet_checkpoint())
    shares = {}
    for name, checkpoint in (("ImageNet alone", str(start)), ("built-in", BUILTIN)):
        begin = time.perf_counter()
        folder = options.out / name.replace(" ", "-")
        errors = walk_road(folder, tiles, checkpoint, positions)
        spent = packed + time.perf_counter() - begin
        shares[name] = float((errors <= 25).mean())
        ratio = shares[name] / max(shares["ImageNet alone"], 1 / len(errors))
        print(
            f"{name}: {shares[name]:.1%} of {len(errors)} photos within 25 m, {ratio:.2f} x "
            f"ImageNet's weights alone; median {np.median(errors):.0f} m; map of "
            f"{mosaic_HW3.shape[1] * METRES_PER_PIXEL / 1000:.2f} km a side, {spent:.0f} s"
        )


if __name__ == "__main__":
    main()
