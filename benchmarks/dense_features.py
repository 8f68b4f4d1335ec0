"""Trains the head of the built-in encoder's dense features (model/dense.py).

    python benchmarks/dense_features.py --out FILE [--steps 1200] [--photos 400]
        --region TILES INDEX FLIGHT SURFACE [--region ...]      shards, index, photos.csv; -: flat

Photos of known pose over a map are laid on the ground at the map's scale as their tags tell, and a
ray of the true pose says which pixel of the map each cell shows, on the heights of the surface
model. The head learns to tell that pixel from all others of the window (InfoNCE, both ways); the
encoder stays as it is. Prints the share of cells of photos it has not seen whose nearest cell of
the window is the right one, as a ratio to a head of random weights. benchmarks/matchers.py places
photos with the head that comes with the project. Shapes: N cells, M pixels of the window.
"""

import argparse
import math
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import safetensors.torch
import torch
import torch.nn.functional as F
from torch import Tensor

from jobs.encoding.dense_features import grid_points
from jobs.encoding.photo_encoder import decode_photo
from jobs.stages.calibrate_flight import FlightPhoto, flight_of
from jobs.stages.matching import open_map
from model.dense import STRIDE, DenseEncoder, sample
from pipeline.camera.ground import apply_homography, camera_axes, focal_length_px
from pipeline.camera.local_plane import LocalPlane
from pipeline.camera.pose import Pose
from pipeline.camera.warp import warp
from pipeline.core import storage
from pipeline.core.arrays import Doubles, Pixels
from pipeline.index.searcher import Index
from pipeline.locate.gallery_map import read_gallery_map
from pipeline.locate.photo_files import read_photo_tags
from pipeline.matching.map_windows import DENSE_WINDOW_PX, MapWindows
from pipeline.matching.photo_features import flat_frame, ground_extent, promised_ground
from pipeline.matching.photo_pose import PoseSettings, pose_of_photo
from pipeline.matching.relief import Relief

TEMPERATURE = 0.05
NEAR_PX = 12.0
"Cells so near the right pixel count as right, and are no negatives."
HELD_OUT = 10
"One photo in so many is not learned from."
PAIRS_A_STEP, LEARNING_RATE = 2, 1e-3
PHOTOS_A_TURN = 10
"Of a map, before the next one's."
HALF_WINDOW = (0.6, 0.9)
"Half a window's side, as a share of the ground that the photo shows."
MOST_CELLS = 400
"Of a photo, drawn by chance: each is compared with thousands."
DESCENT_M = 0.5
"Of a ray from one look at the heights to the next."


@dataclass(frozen=True, kw_only=True)
class Pair:
    """A photo on the ground and a window of the map, both north up and of one scale."""

    photo_HW3: Pixels
    window_HW3: Pixels
    cells_N2: Doubles
    "Pixels of the photo, the middles of its cells."
    shown_N2: Doubles
    "The pixels of the window that show the same."


def meet_relief(pose: Pose, rays_N3: Doubles, relief: Relief | None) -> Doubles:
    """Where rays from a camera meet the heights first, (N, 2) east and north; the pose's height is
    above the ground in the photo's middle, which is the zero."""
    zero = np.zeros((1, 2))
    level_m = 0.0 if relief is None else float(relief.at(zero)[0])
    camera_3 = np.array([pose.x_m, pose.y_m, level_m + pose.altitude_m])
    low_m, high_m = (
        (0.0, 0.0)
        if relief is None
        else (float(relief.height_HW.min()), float(relief.height_HW.max()))
    )
    met_N2 = np.full((len(rays_N3), 2), np.nan)
    for z in np.linspace(high_m, low_m, 1 + math.ceil((high_m - low_m) / DESCENT_M)):
        at_N2 = camera_3[:2] + rays_N3[:, :2] / rays_N3[:, 2:] * (z - camera_3[2])
        hit = np.flatnonzero(np.isnan(met_N2[:, 0]))
        if relief is not None and z > low_m:
            hit = hit[relief.at(at_N2[hit]) >= z]
        met_N2[hit] = at_N2[hit]
    return met_N2


