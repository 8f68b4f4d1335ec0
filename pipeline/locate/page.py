"""Answers -> one self-contained HTML page: each photo, its candidates, and a map drawn with the
gallery's own images.

In: answers, pictures by key and by path, and the gallery's map. Out: the page as text. Nothing on
it runs or leaves it: no script, no font, no request, no map server.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.core.geo import haversine_m
from pipeline.core.templates import template_environment
from pipeline.images.thumbnails import ANSWER_PX, QUERY_PX, thumbnail
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
"Answers on the page at most, evenly spread: some 100 kB each."
TILE_PX = 96
Pictures = Callable[[Iterable[str]], Mapping[str, bytes]]
"Encoded images by key or by path; what is not at hand is absent."
LatLon = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class PageContext:
    """What the page shows besides the answers."""

    title: str
    gallery: GalleryMap
    confidence: Calibration | None
    fingerprint: str
    track: bool = False
    footprints: Callable[[Iterable[str]], Mapping[str, Footprint]] = lambda keys: {}
    """Corners of gallery images by key, where they are known; the others are drawn as squares as
    wide as the spacing."""
    true_positions: Mapping[str, LatLon] = field(default_factory=dict)
    "Where photos were really taken, by name, where that is known."


def render_page(
    located: Sequence[LocatedPhoto], around: PageContext, photos: Pictures, tiles: Pictures
) -> str:
    """The page."""
    shown = [
        located[round(at)] for at in np.linspace(0, len(located) - 1, min(len(located), MAX_SHOWN))
    ]
    answered = [one.answer for one in shown if one.answer]
    footprints = around.footprints(
        sorted({key for answer in answered for key in nearby_keys(answer, around.gallery)})
    )
    maps = [
        position_map(one.answer, around.gallery, footprints) if one.answer else None
        for one in shown
    ]
    keys = {tile.key for view in maps if view for tile in view.tiles}
    keys |= {hit.key for answer in answered for hit in answer.candidates}
    held, taken = tiles(sorted(keys)), photos([one.photos[0] for one in shown])
    panels = [_panel(one, view, held, taken, around) for one, view in zip(shown, maps, strict=True)]
    environment = template_environment(Path(__file__).parent / "templates")
    answers = [(one.name, one.answer) for one in located if one.answer]
    on_maps = sorted({tile.key for view in maps if view for tile in view.tiles} & held.keys())
    return environment.get_template("answers.html").render(
        title=around.title,
        fingerprint=around.fingerprint,
        confidence=around.confidence,
        photos=len(located),
        known=sum(answer.known for _, answer in answers),
        damaged=sum(len(one.rejected) for one in located),
        track=around.track,
        overview=overview_map(answers, around.gallery, around.track),
        tiles={key: thumbnail(held[key], TILE_PX) for key in on_maps},
        panels=panels,
        side=MAP_SIDE_PX,
    )


def _panel(
    one: LocatedPhoto,
    view: MapView | None,
    tiles: Mapping[str, bytes],
    photos: Mapping[str, bytes],
    around: PageContext,
) -> dict[str, Any]:
    """One answer as the template shows it."""
    answer, truth = one.answer, around.true_positions.get(one.name)
    point = view.frame.pixels(np.array([truth]))[0].tolist() if view and truth else None
    return {
        "name": short_name(one.name),
        "path": one.name,
        "count": len(one.photos),
        "taken_at": one.taken_at,
        "picture": thumbnail(photos.get(one.photos[0]), QUERY_PX),
        "map": view,
        "answer": answer,
        "rejected": one.rejected,
        "truth": point if point and all(0 <= at <= MAP_SIDE_PX for at in point) else None,
        "error": format_distance(distance_to_m(answer, truth)) if answer and truth else "",
        "candidates": [
            {
                "rank": rank,
                "key": hit.key,
                "location": hit.location,
                "score": hit.score,
                "picture": thumbnail(tiles.get(hit.key), ANSWER_PX),
                "here": hit.location == answer.location,
                "away": format_distance(
                    distance_to_m(
                        answer,
                        (hit.lat, hit.lon) if hit.lat is not None and hit.lon is not None else None,
                    )
                ),
            }
            for rank, hit in enumerate(answer.candidates, 1)
        ]
        if answer
        else [],
    }


def distance_to_m(answer: Answer, place: LatLon | None) -> float | None:
    """Metres from an answer's position to a place; None where either is unknown."""
    if answer.position is None or place is None:
        return None
    return float(haversine_m(np.array([answer.position.lat, answer.position.lon]), np.array(place)))


def format_distance(metres: float | None) -> str:
    """A distance in words."""
    if metres is None:
        return ""
    if metres < 1:
        return "here"
    return f"{metres:.0f} m away" if metres < 1000 else f"{metres / 1000:.1f} km away"


def short_name(name: str) -> str:
    """The last two parts of a path: a photo and its folder."""
    return "/".join(name.rstrip("/").split("/")[-2:])
