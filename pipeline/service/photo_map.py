"""The map's pixels behind an index: photos are framed as its tiles and matched with them, and pages
show them.

In: readers of the gallery's images. Out: framed photos, refined answers, pictures as WebP. Nothing
here breaks an answer: what fails leaves the photo as it is, or the tile's answer.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pipeline.camera.framing import PhotoViews, views_of_photo
from pipeline.core.arrays import Pixels
from pipeline.images.camera_tags import CameraTags
from pipeline.images.thumbnails import ImageLoader, shrink_to_webp, thumbnail_bytes
from pipeline.locate.calibration import Calibration
from pipeline.locate.gallery_map import GalleryMap
from pipeline.locate.locate import Answer
from pipeline.locate.refined import refine_answer, with_refinement
from pipeline.matching.map_windows import MapWindows
from pipeline.matching.photo_features import MatchablePhoto, prepare_photo
from pipeline.matching.photo_pose import PoseSettings, pose_of_photo

Pictures = Literal["none", "tiles", "map"]
"What pages can show of the gallery: nothing, its images, or these put together as a map as well."
TILE_PX, GROUND_PX = 180, 640
"Sides of a gallery image's picture and of a map's, at most."


@dataclass(frozen=True, kw_only=True)
class TilePicture:
    """A gallery image, small."""

    key: str


@dataclass(frozen=True, kw_only=True)
class GroundPicture:
    """The map within `half_m` metres of a position, north up."""

    lat: float
    lon: float
    half_m: float


PictureRequest = TilePicture | GroundPicture


@dataclass(frozen=True, kw_only=True)
class FramedPhoto:
    """A photo as an index is searched by it, and as it is matched."""

    views: PhotoViews
    "Each is embedded; the best candidates of all are taken."
    matchable: MatchablePhoto | None = None
    "None where it is not to be matched."
    seconds: float = 0.0
    "That its framing and its features took."
    error: str | None = None
    "Why it is neither framed nor matched, where that failed."


@dataclass(frozen=True, kw_only=True)
class Located:
    """An answer, and how matching went."""

    answer: Answer
    pictures: Pictures = "none"
    match_seconds: float | None = None
    "That framing and matching took; None where the photo was not matched."
    match_error: str | None = None
    "Why the answer is a tile's, where matching failed."


class PhotoMap:
    """The pixels of one index's gallery. One thread at a time matches."""

    def __init__(
        self,
        gallery: GalleryMap,
        fetch: ImageLoader,
        windows: MapWindows | None,
        match: bool = True,
    ) -> None:
        """`windows`: None where the ground that images show is not known."""
        self._fetch, self._windows = fetch, windows
        self._sides_m = windows.tile_sides_m() if windows else []
        self.matches = match and windows is not None
        self._kinds = {_kind(str(key)) for key in gallery.keys}
        self.pictures: Pictures = "map" if windows else "tiles"

    def frame(self, photo_HW3: Pixels, tags: CameraTags, known: PoseSettings) -> FramedPhoto:
        """The photo as the tiles are framed, as far as its tags and `known` tell the camera."""
        if not self.matches:
            return FramedPhoto(views=PhotoViews(images=[photo_HW3]))
        began = time.perf_counter()
        size = (photo_HW3.shape[1], photo_HW3.shape[0])
        try:
            pose = pose_of_photo(tags, size, known)
            views = views_of_photo(photo_HW3, pose, self._sides_m)
            matchable = prepare_photo(photo_HW3, pose)
        except Exception as error:  # OpenCV and NumPy each raise their own over absurd poses
            return FramedPhoto(views=PhotoViews(images=[photo_HW3]), error=_sentence(error))
        seconds = time.perf_counter() - began
        return FramedPhoto(views=views, matchable=matchable, seconds=seconds)

    def refine(
        self, answer: Answer, photo: FramedPhoto, calibration: Calibration | None = None
    ) -> Located:
        """The answer at the place that matching finds, where that holds; else as it was, with the
        probability that the index's calibration gives such photos."""
        located = Located(answer=answer, pictures=self.pictures, match_error=photo.error)
        if photo.matchable is None or self._windows is None:
            return located
        began = time.perf_counter()
        try:
            found = refine_answer(answer, photo.matchable, self._windows)
            located = replace(located, answer=with_refinement(answer, found, calibration))
        except Exception as error:  # a damaged tar, a folder that went away, OpenCV's own
            located = replace(located, match_error=_sentence(error))
        return replace(located, match_seconds=photo.seconds + time.perf_counter() - began)

    def picture(self, wanted: PictureRequest) -> bytes | None:
        """A WebP; None where the gallery shows nothing there, or has no such image."""
        if isinstance(wanted, TilePicture):
            # Shards hold photos beside the gallery; only the gallery's views are shown.
            images = self._fetch([wanted.key]) if _kind(wanted.key) in self._kinds else {}
            return thumbnail_bytes(images.get(wanted.key), TILE_PX)
        if self._windows is None:
            return None
        window = self._windows.compose(wanted.lat, wanted.lon, wanted.half_m, GROUND_PX)
        if window is None:
            return None
        return shrink_to_webp(np.dstack([window.pixels_HW3, window.shown_HW]), GROUND_PX)


MapOpener = Callable[[GalleryMap], PhotoMap | None]
"Opens the pixels of an index's gallery; None where there are none. Raises InputError."


def no_map(gallery: GalleryMap) -> None:
    """An index whose gallery's pixels are not at hand."""


def _kind(key: str) -> str:
    """Split and view, which begin a key."""
    return "-".join(key.split("-", 2)[:2])


def _sentence(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
