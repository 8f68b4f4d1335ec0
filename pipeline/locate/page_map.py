"""Answers on a map, as SVG geometry: gallery images where they lie, candidates, and the circle that
a photo lies in.

In: positions in degrees. Out: pixels. A map is a plane touching the earth at its middle, north up,
which holds over some hundred kilometres. Shapes: N positions, 2 = latitude, longitude; or x to the
right, y downwards, pixels.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.core.arrays import Doubles
from pipeline.core.geo import EARTH_RADIUS_M
from pipeline.locate.gallery_map import GalleryMap
from pipeline.locate.locate import Answer

MAP_SIDE_PX = 320
"Pixels of a map's side, before it is scaled to the page."
MAP_HALF_SPACINGS = 2.6
"""Half the side of a map around a place, in spacings of the gallery: its neighbours are seen, and
theirs in part."""
MAX_TILES = 64
"Gallery images that a map shows at most."
MAX_DOTS = 4000
"Gallery positions that the overview shows at most."
Footprint = Sequence[Sequence[float]]
"Corners, latitude and longitude, from the image's upper left clockwise."


@dataclass(frozen=True, kw_only=True)
class MapFrame:
    """The square of ground that a map shows."""

    lat: float
    lon: float
    half_m: float

    def pixels(self, places_N2: Doubles) -> Doubles:
        """Pixels (N, 2) of positions (N, 2). The difference of longitudes goes the short way round."""
        away_N = (places_N2[:, 1] - self.lon + 180) % 360 - 180
        east_N = EARTH_RADIUS_M * np.radians(away_N) * math.cos(math.radians(self.lat))
        south_N = EARTH_RADIUS_M * np.radians(self.lat - places_N2[:, 0])
        return (
            np.stack([east_N, south_N], axis=1) * (MAP_SIDE_PX / 2 / self.half_m) + MAP_SIDE_PX / 2
        )

    def length(self, metres: float) -> float:
        """Pixels of a length."""
        return metres * MAP_SIDE_PX / 2 / self.half_m

    @property
    def bar_m(self) -> float:
        """A round number of metres that takes a tenth to a quarter of the side."""
        power = 10.0 ** math.floor(math.log10(self.half_m / 2))
        return max(times * power for times in (1, 2, 5) if times * power <= self.half_m / 2)


@dataclass(frozen=True, kw_only=True)
class MapTile:
    """A gallery image on the ground."""

    key: str
    matrix: str
    "Of the SVG transform that brings the unit square to its place."


@dataclass(frozen=True, kw_only=True)
class MapMark:
    """Something at a point of the map."""

    x: float
    y: float
    label: str
    title: str
    kind: str
    "Class of the template's style sheet."


@dataclass(frozen=True, kw_only=True)
class MapView:
    """One map."""

    frame: MapFrame
    summary: str
    "The map in words, for those who cannot see it."
    tiles: tuple[MapTile, ...] = ()
    dots: tuple[tuple[float, float], ...] = ()
    marks: tuple[MapMark, ...] = ()
    circle: tuple[float, float, float] | None = None
    "x, y and radius of the uncertainty."
    line: str = ""
    "Points of the flight's polyline."


def nearby_keys(answer: Answer, gallery: GalleryMap) -> list[str]:
    """The gallery images that the map around an answer may show."""
    if answer.position is None:
        return []
    return [
        str(gallery.keys[number])
        for number in gallery.nearest(answer.position.lat, answer.position.lon, MAX_TILES)
    ]


def position_map(
    answer: Answer, gallery: GalleryMap, footprints: Mapping[str, Footprint]
) -> MapView | None:
    """The surroundings of an answer, drawn with the gallery's own images; None without a position."""
    position = answer.position
    if position is None:
        return None
    spacing = gallery.spacing_m or position.radius_m or 1.0
    half_m = max(MAP_HALF_SPACINGS * spacing, 1.3 * position.radius_m)
    frame = MapFrame(lat=position.lat, lon=position.lon, half_m=half_m)
    tiles = []
    for number in gallery.nearest(position.lat, position.lon, MAX_TILES).tolist():
        key, (lat, lon) = str(gallery.keys[number]), gallery.places_N2[number].tolist()
        corners_32 = frame.pixels(
            np.array(footprints.get(key) or square_footprint(lat, lon, 0.96 * spacing))[[0, 1, 3]]
        )
        if (corners_32.max(axis=0) > 0).all() and (corners_32.min(axis=0) < MAP_SIDE_PX).all():
            tiles.append(MapTile(key=key, matrix=svg_matrix(corners_32)))
    (x, y), *_ = frame.pixels(np.array([[position.lat, position.lon]])).tolist()
    return MapView(
        frame=frame,
        tiles=tuple(reversed(tiles)),
        marks=tuple(candidate_marks(answer, frame)),
        circle=(x, y, frame.length(position.radius_m)),
        summary=f"Map of {2 * half_m:.0f} m around latitude {position.lat:.5f}, longitude {position.lon:.5f}",
    )


