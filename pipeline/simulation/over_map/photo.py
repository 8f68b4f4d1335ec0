"""Simulated UAV photos of one place of a map: a GeoTIFF, a seed and a number come in, JPEG bytes
with the cameras' tags and the true position go out.

A pure function of its spec and the map. The ground is the map's own pixels, on another day's
season, haze and sensor; with a surface model it has relief, parallax and another sun's shadows, and
without one it is flat and its shadows stay as in the map.
"""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
import simplejpeg
from rasterio.enums import Resampling

from pipeline.camera.local_plane import LocalPlane
from pipeline.camera.map_window import MapWindow, Tile, compose_window
from pipeline.camera.pose import Pose
from pipeline.core.errors import InputError
from pipeline.simulation.appearance import Day, sample_day
from pipeline.simulation.over_map.photo_tags import with_camera_tags
from pipeline.simulation.over_map.poses import draw_poses, reach_m, spiral_poses, survey_pose
from pipeline.simulation.over_map.settings import MapFlightSettings, Part
from pipeline.simulation.relight import find_day
from pipeline.simulation.render import render_perspective
from pipeline.simulation.scene import REACH_IN_RADII, prepare_scene
from pipeline.simulation.texture import photographed_world
from pipeline.simulation.world import FloatMap, World
from pipeline.sources.maps.heights import read_heights
from pipeline.sources.maps.mosaic import colours_for, open_mosaic, read_window
from pipeline.sources.maps.placement import MosaicRejected, Placement, place_mosaic
from pipeline.sources.maps.tiles import Window

JPEG_QUALITY = 88
MOST_TRIES = 60
"Windows that are read for a place until one shows enough of the map."
LEAST_SHOWN = 0.98
"Of the ground around a photo: its share that the map has."
MOST_DRAWS = 3000
"Places that are drawn until one lies in the flight's part of the map, far enough from its edge."
BLOCK_M, HELD_OUT_BLOCKS, MARGIN_SHARE = 160.0, 5, 0.2
"""Side of a block; one block in so many is held out; and the share of its side by which a held-out
place keeps away from its border."""
DETAIL = 0.7
"Of the ground that a photo's pixel shows at best: a finer map is read no finer."
OVERHEAD_QUALITY = 92
MOST_WITHOUT_HEIGHT = 0.1
"Likewise, the share that a surface model may lack, at the map's edge and in its gaps."
BLUR_PX = (0.4, 1.1)
"Range of the lens' blur, standard deviation in pixels."


@dataclass(frozen=True, kw_only=True)
class MapPhoto:
    """A photo and its truth."""

    jpeg: bytes
    pose: Pose
    "The true one; x and y from the ground in the photo's middle."


@dataclass(frozen=True, kw_only=True)
class MapPlace:
    """A place of a map with its photos."""

    lat: float
    "Of the ground in the photos' middle, WGS84."
    lon: float
    photos: list[MapPhoto]
    overhead: bytes | None
    "Its piece of the map as JPEG, where it is asked for."


