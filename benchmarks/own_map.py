"""A map in, answers out, without training: the built-in encoder on a mosaic that nobody trained on.

    python benchmarks/own_map.py --imagery DIR --out DIR [--tiles 12] [--photos 60]

Puts overhead images together into a GeoTIFF, flies over it (any heading, 45 to 90 degrees below the
horizon, 60 to 120 m high, another day), and walks the road of the README: tiles, embeddings, index,
locate. Prints how far the answers are from the photos' places: with the camera's pose in the tags
(heading wrong by 3 degrees, pitch by 1, height by 3 %), without it, by tiles alone; and as control
by tiles with ImageNet's weights (and a random refinement). Then, for photos from --higher times
these heights, a gallery of one tile size beside one of several levels (--levels): how many answers
are near, and how often the first candidate shows the photo's place. `--only-levels` leaves out the
first part.
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
from pipeline.core.geo import haversine_m
from pipeline.features.embed import embed_gallery
from pipeline.features.settings import EmbeddingSettings
from pipeline.index.build import build_index
from pipeline.index.settings import IndexSettings
from pipeline.locate.geojson import LocatedPhoto
from pipeline.locate.page import LatLon, distance_to_m
from pipeline.shards.pack import pack
from pipeline.shards.settings import PackingSettings
from pipeline.simulation.over_map.fly import fly
from pipeline.simulation.over_map.settings import MapFlightSettings
from pipeline.sources.geotiff import GeoTiff

TILE_PX, METRES_PER_PIXEL = 256, 0.3
TILE_M = 55.0
"The satellite images of the encoder's training show as much."


def make_map(imagery: Path, side: int, seed: int, number: int = 0) -> Pixels:
    """A mosaic of side x side images, (H, W, 3); those of other `number`s share none of them."""
    files = sorted(path for path in imagery.iterdir() if path.suffix == ".jpg")
    images = side * side
    order = np.random.default_rng(seed).permutation(len(files))[number * images :][:images]
    if len(order) < images:
        expected = (number + 1) * images
        raise SystemExit(f"{imagery} has {len(files)} images, expected {expected}")
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
    embedding = EmbeddingSettings(shards=tiles, out=table, workers=0)
    spec = make_encoder_spec(read_checkpoint_bytes(checkpoint), checkpoint, embedding)
    embed_gallery(embedding, spec)
    build_index(IndexSettings(table=table, out=index))
    return index


def fly_over(
    mosaic: Path, out: Path, photos: int, height: tuple[float, float], seed: int
) -> tuple[str, dict[str, LatLon]]:
    """The photos' folder of a flight, and their places by name."""
    flight = fly(
        MapFlightSettings(mosaic=str(mosaic), out=str(out), photos=photos, height=height, seed=seed)
    )
    with (flight / "photos.csv").open() as table:
        truth = {
            Path(row["path"]).name: (float(row["lat"]), float(row["lon"]))
            for row in csv.DictReader(table)
        }
    return str(flight / "photos"), truth


def print_levels(options: argparse.Namespace, mosaic: Path, tiles: str) -> None:
    """One tile size beside several levels, for photos from several heights. `tiles`: of one size.

    Prints a row of a table for each, and the ratio of the answers within 5 m.
    """
    out: Path = options.out
    shards = {"one level": tiles, "levels": str(out / "levels")}
    pack_tiles(mosaic, shards["levels"], tuple(options.levels))
    indexes = {
        "one level": make_index(out / "built-in", tiles, BUILTIN),
        "levels": make_index(out / "built-in-levels", shards["levels"], BUILTIN),
    }
    names = ("metres up", "pose", "gallery", "first shows it", "within 5 m", "25 m", "s a photo")
    print(f"| {' | '.join(names)} |\n|{'---|' * len(names)}")
    for times in options.higher:
        low, high = (times * metres for metres in options.height)
        photos, truth = fly_over(
            mosaic, out / f"flight-{times:g}", options.photos, (low, high), options.seed + 1
        )
        for pose in (True, False):
            within: dict[str, float] = {}
            for name, index in indexes.items():
                settings = LocateSettings(
                    photos=(photos,), index=index, shards=shards[name], pose=pose,
                    out=str(out / "where.geojson"),
                )  # fmt: skip
                begin = time.perf_counter()
                located = locate_photos(settings)
                seconds = (time.perf_counter() - begin) / len(located)
                error_P, shown_P = zip(*(judge(one, truth) for one in located), strict=True)
                within[name] = float((np.array(error_P) <= 5).mean())
                print(
                    f"| {low:g} to {high:g} | {'yes' if pose else 'no'} | {name} | "
                    f"{np.mean(shown_P):.1%} | {within[name]:.1%} | "
                    f"{(np.array(error_P) <= 25).mean():.1%} | {seconds:.2f} |",
                    flush=True,
                )
            ratio = within["levels"] / max(within["one level"], 1 / len(truth))
            print(f"levels, {low:g} to {high:g} m: {ratio:.2f} x one level's photos within 5 m")


