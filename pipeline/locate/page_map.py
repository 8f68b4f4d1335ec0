"""The maps of the answer page as SVG geometry: gallery images at their positions, candidates, and
the circle of uncertainty.

In: positions in degrees. Out: pixels. A map is a plane that touches the earth at its middle, north
up, which is accurate over some hundred kilometres. Shapes: N positions, 2 = latitude, longitude; or
x to the right, y downwards, pixels.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.camera.uncertainty import Ellipse
from pipeline.core.arrays import Doubles
from pipeline.core.geo import EARTH_RADIUS_M
from pipeline.locate.gallery_map import GalleryMap
from pipeline.locate.locate import Answer
from pipeline.matching.refine import Refinement

MAP_SIDE_PX = 320
"Pixels of a map's side, before it is scaled to the page."

MAP_HALF_SPACINGS = 2.6
"""Half the side of a map around a position, in spacings of the gallery: shows its neighbours, and
part of the next ones."""

SMALLEST_CIRCLE_PX = 4.0
"A position within decimetres stays visible."

MAX_TILES = 64
"Gallery images that a map shows at most."

MAX_DOTS = 4000
"Gallery positions that the overview shows at most."

Footprint = Sequence[Sequence[float]]
"Corners, latitude and longitude, clockwise from the image's upper left."


@dataclass(frozen=True, kw_only=True)
class MapFrame:
    """The square of ground that a map shows."""

    lat: float
    lon: float
    half_m: float

    def pixels(self, positions_N2: Doubles) -> Doubles:
        """Pixels (N, 2) of positions (N, 2). The difference of longitudes wraps at 180 degrees."""
        delta_lon_N = (positions_N2[:, 1] - self.lon + 180) % 360 - 180
        east_N = EARTH_RADIUS_M * np.radians(delta_lon_N) * math.cos(math.radians(self.lat))
        south_N = EARTH_RADIUS_M * np.radians(self.lat - positions_N2[:, 0])
        scale = MAP_SIDE_PX / 2 / self.half_m
        return np.stack([east_N, south_N], axis=1) * scale + MAP_SIDE_PX / 2

    def length(self, metres: float) -> float:
        """A length in pixels."""
        return metres * MAP_SIDE_PX / 2 / self.half_m

    @property
    def bar_m(self) -> float:
        """Length of the scale bar: a round number of metres, a tenth to a quarter of the side."""
        power = 10.0 ** math.floor(math.log10(self.half_m / 2))
        return max(times * power for times in (1, 2, 5) if times * power <= self.half_m / 2)


@dataclass(frozen=True, kw_only=True)
class MapTile:
    """A gallery image on the ground."""

    key: str
    matrix: str
    "The SVG transform from the unit square to the image's corners."


@dataclass(frozen=True, kw_only=True)
class MapMark:
    """A mark at a point of the map."""

    x: float
    y: float
    label: str
    title: str
    kind: str
    "Class in the template's style sheet."


@dataclass(frozen=True, kw_only=True)
class MapView:
    """One map."""

    frame: MapFrame
    summary: str
    "The map in words, for screen readers."
    tiles: tuple[MapTile, ...] = ()
    dots: tuple[tuple[float, float], ...] = ()
    marks: tuple[MapMark, ...] = ()
    circle: tuple[float, float, float] | None = None
    "x, y and radius of the circle of uncertainty, where there is no ellipse."
    ellipse: tuple[float, float, float, float, float] | None = None
    "x, y, half the longer and the shorter axis, and the longer one's turn from the x axis."
    line: str = ""
    "Points of the flight's polyline."
    outline: str = ""
    "Corners of the ground that the photo shows, where it was matched; the first two are its top."


def nearby_keys(answer: Answer, gallery: GalleryMap) -> list[str]:
    """The gallery images that the map around an answer may show."""
    if answer.position is None:
        return []
    return [
        str(gallery.keys[number])
        for number in gallery.nearest(
            answer.position.lat, answer.position.lon, MAX_TILES, gallery.finest_side_m
        )
    ]


def position_map(
    answer: Answer, gallery: GalleryMap, footprints: Mapping[str, Footprint]
) -> MapView | None:
    """The surroundings of an answer, drawn from the gallery's own images; None without a
    position."""
    position = answer.position
    if position is None:
        return None
    spacing = gallery.spacing_m or position.radius_m or 1.0
    half_m = max(MAP_HALF_SPACINGS * spacing, 1.3 * position.radius_m, _reach_m(answer))
    frame = MapFrame(lat=position.lat, lon=position.lon, half_m=half_m)
    tiles: list[tuple[float, MapTile]] = []
    nearest = gallery.nearest(position.lat, position.lon, MAX_TILES, gallery.finest_side_m)
    for number in nearest.tolist():
        key, (lat, lon) = str(gallery.keys[number]), gallery.positions_N2[number].tolist()
        footprint = footprints.get(key) or square_footprint(lat, lon, 0.96 * spacing)
        corners_32 = frame.pixels(np.array(footprint)[[0, 1, 3]])
        if (corners_32.max(axis=0) > 0).all() and (corners_32.min(axis=0) < MAP_SIDE_PX).all():
            side = float(np.linalg.norm(corners_32[1] - corners_32[0]))
            tiles.append((side, MapTile(key=key, matrix=svg_matrix(corners_32))))
    # The near ones over the far, and of several levels the fine ones over the coarse.
    tiles.reverse()
    tiles.sort(key=lambda tile: -round(tile[0]))
    (x, y), *_ = frame.pixels(np.array([[position.lat, position.lon]])).tolist()
    return MapView(
        frame=frame,
        tiles=tuple(tile for _, tile in tiles),
        marks=tuple(candidate_marks(answer, frame)),
        circle=None
        if position.ellipse
        else (x, y, max(frame.length(position.radius_m), SMALLEST_CIRCLE_PX)),
        ellipse=_ellipse(x, y, position.ellipse, frame) if position.ellipse else None,
        outline=_outline(answer, frame),
        summary=f"Map of {2 * half_m:.0f} m around latitude {position.lat:.5f}, longitude "
        f"{position.lon:.5f}",
    )


def _ellipse(
    x: float, y: float, ellipse: Ellipse, frame: MapFrame
) -> tuple[float, float, float, float, float]:
    longer, shorter = (
        max(frame.length(half_m), SMALLEST_CIRCLE_PX)
        for half_m in (ellipse.major_m, ellipse.minor_m)
    )
    return x, y, longer, shorter, ellipse.direction_deg - 90


def photo_box(size: tuple[int, int], left: float, top: float) -> tuple[float, float, float, float]:
    """x, y, width and height of a photo of `size` (width, height) in the middle of a square of
    MAP_SIDE_PX."""
    scale = MAP_SIDE_PX / max(size)
    width, height = size[0] * scale, size[1] * scale
    return left + (MAP_SIDE_PX - width) / 2, top + (MAP_SIDE_PX - height) / 2, width, height


def match_paths(
    refinement: Refinement,
    frame: MapFrame,
    box: tuple[float, float, float, float],
    map_at: tuple[float, float],
) -> tuple[str, str]:
    """SVG paths of a refinement's pairs: lines from a photo drawn in `box` (x, y, width, height) to
    a map whose upper left corner is drawn at `map_at`; and their ends."""
    x, y, width, height = box
    shares_M2 = np.array([(point.x, point.y) for point in refinement.points]).reshape(-1, 2)
    ground_M2 = np.array([(point.lat, point.lon) for point in refinement.points]).reshape(-1, 2)
    photo_M2 = shares_M2 * (width, height) + (x, y)
    map_M2 = frame.pixels(ground_M2) + map_at
    ends = [[f"{u:.1f} {v:.1f}" for u, v in side.tolist()] for side in (photo_M2, map_M2)]
    lines = "".join(f"M{one}L{other}" for one, other in zip(*ends, strict=True))
    return lines, "".join(f"M{end}h0" for side in ends for end in side)


def _reach_m(answer: Answer) -> float:
    """Half the side of the square around the position that holds what the photo shows, metres."""
    if answer.refinement is None or answer.position is None:
        return 0.0
    here = MapFrame(lat=answer.position.lat, lon=answer.position.lon, half_m=MAP_SIDE_PX / 2)
    corners_42 = here.pixels(np.array(answer.refinement.footprint)) - MAP_SIDE_PX / 2
    return 1.05 * float(np.abs(corners_42).max())  # a pixel is a metre


def _outline(answer: Answer, frame: MapFrame) -> str:
    if answer.refinement is None:
        return ""
    corners_42 = frame.pixels(np.array(answer.refinement.footprint))
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in corners_42.tolist())


def overview_map(
    answers: Sequence[tuple[str, Answer]], gallery: GalleryMap, track: bool
) -> MapView | None:
    """The whole gallery as dots, with a mark for each known answer; None where the gallery has no
    positions."""
    known_N2 = gallery.positions_N2[~np.isnan(gallery.positions_N2).any(axis=1)][:MAX_DOTS]
    if not len(known_N2):
        return None
    known = [(name, one.position) for name, one in answers if one.known and one.position]
    answer_M2 = np.array([(position.lat, position.lon) for _, position in known]).reshape(-1, 2)
    frame = fit_frame(np.concatenate([known_N2, answer_M2]))
    points = frame.pixels(answer_M2).tolist()
    return MapView(
        frame=frame,
        dots=tuple(map(tuple, frame.pixels(known_N2).round(1).tolist())),
        marks=tuple(
            MapMark(x=x, y=y, label="", title=name, kind="answer")
            for (name, _), (x, y) in zip(known, points, strict=True)
        ),
        line=" ".join(f"{x:.1f},{y:.1f}" for x, y in points) if track else "",
        summary=f"Map of the whole gallery, {2 * frame.half_m / 1000:.1f} km across, with "
        f"{len(known)} answers",
    )


def fit_frame(positions_N2: Doubles) -> MapFrame:
    """The square around positions; N >= 1. Longitudes are relative to the first one's, so that
    positions on both sides of 180 degrees stay together."""
    first_lon = positions_N2[0, 1]
    lon_N = (positions_N2[:, 1] - first_lon + 180) % 360 - 180
    lat = float((positions_N2[:, 0].min() + positions_N2[:, 0].max()) / 2)
    lon = float((lon_N.min() + lon_N.max()) / 2 + first_lon + 180) % 360 - 180
    unit = MapFrame(lat=lat, lon=lon, half_m=MAP_SIDE_PX / 2)  # a pixel is a metre
    reach_m = float(np.abs(unit.pixels(positions_N2) - MAP_SIDE_PX / 2).max())
    return MapFrame(lat=lat, lon=lon, half_m=1.06 * max(reach_m, 10.0))


def candidate_marks(answer: Answer, frame: MapFrame) -> list[MapMark]:
    """The candidates that lie within a map, numbered by rank."""
    marks = []
    for rank, hit in enumerate(answer.candidates, 1):
        if hit.lat is None or hit.lon is None:
            continue
        x, y = frame.pixels(np.array([[hit.lat, hit.lon]]))[0].tolist()
        if 0 <= x <= MAP_SIDE_PX and 0 <= y <= MAP_SIDE_PX:
            title = f"{hit.location}, {hit.score:.3f}"
            marks.append(MapMark(x=x, y=y, label=str(rank), title=title, kind="candidate"))
    return marks


def square_footprint(lat: float, lon: float, side_m: float) -> Footprint:
    """Corners, clockwise from the upper left, of a square of ground with sides to the north and
    east."""
    north = math.degrees(side_m / 2 / EARTH_RADIUS_M)
    east = north / max(math.cos(math.radians(lat)), 1e-6)
    return (
        (lat + north, lon - east),
        (lat + north, lon + east),
        (lat - north, lon + east),
        (lat - north, lon - east),
    )


def svg_matrix(corners_32: Doubles) -> str:
    """The transform that maps (0, 0), (1, 0), (0, 1) to three corners: upper left, upper right,
    lower left."""
    origin_2, right_2, down_2 = corners_32
    numbers = [*(right_2 - origin_2), *(down_2 - origin_2), *origin_2]
    return f"matrix({' '.join(f'{number:.2f}' for number in numbers)})"
