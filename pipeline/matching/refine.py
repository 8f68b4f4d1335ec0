"""A photo and windows of the map -> the place that the photo shows, within metres.

In: a photo's pixels, windows around candidate positions, and what is known of the camera. Out: a
`Refinement`, or None where no window holds a view that a camera can have.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np

from pipeline.camera.ground import (
    apply_homography,
    camera_above,
    corners,
    heading_of,
)
from pipeline.camera.local_plane import LocalPlane
from pipeline.camera.map_window import MapWindow
from pipeline.camera.uncertainty import Ellipse, ellipse_of
from pipeline.core.arrays import Doubles, Floats, Ints
from pipeline.matching.ground_fit import (
    GroundFit,
    agree_with_promise,
    fit_ground,
    fit_turned,
    is_camera_view,
    turned_alike,
)
from pipeline.matching.local_features import (
    DenseFinder,
    LocalFeatures,
    find_features,
    match_features,
    match_mutually,
)
from pipeline.matching.photo_features import (
    MatchablePhoto,
    ground_extent,
    with_dense_features,
)
from pipeline.matching.relief import Relief, fit_relief

WINDOW_FEATURES = 6000
DENSE_WINDOW_STEP_PX = 4
"Between its dense features: half that of the photo's."
TOLERANCE_PX = 4.0
"Of an inlier, in pixels of the window."
ALONE_RATIO, PROMISED_RATIO = 0.85, 0.95
"""Of the distances of the nearest and the second nearest descriptor. Where a pose promises the
ground, more doubtful pairs may come: it sorts them out."""
ENOUGH_INLIERS, ENOUGH_DENSE_INLIERS = 60, 200
"A window with so many ends the search for a better one."
MOST_SCALE = 4.0
"Between a footprint's sides and those that the pose promises: height above take-off errs."
MOST_TURN_DEG = 45.0
"Between a heading and the one that the pose promises."
POINTS_KEPT = 40
"Of the inliers, spread over all of them: enough to see what a refinement rests on."


@dataclass(frozen=True, kw_only=True)
class MatchedPoint:
    """A point of the photo, and the point of the map that looks like it."""

    x: float
    "Share of the photo's width, from its left."
    y: float
    "Share of the photo's height, from its top."
    lat: float
    "Of the map's point, WGS84."
    lon: float
    "Degrees east."


@dataclass(frozen=True, kw_only=True)
class Refinement:
    """Where a photo lies on the map."""

    lat: float
    "Of the ground in the photo's middle, WGS84."
    lon: float
    "Degrees east."
    ellipse: Ellipse
    "95 % of its error, by the spread of the matches, if they are right."
    heading_deg: float
    "Of the image's top in the photo's middle, clockwise from true north."
    footprint: tuple[tuple[float, float], ...]
    "Corners (lat, lon) of the ground shown, from the photo's upper left clockwise."
    camera: tuple[float, float, float] | None
    "The camera's own latitude, longitude and height above the ground, where the lens is known."
    inliers: int
    "Matches that agree with one view of a camera."
    matches: int
    "Points of the photo and of the map that look alike."
    residual_m: float
    "Root mean square distance of the inliers on the ground."
    promised: bool
    "Whether the camera's pose promised the ground: doubtful matches come then too."
    dense: bool = False
    "Whether dense features carry it, of which even a wrong view has dozens of inliers."
    points: tuple[MatchedPoint, ...] = ()
    "Some of the inliers, at most 40."


@dataclass(frozen=True, kw_only=True)
class MatchableWindow:
    """The features of a window of the map."""

    plane: LocalPlane
    metres_per_pixel: float
    ground_N2: Doubles
    "(east, north) in metres from the plane's zero."
    descriptors_ND: Floats
    angles_N: Floats | None = None
    "How they are turned on the north-up map, degrees clockwise; None where they know no turn."
    relief: Relief | None = None
    "The heights of the ground, where they are known; else it is taken for flat."


def prepare_window(window: MapWindow) -> MatchableWindow:
    """The features of a window."""
    return _matchable(window, find_features(window.pixels_HW3, WINDOW_FEATURES, window.shown_HW))


def prepare_dense_window(window: MapWindow, find: DenseFinder) -> MatchableWindow:
    """The dense features of a window."""
    return _matchable(window, find(window.pixels_HW3, DENSE_WINDOW_STEP_PX, window.shown_HW))


def _matchable(window: MapWindow, found: LocalFeatures) -> MatchableWindow:
    return MatchableWindow(
        plane=window.plane,
        metres_per_pixel=window.metres_per_pixel,
        ground_N2=apply_homography(window.to_ground_33, found.points_N2),
        descriptors_ND=found.descriptors_ND,
        angles_N=found.angles_N,
    )


def refine(photo: MatchablePhoto, windows: Iterable[MatchableWindow]) -> Refinement | None:
    """The refinement of the most inliers among the windows; those after one of ENOUGH_INLIERS are
    not tried."""
    return _most_inliers(((photo, window) for window in windows), ENOUGH_INLIERS)


def refine_densely(
    photo: MatchablePhoto, windows: Iterable[MatchableWindow], find: DenseFinder
) -> Refinement | None:
    """The refinement by dense features of the most inliers among the windows; those after one of
    ENOUGH_DENSE_INLIERS are not tried. None where no view holds, or the photo's pose promises no
    ground."""
    if photo.promised_33 is None:
        return None
    at_scale = cache(partial(with_dense_features, photo, find))
    pairs = ((at_scale(window.metres_per_pixel), window) for window in windows)
    found = _most_inliers(pairs, ENOUGH_DENSE_INLIERS)
    return found and replace(found, dense=True)


def _most_inliers(
    pairs: Iterable[tuple[MatchablePhoto, MatchableWindow]], enough: int
) -> Refinement | None:
    best: Refinement | None = None
    for photo, window in pairs:
        found = refine_in(photo, window)
        if found is not None and (best is None or found.inliers > best.inliers):
            best = found
            if best.inliers >= enough:
                break
    return best


def refine_in(photo: MatchablePhoto, window: MatchableWindow) -> Refinement | None:
    """The refinement by one window; None where no homography holds, or no camera makes it."""
    pairs_M2 = _pairs(photo, window)
    photo_M2 = photo.features.points_N2[pairs_M2[:, 0]]
    ground_M2 = window.ground_N2[pairs_M2[:, 1]]
    turn_M = _turns(photo.features, window, pairs_M2)
    tolerance_m = TOLERANCE_PX * window.metres_per_pixel
    if photo.promised_33 is not None:
        # Its features were found on the photo as it lies on the ground, north up.
        agree_M = np.ones(len(pairs_M2), np.bool_) if turn_M is None else turned_alike(turn_M, 0.0)
        photo_M2, ground_M2 = photo_M2[agree_M], ground_M2[agree_M]
        agree_M = agree_with_promise(apply_homography(photo.promised_33, photo_M2), ground_M2)
        photo_M2, ground_M2 = photo_M2[agree_M], ground_M2[agree_M]
    if photo.promised_33 is not None or turn_M is None:
        fit = fit_ground(photo_M2, ground_M2, photo.size, tolerance_m)
    else:
        heading = photo.pose.heading_deg
        fit = fit_turned(photo_M2, ground_M2, turn_M, heading, photo.size, tolerance_m)
    if fit is not None and window.relief is not None:
        fit = fit_relief(
            photo_M2, ground_M2, window.relief, fit, photo.size, photo.pose.fov_deg, tolerance_m
        )
    if fit is None or not is_camera_view(fit.to_ground_33, photo.size):
        return None
    if not _fits_the_pose(fit.to_ground_33, photo):
        return None
    inliers = fit.inliers_M
    points = _points(photo_M2[inliers], ground_M2[inliers], photo.size, window)
    return _refinement(fit, photo, window, len(photo_M2), points)


def _pairs(photo: MatchablePhoto, window: MatchableWindow) -> Ints:
    """Numbers (M, 2) of points of the photo and of the window that look alike. Neighbouring dense
    features show nearly the same, so that each other's nearest is enough."""
    one_ND, other_ND = photo.features.descriptors_ND, window.descriptors_ND
    if photo.features.angles_N is None:
        return match_mutually(one_ND, other_ND)
    ratio = ALONE_RATIO if photo.promised_33 is None else PROMISED_RATIO
    return match_features(one_ND, other_ND, ratio)


