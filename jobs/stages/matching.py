"""Photos of any storage matched with the map's pixels: opens the tiles, reads photos, refines.

In: queries with their answers, and the shards that the index was made of. Out: the answers within
metres where matching holds.
"""

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from rasterio.errors import RasterioError

from jobs.encoding.dense_features import BuiltinDenseFinder
from jobs.encoding.photo_encoder import decode_photo
from jobs.encoding.queries import Query, ViewMaker, read_photo
from pipeline.camera.framing import PhotoViews, views_of_photo
from pipeline.camera.local_plane import LocalPlane
from pipeline.camera.overhead import overhead_view
from pipeline.core import storage
from pipeline.core.arrays import Pixels
from pipeline.core.errors import InputError
from pipeline.core.integrity import sha256_of
from pipeline.core.prefetch import prefetch_map
from pipeline.core.progress import console, progress
from pipeline.core.records import Rejection
from pipeline.images.camera_tags import CameraTags
from pipeline.locate.calibration import Calibration
from pipeline.locate.gallery_map import GalleryMap
from pipeline.locate.locate import Answer
from pipeline.locate.refined import refine_answer, with_refinement
from pipeline.matching.kept_features import MAP_FEATURES_FILE, FeatureFile
from pipeline.matching.map_features import MapSearch
from pipeline.matching.map_windows import HeightReader, MapWindows
from pipeline.matching.photo_features import MatchablePhoto, prepare_photo
from pipeline.matching.photo_pose import PoseSettings, pose_of_photo
from pipeline.matching.refine import Refinement
from pipeline.matching.relief import Relief
from pipeline.service.photo_map import PhotoMap
from pipeline.shards.manifest import MANIFEST
from pipeline.shards.shard_set import open_shards
from pipeline.shards.tile_reader import TileReader
from pipeline.sources.maps.heights import read_heights
from pipeline.sources.maps.mosaic import open_mosaic

AHEAD = 4
"Photos that are read while another is matched."
HEIGHT_PIXEL_M = 0.5
"Side of a pixel of the heights, metres."
Matcher = Callable[[Answer, MatchablePhoto, MapWindows], Refinement | None]
"Matches a photo with the map where its answer says."


def open_map(
    shards: str,
    gallery: GalleryMap,
    index: str,
    surface: str | None = None,
    whole_map: bool = True,
    dense: bool = True,
) -> MapWindows | None:
    """The windows of a map, with the heights of a surface model, with `whole_map` a search for
    places by all of its features, which are kept beside the index, and with `dense` those features
    too. None, with a message, where its tiles do not know their corners: these are in the record
    tables of jobs/make_shards.py, which shards of others lack. Raises InputError for a surface
    model that cannot be read."""
    reader = _open_tiles(shards)
    windows = None if reader is None else _windows_of(reader, gallery, surface, dense)
    if windows is not None and whole_map:
        kept = _feature_file(shards, gallery, index)
        windows.search = MapSearch(kept.read, partial(kept.make, windows))
    if windows is None:
        console.print(
            f"the images of {shards} do not say which ground their corners show: photos are not "
            "matched with them, and positions are those of tiles"
        )
    return windows


def open_photo_map(
    shards: str, match: bool, dense: bool, index: str, surface: str | None, gallery: GalleryMap
) -> PhotoMap | None:
    """The pixels of a map for the service; None for shards of others. Places are searched by
    features of the whole map where they are kept beside the index: no request waits for them.
    Raises InputError for a surface model that cannot be read."""
    reader = _open_tiles(shards)
    if reader is None:
        return None
    windows = _windows_of(reader, gallery, surface, dense)
    if windows is not None and match:
        windows.search = MapSearch(_feature_file(shards, gallery, index).read, lambda: None)
    return PhotoMap(gallery, reader.fetch, windows, match)


def _feature_file(shards: str, gallery: GalleryMap, index: str) -> FeatureFile:
    manifest = storage.read_bytes(storage.join(shards, MANIFEST))
    return FeatureFile(
        path=storage.join(index, MAP_FEATURES_FILE),
        belongs_to=f"{sha256_of(manifest)} {gallery.rows}",
    )