def pair_of(photo: FlightPhoto, windows: MapWindows, rng: np.random.Generator) -> Pair | None:
    """A photo beside a window around its place, moved by up to a quarter; None where its tags
    promise no ground, or the map does not show it."""
    data, truth = storage.read_bytes(photo.path), photo.truth
    image_HW3 = decode_photo(data)
    size = (image_HW3.shape[1], image_HW3.shape[0])
    told = pose_of_photo(read_photo_tags(data), size, PoseSettings())
    promised_33 = promised_ground(told, size)
    if promised_33 is None or told.fov_deg is None:
        return None
    assert truth.altitude_m is not None
    assert truth.heading_deg is not None
    assert truth.pitch_deg is not None
    pose = Pose.looking_at_zero(
        altitude_m=truth.altitude_m, heading_deg=truth.heading_deg, pitch_deg=truth.pitch_deg,
        fov_deg=told.fov_deg,
    )  # fmt: skip
    half_m = rng.uniform(*HALF_WINDOW) * float(ground_extent(promised_33, size).max())
    here = LocalPlane(lat=truth.lat, lon=truth.lon)
    [[lat, lon]] = here.to_degrees(rng.uniform(-half_m / 4, half_m / 4, (1, 2))).tolist()
    window = windows.compose(lat, lon, half_m, DENSE_WINDOW_PX)
    if window is None:
        return None
    to_flat_33, flat_size = flat_frame(promised_33, size, 1 / window.metres_per_pixel)
    cells_N2 = grid_points(*flat_size, STRIDE)
    pixels_N2 = apply_homography(np.asarray(np.linalg.inv(to_flat_33)), cells_N2)
    inside_N = ((pixels_N2 > 0) & (pixels_N2 < size)).all(axis=1)
    cells_N2, pixels_N2 = cells_N2[inside_N], pixels_N2[inside_N]
    focal = focal_length_px(pose.fov_deg, size[0])
    aims_N3 = np.c_[pixels_N2 - np.array(size) / 2, np.full(len(pixels_N2), focal)]
    relief = windows.heights(here, 2 * half_m) if windows.heights else None
    met_N2 = meet_relief(pose, aims_N3 @ camera_axes(pose).T, relief)
    met_N2 = window.plane.to_metres(here.to_degrees(met_N2))
    shown_N2 = apply_homography(np.asarray(np.linalg.inv(window.to_ground_33)), met_N2)
    side = len(window.pixels_HW3)
    seen = np.flatnonzero(((shown_N2 > 0) & (shown_N2 < side)).all(axis=1))
    seen = seen[window.shown_HW[tuple(shown_N2[seen].T[::-1].astype(int))] > 0]
    if len(seen) < 2:
        return None
    seen = rng.permutation(seen)[:MOST_CELLS]
    return Pair(
        photo_HW3=warp(image_HW3, to_flat_33, flat_size), window_HW3=window.pixels_HW3,
        cells_N2=cells_N2[seen], shown_N2=shown_N2[seen],
    )  # fmt: skip


def scores(encoder: DenseEncoder, pair: Pair) -> tuple[Tensor, Tensor, Tensor]:
    """Cosines (N, M) of cells and all cells of the window, (N, N) of cells and the pixels that are
    right, and the distances (N, M) in pixels of the window's cells from the right ones."""
    shown_N2 = torch.from_numpy(pair.shown_N2).float()
    photo_ND = sample(encoder.describe(pair.photo_HW3), torch.from_numpy(pair.cells_N2))
    window_1DHW = encoder.describe(pair.window_HW3)
    right_ND = sample(window_1DHW, shown_N2)
    all_MD = window_1DHW[0].flatten(1).T
    rows, columns = torch.meshgrid(*map(torch.arange, window_1DHW.shape[2:]), indexing="ij")
    middles_M2 = (torch.stack([columns.ravel(), rows.ravel()], dim=1) + 0.5) * STRIDE
    return photo_ND @ all_MD.T, photo_ND @ right_ND.T, torch.cdist(shown_N2, middles_M2)


def loss_of(encoder: DenseEncoder, pair: Pair) -> Tensor:
    """InfoNCE: the right pixel among all cells of the window, and the right cell among the
    photo's."""
    to_all_NM, to_right_NN, away_NM = scores(encoder, pair)
    others_NM = to_all_NM.masked_fill(away_NM < NEAR_PX, -torch.inf)
    forward_NK = torch.cat([to_right_NN.diagonal()[:, None], others_NM], dim=1) / TEMPERATURE
    first_N = torch.zeros(len(forward_NK), dtype=torch.int64)
    own_N = torch.arange(len(to_right_NN))
    back = F.cross_entropy(to_right_NN.T / TEMPERATURE, own_N)
    return (F.cross_entropy(forward_NK, first_N) + back) / 2


