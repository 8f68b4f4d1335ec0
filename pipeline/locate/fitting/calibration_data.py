"""Photos of known locations -> the candidates of a gallery with their location in it, and without.

In: embeddings of photos and of their locations' own gallery images, and an index. Out: examples for
`calibrate.py`. The index need not contain the locations: their own images are ranked among its rows
as if it did.
Shapes: Q photos, N gallery images of their locations, D dimensions, K candidates.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.camera.framing import Level
from pipeline.camera.local_plane import tile_side_m
from pipeline.core.arrays import Doubles, Floats
from pipeline.core.geo import haversine_m
from pipeline.core.records import View
from pipeline.index.searcher import Hit, Searchable
from pipeline.locate.fitting.calibrate import CalibrationExample
from pipeline.locate.locate import coordinates, level_scales, search_views
from pipeline.locate.track import TRACK_CANDIDATES

OWN_LOCATION_SPACINGS = 2.0
"""Spacings of an image's level within which it counts as one of a photo's own location: an
overlapping neighbour shows it too."""


@dataclass(frozen=True, kw_only=True)
class LabelledImages:
    """Images with their records, in the order of their embeddings."""

    records: Sequence[dict[str, Any]]
    "The JSON of the shards: key, location, view, geotag."
    embeddings_QD: Floats

    def position(self, number: int) -> tuple[float | None, float | None]:
        """Latitude and longitude of the ground that an image shows; None where unknown."""
        geotag = self.records[number]["geotag"]
        return (geotag["lat"], geotag["lon"]) if geotag else (None, None)


def make_examples(
    photos: LabelledImages,
    overhead: LabelledImages,
    index: Searchable,
    spacing_m: float | None,
    tolerance_m: float,
    finest_side_m: float | None = None,
) -> list[CalibrationExample]:
    """One example per photo, in order. `spacing_m`, `finest_side_m`: the gallery's."""
    own_rows: dict[str, list[int]] = {}
    for row, record in enumerate(overhead.records):
        own_rows.setdefault(record["location"], []).append(row)
    own_m = OWN_LOCATION_SPACINGS * (spacing_m or 0.0)

    def others(number: int, hits: Sequence[Hit]) -> list[Hit]:
        location = photos.records[number]["location"]
        radius_K = np.maximum(tolerance_m, own_m * level_scales(hits, finest_side_m))
        away = hits_outside_radius(hits, *photos.position(number), radius_K)
        return [hit for hit in away if hit.location != location]

    views = list(photos.embeddings_QD[:, None])
    examples = []
    for number, (hits, away) in enumerate(search_near_and_away(index, views, others)):
        location, (lat, lon) = photos.records[number]["location"], photos.position(number)
        own = _own_hits(photos.embeddings_QD[number], overhead, own_rows.get(location, []))
        indexed = {hit.key for hit in hits}
        inside = [*hits, *(hit for hit in own if hit.key not in indexed)]
        inside.sort(key=lambda hit: -hit.score)
        examples.append(
            CalibrationExample(
                location=location,
                lat=lat,
                lon=lon,
                inside=tuple(inside[:TRACK_CANDIDATES]),
                outside=tuple(away[:TRACK_CANDIDATES]),
            )
        )
    return examples


def search_near_and_away(
    index: Searchable,
    views_of_photos: Sequence[Floats],
    others: Callable[[int, Sequence[Hit]], list[Hit]],
    levels: Sequence[Level | None] | None = None,
) -> list[tuple[list[Hit], list[Hit]]]:
    """For each photo by its views (V, D), of the level that it was framed for: its candidates, and
    those of them that `others` takes for such of elsewhere, by the photo's number.

    Searches with a growing number of candidates until there are TRACK_CANDIDATES of these, or no
    more rows.
    """
    found: dict[int, tuple[list[Hit], list[Hit]]] = {}
    pending, k = list(range(len(views_of_photos))), 2 * TRACK_CANDIDATES
    while pending:
        views = [views_of_photos[number] for number in pending]
        own = None if levels is None else [levels[number] for number in pending]
        hits_of = search_views(index, views, k, None, own)
        for number, hits in zip(pending, hits_of, strict=True):
            away = others(number, hits)
            if len(away) >= TRACK_CANDIDATES or k >= len(index):
                found[number] = hits, away
        pending, k = [number for number in pending if number not in found], 4 * k
    return [found[number] for number in range(len(views_of_photos))]


def hits_outside_radius(
    hits: Sequence[Hit], lat: float | None, lon: float | None, radius_K: Doubles
) -> list[Hit]:
    """The hits that are not known to lie within their radius of a position, metres."""
    if lat is None or lon is None or not hits:
        return list(hits)
    near_K = haversine_m(coordinates(hits), np.array([lat, lon])) <= radius_K  # NaN gives False
    return [hit for hit, near in zip(hits, near_K, strict=True) if not near]


def _own_hits(embedding_D: Floats, images: LabelledImages, rows: Sequence[int]) -> list[Hit]:
    """The gallery images of a photo's own location as hits of a search for it."""
    score_N = images.embeddings_QD[rows] @ embedding_D
    return [_hit(images, row, float(score)) for row, score in zip(rows, score_N, strict=True)]


def _hit(images: LabelledImages, row: int, score: float) -> Hit:
    record, (lat, lon) = images.records[row], images.position(row)
    corners = (record["geotag"] or {}).get("footprint")
    return Hit(
        key=record["key"],
        location=record["location"],
        view=View(record["view"]),
        lat=lat,
        lon=lon,
        score=score,
        side_m=tile_side_m(corners) if corners else None,
    )
