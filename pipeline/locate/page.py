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

from pipeline.core.geo import haversine_m
from pipeline.core.templates import template_environment
from pipeline.images.thumbnails import ANSWER_PX, QUERY_PX, ImageLoader, thumbnail
from pipeline.index.searcher import Hit
from pipeline.locate.calibration import Calibration
from pipeline.locate.gallery_map import GalleryMap
from pipeline.locate.geojson import LocatedPhoto
from pipeline.locate.locate import Answer
from pipeline.locate.page_map import (
    MAP_SIDE_PX,
    Footprint,
    MapView,
    nearby_keys,
    overview_map,
    position_map,
)

MAX_SHOWN = 60
"Answers on the page at most, evenly spaced: about 100 kB each."

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
    footprints: Callable[[Iterable[str]], Mapping[str, Footprint]] = lambda keys: {}
    """Corners of gallery images by key, where known; the others are drawn as squares as wide as the
    spacing."""
    true_positions: Mapping[str, LatLon] = field(default_factory=dict)
    "Where photos were taken, by name, where known."


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
    photos = load_photos([one.photos[0] for one in shown])
    named = [(one.name, one.answer) for one in located if one.answer]
    environment = template_environment(Path(__file__).parent / "templates")
    return environment.get_template("answers.html").render(
        title=context.title,
        fingerprint=context.fingerprint,
        calibration=context.calibration,
        photos=len(located),
        known=sum(answer.known for _, answer in named),
        damaged=sum(len(one.rejected) for one in located),
        track=context.track,
        overview=overview_map(named, context.gallery, context.track),
        tiles={key: thumbnail(tiles[key], TILE_PX) for key in sorted(on_maps & tiles.keys())},
        panels=[
            _panel(one, view, tiles, photos, context) for one, view in zip(shown, maps, strict=True)
        ],
        side=MAP_SIDE_PX,
    )


def _panel(
    one: LocatedPhoto,
    view: MapView | None,
    tiles: Mapping[str, bytes],
    photos: Mapping[str, bytes],
    context: PageContext,
) -> dict[str, Any]:
    """One answer as the template shows it."""
    answer, truth = one.answer, context.true_positions.get(one.name)
    point = view.frame.pixels(np.array([truth]))[0].tolist() if view and truth else None
    on_map = point is not None and all(0 <= at <= MAP_SIDE_PX for at in point)
    candidates = enumerate(answer.candidates, 1) if answer else ()
    return {
        "name": short_name(one.name),
        "path": one.name,
        "count": len(one.photos),
        "taken_at": one.taken_at,
        "picture": thumbnail(photos.get(one.photos[0]), QUERY_PX),
        "map": view,
        "answer": answer,
        "rejected": one.rejected,
        "truth": point if on_map else None,
        "error": format_distance(distance_to_m(answer, truth)) if answer and truth else "",
        "candidates": [_candidate(rank, hit, answer, tiles) for rank, hit in candidates if answer],
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