@torch.no_grad()
def right_share(encoder: DenseEncoder, pairs: list[Pair]) -> float:
    """The share of the photos' cells whose nearest cell of the window is a right one."""
    right = []
    for pair in pairs:
        to_all_NM, _, away_NM = scores(encoder, pair)
        nearest_N1 = to_all_NM.argmax(dim=1, keepdim=True)
        right.append((away_NM.gather(1, nearest_N1) < NEAR_PX).float().mean())
    return float(torch.stack(right).mean())


@dataclass(frozen=True, kw_only=True)
class FlownMap:
    """Photos and the map that they were taken over."""

    photos: list[FlightPhoto]
    windows: MapWindows

    def pairs(self, numbers: Iterable[int], rng: np.random.Generator) -> Iterator[Pair]:
        """Of the photos of these numbers."""
        for number in numbers:
            pair = pair_of(self.photos[number], self.windows, rng)
            if pair is not None:
                yield pair


def open_flown(region: Sequence[str], most: int) -> FlownMap:
    """Raises SystemExit where the tiles do not know their ground."""
    tiles, index, flight, surface = region
    gallery = read_gallery_map(Index(index))
    heights = None if surface == "-" else surface
    windows = open_map(tiles, gallery, index, heights, whole_map=False)
    if windows is None:
        raise SystemExit(1)  # the message has been printed
    return FlownMap(photos=flight_of(flight, most), windows=windows)


def learned_pairs(maps: Sequence[FlownMap], rng: np.random.Generator) -> Iterator[Pair]:
    """Pairs of the photos that are learned from, a map after the other, without end. Raises
    SystemExit where none gives one."""
    while True:
        found = 0
        for flown in maps:
            numbers = [one for one in range(len(flown.photos)) if one % HELD_OUT]
            for pair in flown.pairs(rng.permutation(numbers)[:PHOTOS_A_TURN].tolist(), rng):
                found += 1
                yield pair
        if not found:
            raise SystemExit("no photo has tags and ground of the map, expected some; see jobs/fly")


def train(encoder: DenseEncoder, pairs: Iterator[Pair], steps: int) -> None:
    """The head, by AdamW at a rate that falls along a cosine."""
    head = encoder.head.train()
    optimizer = torch.optim.AdamW(head.parameters(), LEARNING_RATE)
    falling = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    begin, total = time.perf_counter(), 0.0
    for step in range(1, steps + 1):
        losses = [loss_of(encoder, next(pairs)) for _ in range(PAIRS_A_STEP)]
        loss = torch.stack(losses).mean()
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        falling.step()
        total += loss.item()
        if step % 50 == 0:
            seconds = time.perf_counter() - begin
            print(f"step {step}: loss {total / 50:.3f}, {seconds:.0f} s", flush=True)
            total = 0.0
    head.eval()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--region", nargs=4, action="append", required=True,
        metavar=("TILES", "INDEX", "FLIGHT", "SURFACE"),
    )  # fmt: skip
    parser.add_argument("--steps", type=int, default=1200)
    parser.add_argument("--photos", type=int, default=400, help="of a region")
    parser.add_argument("--out", required=True, help="the head's weights")
    options = parser.parse_args()
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    maps = [open_flown(region, options.photos) for region in options.region]
    held = [
        pair for flown in maps for pair in flown.pairs(range(0, len(flown.photos), HELD_OUT), rng)
    ]
    encoder = DenseEncoder()
    before = right_share(encoder, held)
    train(encoder, learned_pairs(maps, rng), options.steps)
    after = right_share(encoder, held)
    half = {name: tensor.half() for name, tensor in encoder.head.state_dict().items()}
    safetensors.torch.save_file(half, options.out)
    print(
        f"cells whose nearest is right: {before:.1%} by random weights, {after:.1%} trained, "
        f"{after / max(before, 1e-9):.2f} x; {len(held)} photos not learned from"
    )


if __name__ == "__main__":
    main()