def photos_over_map(settings: MapFlightSettings, place: int, count: int) -> MapPlace:
    """`count` photos of place number `place` of a flight.

    Raises InputError where the map has no place for them, or cannot be used.
    """
    spiral = settings.plan == "spiral"
    rng = np.random.default_rng([settings.seed, place])
    for_place = np.random.default_rng(settings.seed) if spiral else rng
    try:
        placement = place_mosaic(settings.mosaic, None, False)
    except MosaicRejected as rejected:
        raise InputError(
            f"{settings.mosaic} cannot be flown over: {rejected.reason} ({rejected.found}); "
            "expected a georeferenced GeoTIFF"
        ) from None
    tries = 0
    for _ in range(MOST_DRAWS):
        if settings.plan == "survey":
            poses, middle = survey_pose(settings, placement, place)
        else:
            poses = (
                spiral_poses(settings, for_place)
                if spiral
                else draw_poses(settings, for_place, count)
            )
            middle = _draw_point(settings, placement, for_place)
        reaches_m = [reach_m(pose) for pose in poses]
        detail_m = DETAIL * min(_pixel_below_m(pose, settings.size) for pose in poses)
        if _edge_m(settings.mosaic, placement, middle) < 0.95 * max(reaches_m):
            continue  # known without reading
        widest = _window_around(settings.mosaic, placement, middle, max(reaches_m), detail_m)
        if widest.shown_HW.mean() >= LEAST_SHOWN * 255:
            break
        if (tries := tries + 1) == MOST_TRIES:
            raise InputError(
                f"{settings.mosaic} shows no ground for place {place} in {MOST_TRIES} tries: found "
                f"{widest.shown_HW.mean() / 255:.0%} of the ground around the last one, expected "
                f"{LEAST_SHOWN:.0%}; fly lower or steeper, or give a map without such gaps"
            )
    else:
        raise InputError(
            f"{settings.mosaic} is too small: no place in {MOST_DRAWS:,} lies as far from its edge "
            f"as a photo reaches, some {max(reaches_m):.0f} m; fly lower or steeper, or give a "
            "larger map"
        )
    heights_HW = _heights(settings.surface, widest)
    day = _day_of(settings, widest, heights_HW)
    photos = []
    for pose in poses[place : place + 1] if spiral else poses:
        window, of_window_HW = widest, heights_HW
        if reach_m(pose) < max(reaches_m):
            window = _window_around(settings.mosaic, placement, middle, reach_m(pose), detail_m)
            of_window_HW = _heights(settings.surface, window)
        photos.append(_take(settings, _world(window, of_window_HW, day), pose, rng))
    overhead = None
    if settings.overhead_m is not None and settings.location_of(place) == place:
        piece = _window_around(settings.mosaic, placement, middle, settings.overhead_m / 2)
        overhead = simplejpeg.encode_jpeg(
            piece.pixels_HW3, quality=OVERHEAD_QUALITY, colorspace="RGB"
        )
    return MapPlace(lat=widest.plane.lat, lon=widest.plane.lon, photos=photos, overhead=overhead)


def _day_of(
    settings: MapFlightSettings, window: MapWindow, heights_HW: FloatMap | None
) -> Day | None:
    """The day whose light is in the map, where it is to be replaced and heights show its sun."""
    if heights_HW is None or not settings.relight:
        return None
    return find_day(window.pixels_HW3, heights_HW, window.metres_per_pixel)


def _take(
    settings: MapFlightSettings, world: World, pose: Pose, rng: np.random.Generator
) -> MapPhoto:
    """One photo of a world's middle, on a day of its own."""
    middle = len(world.height_HW) // 2
    ground_m = float(world.height_HW[middle, middle])
    raised = replace(pose, altitude_m=pose.altitude_m + ground_m)
    frame_SS3 = render_perspective(
        prepare_scene(world, sample_day(rng)), raised, size=settings.size, rng=rng
    )
    frame_SS3 = np.asarray(cv2.GaussianBlur(frame_SS3, (0, 0), rng.uniform(*BLUR_PX)), np.uint8)
    jpeg: bytes = simplejpeg.encode_jpeg(frame_SS3, quality=JPEG_QUALITY, colorspace="RGB")
    told = _told(pose, settings, rng)
    return MapPhoto(jpeg=with_camera_tags(jpeg, told, settings.size), pose=pose)


def _draw_point(
    settings: MapFlightSettings, placement: Placement, rng: np.random.Generator
) -> tuple[float, float]:
    """Column and row of a random pixel of the flight's part of the map.

    Raises InputError where the map has hardly any such.
    """
    dataset = open_mosaic(settings.mosaic)
    across_m, down_m = placement.pixel_m
    for _ in range(MOST_DRAWS):
        x, y = rng.uniform(0, dataset.width), rng.uniform(0, dataset.height)
        if is_in_part(settings.part, x * across_m, y * down_m):
            return float(x), float(y)
    raise InputError(
        f"{settings.mosaic} has no ground in blocks that are {settings.part}, expected a map of "
        f"several blocks of {BLOCK_M:g} m; give a larger map, or --part all"
    )


def is_in_part(part: Part, x_m: float, y_m: float) -> bool:
    """Whether a point, metres from the map's corner, belongs to a part of the map."""
    if part == "all":
        return True
    (column, right), (row, down) = divmod(x_m / BLOCK_M, 1), divmod(y_m / BLOCK_M, 1)
    held_out = (column + 2 * row) % HELD_OUT_BLOCKS == 0
    if part == "learn":
        return not held_out
    return held_out and max(abs(right - 0.5), abs(down - 0.5)) < 0.5 - MARGIN_SHARE