def _open_tiles(shards: str) -> TileReader | None:
    manifest = storage.join(shards, MANIFEST)
    return TileReader(open_shards(shards)) if storage.exists(manifest) else None


def _windows_of(
    reader: TileReader, gallery: GalleryMap, surface: str | None, dense: bool
) -> MapWindows | None:
    if not len(gallery.keys) or not reader.footprints([str(gallery.keys[0])]):
        return None
    windows = MapWindows(gallery, reader.fetch, reader.footprints)
    windows.heights = None if surface is None else height_reader(surface)
    windows.dense = BuiltinDenseFinder() if dense else None
    return windows


def height_reader(surface: str) -> HeightReader:
    """Reads heights of a surface model. Raises InputError where there is none to be read."""
    try:
        placed = open_mosaic(surface).crs is not None
    except RasterioError as error:
        raise InputError(
            f"{surface} cannot be read ({error}), expected a GeoTIFF of heights in metres; check "
            "--surface"
        ) from None
    if not placed:
        raise InputError(
            f"{surface} has no coordinate system, expected a georeferenced surface model; check "
            "--surface"
        )

    def read(plane: LocalPlane, half_m: float) -> Relief | None:
        height_HW = read_heights(surface, plane, round(2 * half_m / HEIGHT_PIXEL_M), HEIGHT_PIXEL_M)
        missing_HW = np.isnan(height_HW)
        if missing_HW.all():
            return None
        height_HW[missing_HW] = np.nanmedian(height_HW)
        return Relief(height_HW=height_HW, metres_per_pixel=HEIGHT_PIXEL_M)

    return read


def view_maker(sides_m: Sequence[float], pose: PoseSettings) -> ViewMaker:
    """Frames photos as tiles of these sides (metres, rising), as far as tags and flags tell the
    camera."""

    def make_views(photo_HW3: Pixels, tags: CameraTags) -> PhotoViews:
        known = pose_of_photo(tags, (photo_HW3.shape[1], photo_HW3.shape[0]), pose)
        return views_of_photo(photo_HW3, known, sides_m)

    return make_views


def overhead_maker(pose: PoseSettings) -> ViewMaker:
    """Lays photos on the ground north up, as an encoder of that perspective sees them, as far as
    tags and flags tell the camera."""

    def make_views(photo_HW3: Pixels, tags: CameraTags) -> PhotoViews:
        known = pose_of_photo(tags, (photo_HW3.shape[1], photo_HW3.shape[0]), pose)
        return PhotoViews(images=[overhead_view(photo_HW3, vars(known))])

    return make_views


def matchable_photo(photo_HW3: Pixels, tags: CameraTags, pose: PoseSettings) -> MatchablePhoto:
    """The photo's features, with what its tags and the flags say of the camera."""
    height, width = photo_HW3.shape[:2]
    return prepare_photo(photo_HW3, pose_of_photo(tags, (width, height), pose))


def match_photos(
    queries: Sequence[Query],
    answers: Sequence[Answer],
    windows: MapWindows,
    pose: PoseSettings,
    match: Matcher = refine_answer,
) -> list[Refinement | None]:
    """Single photos matched with the map, in their order: around their answers and candidates, or
    where `match` looks; None where no view holds."""
    found: list[Refinement | None] = []
    with progress(len(queries), "matching", "photos") as meter:
        contents = prefetch_map(read_photo, [query.photos[0] for query in queries], AHEAD, AHEAD)
        for query, answer, data in zip(queries, answers, contents, strict=True):
            if isinstance(data, Rejection):  # it was removed since it was embedded
                found.append(None)
            else:
                photo = matchable_photo(decode_photo(data), query.tags, pose)
                found.append(match(answer, photo, windows))
            meter.advance()
    return found


def refine_answers(
    queries: Sequence[Query],
    answers: Sequence[Answer],
    windows: MapWindows,
    pose: PoseSettings,
    calibration: Calibration | None,
) -> list[Answer]:
    """The answers of single photos, in their order, refined where that holds."""
    found = match_photos(queries, answers, windows, pose)
    return [
        with_refinement(answer, refinement, calibration)
        for answer, refinement in zip(answers, found, strict=True)
    ]