def _turns(features: LocalFeatures, window: MatchableWindow, pairs_M2: Ints) -> Floats | None:
    """Degrees (M,) by which points are turned further on the map; None where that is not known."""
    if features.angles_N is None or window.angles_N is None:
        return None
    return window.angles_N[pairs_M2[:, 1]] - features.angles_N[pairs_M2[:, 0]]


def _points(
    photo_K2: Doubles, ground_K2: Doubles, size: tuple[int, int], window: MatchableWindow
) -> tuple[MatchedPoint, ...]:
    """POINTS_KEPT of the inliers, from the photo's left to its right."""
    order = np.argsort(photo_K2[:, 0], kind="stable")
    kept = order[np.unique(np.linspace(0, len(order) - 1, POINTS_KEPT).round().astype(int))]
    shares = (photo_K2[kept] / size).tolist()
    positions = window.plane.to_degrees(ground_K2[kept]).tolist()
    return tuple(
        MatchedPoint(x=round(x, 4), y=round(y, 4), lat=round(lat, 7), lon=round(lon, 7))
        for (x, y), (lat, lon) in zip(shares, positions, strict=True)
    )


def _fits_the_pose(to_ground_33: Doubles, photo: MatchablePhoto) -> bool:
    """Whether heading and size of the footprint are near what is known of the camera."""
    pose = photo.pose
    if pose.heading_deg is not None:
        turn = (heading_of(to_ground_33, photo.size) - pose.heading_deg + 180) % 360 - 180
        if abs(turn) > MOST_TURN_DEG:
            return False
    if photo.promised_33 is not None:
        sides_2 = ground_extent(photo.promised_33, photo.size)
        found_2 = ground_extent(to_ground_33, photo.size)
        ratio = float(np.sqrt((found_2 / sides_2).prod()))
        return 1 / MOST_SCALE < ratio < MOST_SCALE
    return True


def _refinement(
    fit: GroundFit,
    photo: MatchablePhoto,
    window: MatchableWindow,
    matches: int,
    points: tuple[MatchedPoint, ...],
) -> Refinement:
    width, height = photo.size
    shown_52 = np.concatenate([corners(photo.size), [[width / 2, height / 2]]])
    *outline, (lat, lon) = window.plane.to_degrees(
        apply_homography(fit.to_ground_33, shown_52)
    ).tolist()
    camera = None
    if photo.pose.fov_deg is not None:
        east, north, up = camera_above(fit.to_ground_33, photo.size, photo.pose.fov_deg)
        [[camera_lat, camera_lon]] = window.plane.to_degrees(np.array([[east, north]])).tolist()
        camera = (camera_lat, camera_lon, up)
    return Refinement(
        lat=lat,
        lon=lon,
        ellipse=ellipse_of(fit.middle_covariance_22),
        heading_deg=heading_of(fit.to_ground_33, photo.size),
        footprint=tuple((corner[0], corner[1]) for corner in outline),
        camera=camera,
        inliers=fit.inliers,
        matches=matches,
        residual_m=fit.residual_m,
        promised=photo.promised_33 is not None,
        points=points,
    )