def _edge_m(path: str, placement: Placement, middle: tuple[float, float]) -> float:
    """Metres from one of a map's pixels (column, row) to its nearest edge."""
    dataset, (across_m, down_m) = open_mosaic(path), placement.pixel_m
    x, y = middle
    return float(min(min(x, dataset.width - x) * across_m, min(y, dataset.height - y) * down_m))


def _pixel_below_m(pose: Pose, size: int) -> float:
    """The ground straight below the camera that a pixel of a photo of so many shows, metres."""
    return 2 * pose.altitude_m * math.tan(math.radians(pose.fov_deg) / 2) / size


def _window_around(
    path: str,
    placement: Placement,
    middle: tuple[float, float],
    half_m: float,
    detail_m: float = 0.0,
) -> MapWindow:
    """The map around one of its pixels (column, row), north up, at its own resolution, or at
    `detail_m` metres a pixel if it is finer."""
    dataset = open_mosaic(path)
    x, y = middle
    [[lat, lon]] = placement.georeference.degrees(np.array([[x, y]])).tolist()
    plane = LocalPlane(lat=lat, lon=lon)
    # The diagonal: the map may be turned against north.
    across, down = (1.45 * half_m / side for side in placement.pixel_m)
    left, top = max(0, int(x - across)), max(0, int(y - down))
    right, bottom = min(dataset.width, int(x + across) + 1), min(dataset.height, int(y + down) + 1)
    part = Window(x=left, y=top, width=right - left, height=bottom - top)
    colours = colours_for(path, None)
    pixel_m = max(min(placement.pixel_m), detail_m)
    size = tuple(
        max(1, round(count * side_m / pixel_m))
        for count, side_m in zip((part.width, part.height), placement.pixel_m, strict=True)
    )
    pixels_HW3 = read_window(path, part, (size[0], size[1]), Resampling.average, colours)
    [tag] = placement.georeference.geotags([part])
    if tag is None or tag.footprint is None:
        raise InputError(f"{path} has ground without a position, expected one; cut the map")
    tile = Tile(read=lambda: pixels_HW3, footprint=tag.footprint, metres_per_pixel=pixel_m)
    window = compose_window(plane, [tile], half_m, pixel_m)
    if colours.gaps:  # black is a gap there
        window.shown_HW[~window.pixels_HW3.any(axis=2)] = 0
    return window


def _heights(path: str | None, window: MapWindow) -> FloatMap | None:
    """Metres (H, W) above the lowest ground of a window, by a surface model in any CRS; None
    without one."""
    if path is None:
        return None
    plane, side = window.plane, len(window.pixels_HW3)
    heights_HW = read_heights(path, plane, side, window.metres_per_pixel)
    if np.isnan(heights_HW).mean() > MOST_WITHOUT_HEIGHT:
        raise InputError(
            f"{path} has no heights around latitude {plane.lat:.5f}, longitude {plane.lon:.5f}; "
            "expected a surface model of the same ground as the map; give one, or none"
        )
    lowest = np.nanmin(heights_HW)
    return np.where(np.isnan(heights_HW), 0, heights_HW - lowest).astype(np.float32)


def _world(window: MapWindow, heights_HW: FloatMap | None, day: Day | None) -> World:
    side = len(window.pixels_HW3)
    return photographed_world(
        window.pixels_HW3,
        np.zeros((side, side), np.float32) if heights_HW is None else heights_HW,
        metres_per_pixel=window.metres_per_pixel,
        # The scene's mirrored margin follows from it: none is needed.
        target_radius_m=side * window.metres_per_pixel / 2 / REACH_IN_RADII,
        day=day,
    )


def _told(pose: Pose, settings: MapFlightSettings, rng: np.random.Generator) -> Pose:
    """The pose as the camera's sensors state it."""
    return replace(
        pose,
        altitude_m=pose.altitude_m * (1 + settings.height_error * rng.normal()),
        heading_deg=(pose.heading_deg + settings.heading_error * rng.normal()) % 360,
        pitch_deg=max(-90.0, pose.pitch_deg + settings.pitch_error * rng.normal()),
    )
