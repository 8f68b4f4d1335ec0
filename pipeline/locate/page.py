"""Answers -> one self-contained HTML page: each photo, its candidates, and a map of the gallery's
own images.

In: answers, images by key and by path, and the gallery's positions. Out: the page as text. It has
no script and no font of its own, and loads nothing: no request, no map server.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.camera.warp import lay_on
from pipeline.core.arrays import Pixels
from pipeline.core.geo import haversine_m
from pipeline.core.templates import template_environment
from pipeline.images.decode import DecodeError, decode
from pipeline.images.thumbnails import (
    ANSWER_PX,
    QUERY_PX,
    ImageLoader,
    as_data_uri,
    shrink_to_webp,
    thumbnail,
)
from pipeline.index.searcher import Hit
from pipeline.locate.calibration import Calibration, MatchingCalibration
from pipeline.locate.gallery_map import GalleryMap
from pipeline.locate.geojson import LocatedPhoto
from pipeline.locate.locate import Answer
from pipeline.locate.page_map import (
    MAP_SIDE_PX,
    Footprint,
    MapView,
    match_paths,
    nearby_keys,
    overview_map,
    photo_box,
    position_map,
)
from pipeline.matching.gate import LEAST_PROBABILITY

MAX_SHOWN = 60
"Answers on the page at most, evenly spaced: 100 to 150 kB each."

LAID_PX = 400
"Longest side of a photo laid over the map: some 30 kB."

PAIR_GAP_PX = 16
"Between a photo and its map, where lines join them."

TILE_PX = 96
LatLon = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class PageContext:
    """What the page shows besides the answers."""

    title: str
    gallery: GalleryMap
    calibration: Calibration | None
    fingerprint: str
    track: bool = False
    matched: bool = False
    "Photos were matched with the map, by which other probabilities make an answer unknown."
    footprints: Callable[[Iterable[str]], Mapping[str, Footprint]] = lambda keys: {}
    """Corners of gallery images by key, where known; the others are drawn as squares as wide as the
    spacing."""
    true_positions: Mapping[str, LatLon] = field(default_factory=dict)
    "Where photos were taken, by name, where known."

    @property
    def matching(self) -> MatchingCalibration | None:
        """What the calibration knows of matched photos, if they were matched."""
        return self.calibration.matching if self.calibration and self.matched else None


def render_page(
    located: Sequence[LocatedPhoto],
    context: PageContext,
    load_photos: ImageLoader,
    load_tiles: ImageLoader,
) -> str:
    """The page, with at most MAX_SHOWN of the answers."""
    numbers = np.linspace(0, len(located) - 1, min(len(located), MAX_SHOWN))
    shown = [located[round(number)] for number in numbers]
    answers = [one.answer for one in shown if one.answer]
    nearby = {key for answer in answers for key in nearby_keys(answer, context.gallery)}
    footprints = context.footprints(sorted(nearby))
    maps = [
        position_map(one.answer, context.gallery, footprints) if one.answer else None
        for one in shown
    ]
    on_maps = {tile.key for view in maps if view for tile in view.tiles}
    candidates = {hit.key for answer in answers for hit in answer.candidates}
    tiles = load_tiles(sorted(on_maps | candidates))
    named = [(one.name, one.answer) for one in located if one.answer]
    environment = template_environment(Path(__file__).parent / "templates")
    return environment.get_template("answers.html").render(
        title=context.title,
        fingerprint=context.fingerprint,
        calibration=context.calibration,
        matching=context.matching,
        least_probability=LEAST_PROBABILITY,
        photos=len(located),
        known=sum(answer.known for _, answer in named),
        damaged=sum(len(one.rejected) for one in located),
        track=context.track,
        overview=overview_map(named, context.gallery, context.track),
        tiles={key: thumbnail(tiles[key], TILE_PX) for key in sorted(on_maps & tiles.keys())},
        panels=[
            _panel(one, view, tiles, load_photos, context)
            for one, view in zip(shown, maps, strict=True)
        ],
        side=MAP_SIDE_PX,
        gap=PAIR_GAP_PX,
    )


def _panel(
    one: LocatedPhoto,
    view: MapView | None,
    tiles: Mapping[str, bytes],
    load_photos: ImageLoader,
    context: PageContext,
) -> dict[str, Any]:
    """One answer as the template shows it."""
    photo_HW3 = _decoded(load_photos([one.photos[0]]).get(one.photos[0]))
    answer, truth = one.answer, context.true_positions.get(one.name)
    point = view.frame.pixels(np.array([truth]))[0].tolist() if view and truth else None
    on_map = point is not None and all(0 <= at <= MAP_SIDE_PX for at in point)
    candidates = enumerate(answer.candidates, 1) if answer else ()
    return {
        "name": short_name(one.name),
        "path": one.name,
        "count": len(one.photos),
        "taken_at": one.taken_at,
        "picture": None if photo_HW3 is None else _webp_uri(photo_HW3, QUERY_PX),
        "map": view,
        "laid": _laid(answer, photo_HW3, view),
        "answer": answer,
        "rejected": one.rejected,
        "truth": point if on_map else None,
        "error": format_distance(distance_to_m(answer, truth)) if answer and truth else "",
        "candidates": [_candidate(rank, hit, answer, tiles) for rank, hit in candidates if answer],
    }


def _decoded(data: bytes | None) -> Pixels | None:
    try:
        return None if data is None else decode(data)
    except DecodeError:
        return None


def _webp_uri(pixels_HWC: Pixels, pixels: int) -> str:
    return as_data_uri(shrink_to_webp(pixels_HWC, pixels))


def _laid(
    answer: Answer | None, photo_HW3: Pixels | None, view: MapView | None
) -> dict[str, Any] | None:
    """A matched photo as it lies on the map, and the pairs that carry it, drawn from the photo to
    the map: side by side, and for narrow screens the map below it."""
    if answer is None or answer.refinement is None or photo_HW3 is None or view is None:
        return None
    corners_42 = view.frame.pixels(np.array(answer.refinement.footprint))
    least_2, extent_2 = corners_42.min(axis=0), np.maximum(np.ptp(corners_42, axis=0), 1e-6)
    scale = LAID_PX / float(extent_2.max())
    width, height = (max(1, round(side * scale)) for side in extent_2.tolist())
    laid_HW4 = lay_on(photo_HW3, (corners_42 - least_2) * scale, (width, height))
    size = (photo_HW3.shape[1], photo_HW3.shape[0])
    box, beyond = photo_box(size, 0, 0), float(MAP_SIDE_PX + PAIR_GAP_PX)
    return {
        "source": _webp_uri(laid_HW4, LAID_PX),
        "box": [*least_2.tolist(), *extent_2.tolist()],
        "photo": box,
        "wide": match_paths(answer.refinement, view.frame, box, (beyond, 0.0)),
        "tall": match_paths(answer.refinement, view.frame, box, (0.0, beyond)),
    }


def _candidate(rank: int, hit: Hit, answer: Answer, tiles: Mapping[str, bytes]) -> dict[str, Any]:
    position = (hit.lat, hit.lon) if hit.lat is not None and hit.lon is not None else None
    return {
        "rank": rank,
        "key": hit.key,
        "location": hit.location,
        "score": hit.score,
        "picture": thumbnail(tiles.get(hit.key), ANSWER_PX),
        "here": hit.location == answer.location,
        "away": format_distance(distance_to_m(answer, position)),
    }


def distance_to_m(answer: Answer, position: LatLon | None) -> float | None:
    """Metres from an answer's position to another one; None where either is unknown."""
    if answer.position is None or position is None:
        return None
    found_2 = np.array([answer.position.lat, answer.position.lon])
    return float(haversine_m(found_2, np.array(position)))


def format_distance(metres: float | None) -> str:
    """A distance in words; empty where unknown."""
    if metres is None:
        return ""
    if metres < 1:
        return "here"
    return f"{metres:.0f} m away" if metres < 1000 else f"{metres / 1000:.1f} km away"


def short_name(path: str) -> str:
    """The last two parts of a path: a photo and its folder."""
    return "/".join(path.rstrip("/").split("/")[-2:])