def overview_map(
    answers: Sequence[tuple[str, Answer]], gallery: GalleryMap, track: bool
) -> MapView | None:
    """All of the gallery as dots, with a mark for each answer that is known; None where no position
    is known.
    """
    known_N2 = gallery.places_N2[~np.isnan(gallery.places_N2).any(axis=1)][:MAX_DOTS]
    if not len(known_N2):
        return None
    found = [(name, one.position) for name, one in answers if one.known and one.position]
    at_M2 = np.array([(position.lat, position.lon) for _, position in found]).reshape(-1, 2)
    frame = fit_frame(np.concatenate([known_N2, at_M2]))
    points_M2 = frame.pixels(at_M2)
    return MapView(
        frame=frame,
        dots=tuple(map(tuple, frame.pixels(known_N2).round(1).tolist())),
        marks=tuple(
            MapMark(x=x, y=y, label="", title=name, kind="answer")
            for (name, _), (x, y) in zip(found, points_M2.tolist(), strict=True)
        ),
        line=" ".join(f"{x:.1f},{y:.1f}" for x, y in points_M2.tolist()) if track else "",
        summary=f"Map of the whole gallery, {2 * frame.half_m / 1000:.1f} km across, with {len(found)} answers",
    )


def fit_frame(places_N2: Doubles) -> MapFrame:
    """The square around positions; N >= 1. Around the first one, so that the meridian of 180
    degrees is no border.
    """
    lon_N = (places_N2[:, 1] - places_N2[0, 1] + 180) % 360 - 180
    lat = float((places_N2[:, 0].min() + places_N2[:, 0].max()) / 2)
    lon = float((lon_N.min() + lon_N.max()) / 2 + places_N2[0, 1] + 180) % 360 - 180
    half = MapFrame(lat=lat, lon=lon, half_m=MAP_SIDE_PX / 2)  # a pixel is a metre
    return MapFrame(
        lat=lat,
        lon=lon,
        half_m=1.06 * max(float(np.abs(half.pixels(places_N2) - MAP_SIDE_PX / 2).max()), 10.0),
    )


def candidate_marks(answer: Answer, frame: MapFrame) -> list[MapMark]:
    """The candidates that lie within a map, numbered by rank."""
    marks = []
    for rank, hit in enumerate(answer.candidates, 1):
        if hit.lat is None or hit.lon is None:
            continue
        x, y = frame.pixels(np.array([[hit.lat, hit.lon]]))[0].tolist()
        if 0 <= x <= MAP_SIDE_PX and 0 <= y <= MAP_SIDE_PX:
            marks.append(
                MapMark(
                    x=x,
                    y=y,
                    label=str(rank),
                    title=f"{hit.location}, {hit.score:.3f}",
                    kind="candidate",
                )
            )
    return marks


def square_footprint(lat: float, lon: float, side_m: float) -> Footprint:
    """Corners, from the upper left clockwise, of a square of ground with its sides to the north and
    east.
    """
    north = math.degrees(side_m / 2 / EARTH_RADIUS_M)
    east = north / max(math.cos(math.radians(lat)), 1e-6)
    return (
        (lat + north, lon - east),
        (lat + north, lon + east),
        (lat - north, lon + east),
        (lat - north, lon - east),
    )


def svg_matrix(corners_32: Doubles) -> str:
    """The transform that brings (0, 0), (1, 0), (0, 1) to three corners: upper left, upper right,
    lower left.
    """
    origin_2, right_2, down_2 = corners_32
    numbers = [*(right_2 - origin_2), *(down_2 - origin_2), *origin_2]
    return f"matrix({' '.join(f'{number:.2f}' for number in numbers)})"