def judge(one: LocatedPhoto, truth: dict[str, LatLon]) -> tuple[float, bool]:
    """Metres from the answer to the photo's place, and whether the first candidate shows it."""
    place = truth[Path(one.name).name]
    error_m = distance_to_m(one.answer, place) if one.answer else None
    if one.answer is None or error_m is None:
        return np.inf, False
    first = one.answer.candidates[0]
    away_m = float(haversine_m(np.array([first.lat, first.lon]), np.array(place)))
    return error_m, away_m <= (first.side_m or 0.0) / np.sqrt(2)


def pack_tiles(mosaic: Path, out: str, sides_m: float | tuple[float, ...]) -> None:
    """Tiles that overlap by half."""
    pack(GeoTiff(tile_m=sides_m, overlap=0.5), PackingSettings(root=str(mosaic.parent), out=out))


def print_errors(
    name: str, settings: LocateSettings, truth: dict[str, LatLon], baseline: float
) -> float:
    """Locate the photos and print how far off the answers are; the share within 25 m."""
    begin = time.perf_counter()
    located = locate_photos(settings)
    seconds = time.perf_counter() - begin
    error_P = np.array([judge(one, truth)[0] for one in located])
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
    parser.add_argument("--levels", type=float, nargs="+", default=(TILE_M, 2 * TILE_M, 4 * TILE_M))
    parser.add_argument("--higher", type=float, nargs="+", default=(1.0, 2.0))
    parser.add_argument("--only-levels", action="store_true")
    options = parser.parse_args()
    out = options.out
    (out / "map").mkdir(parents=True, exist_ok=True)
    cluster.connect()
    mosaic_HW3 = make_map(options.imagery, options.tiles, options.seed)
    mosaic = out / "map" / "map.tif"
    write_map(mosaic_HW3, mosaic)
    tiles = str(out / "tiles")
    pack_tiles(mosaic, tiles, TILE_M)
    print(f"map of {mosaic_HW3.shape[1] * METRES_PER_PIXEL / 1000:.2f} km a side")
    if not options.only_levels:
        print_ways(options, mosaic, tiles)
    print_levels(options, mosaic, tiles)


def print_ways(options: argparse.Namespace, mosaic: Path, tiles: str) -> None:
    """Tiles and matching, with the camera's pose and without, and ImageNet's weights as control."""
    out: Path = options.out
    photos, truth = fly_over(
        mosaic, out / "flight", options.photos, tuple(options.height), options.seed
    )
    start = out / "imagenet.pt"
    start.write_bytes(imagenet_checkpoint())
    baseline = 0.0
    for name, checkpoint, match, pose in (
        ("ImageNet's weights, tiles", str(start), False, True),
        ("built-in, tiles", BUILTIN, False, True),
        ("built-in, matched, no pose", BUILTIN, True, False),
        ("built-in, matched, pose", BUILTIN, True, True),
    ):
        index = make_index(out / name.partition(",")[0].replace(" ", "-"), tiles, checkpoint)
        settings = LocateSettings(
            photos=(photos,), checkpoint=checkpoint, index=index, shards=tiles,
            out=str(out / "where.geojson"), page=str(out / "where.html"), match=match, pose=pose,
        )  # fmt: skip
        share = print_errors(name, settings, truth, baseline)
        baseline = baseline or share


if __name__ == "__main__":
    main()
