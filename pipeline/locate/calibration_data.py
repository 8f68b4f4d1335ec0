"""Photos of known places -> what a gallery answers with their places in it, and without.

In: embeddings of photos and of their places' own gallery images, and an index. Out: Examples for
`pipeline/locate/calibrate.py`. The index need not hold the places: their own images are ranked
among its rows as if it did. Shapes: Q photos, N gallery images of their places, D dimensions, K
candidates.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.core.geo import haversine_m
from pipeline.core.records import View
from pipeline.features.table import Floats
from pipeline.index.searcher import Hit, Searchable
from pipeline.locate.calibrate import CalibrationExample
from pipeline.locate.locate import coordinates
from pipeline.locate.track import TRACK_CANDIDATES

OWN_LOCATION_SPACINGS = 2.0
"""Spacings of the gallery within which an image belongs to a photo's place, too: neighbours of one
that overlap show it."""


@dataclass(frozen=True, kw_only=True)
class LabelledImages:
    """Images with what is known of them, in the order of their embeddings."""

    facts: Sequence[dict[str, Any]]
    "As the shards' JSON says: key, location, view, geotag."
    embeddings_QD: Floats

    def place(self, number: int) -> tuple[float | None, float | None]:
        """Latitude and longitude of what an image shows; None where unknown."""
        geotag = self.facts[number]["geotag"]
        return (geotag["lat"], geotag["lon"]) if geotag else (None, None)


def make_examples(
    photos: LabelledImages,
    overhead: LabelledImages,
    index: Searchable,
    spacing_m: float | None,
    tolerance_m: float,
) -> list[CalibrationExample]:
    """One example per photo."""
    own: dict[str, list[int]] = {}
    for number, facts in enumerate(overhead.facts):
        own.setdefault(facts["location"], []).append(number)
    apart_m = max(tolerance_m, OWN_LOCATION_SPACINGS * (spacing_m or 0.0))
    made: list[CalibrationExample | None] = [None] * len(photos.facts)
    todo, k = list(range(len(photos.facts))), 2 * TRACK_CANDIDATES
    while todo:
        found = index.search(photos.embeddings_QD[todo], k)
        whole = k >= len(index)
        for number, hits in zip(todo, found, strict=True):
            location, (lat, lon) = photos.facts[number]["location"], photos.place(number)
            others = [
                hit
                for hit in hits_outside_radius(hits, lat, lon, apart_m)
                if hit.location != location
            ]
            if len(others) < TRACK_CANDIDATES and not whole:
                continue  # its place has so many rows that one must look further down
            rows = own.get(location, [])
            score_N = overhead.embeddings_QD[rows] @ photos.embeddings_QD[number]
            added = [
                _hit(overhead, row, float(score)) for row, score in zip(rows, score_N, strict=True)
            ]
            held = {hit.key for hit in hits}
            inside = sorted(
                [*hits, *(hit for hit in added if hit.key not in held)], key=lambda hit: -hit.score
            )
            made[number] = CalibrationExample(
                location=location,
                lat=lat,
                lon=lon,
                inside=tuple(inside[:TRACK_CANDIDATES]),
                outside=tuple(others[:TRACK_CANDIDATES]),
            )
        todo, k = [number for number in todo if made[number] is None], 4 * k
    return [example for example in made if example]


def hits_outside_radius(
    hits: Sequence[Hit], lat: float | None, lon: float | None, apart_m: float
) -> list[Hit]:
    """The candidates that are not known to lie within so many metres of a position."""
    if lat is None or lon is None or not hits:
        return list(hits)
    near_K = haversine_m(coordinates(hits), np.array([lat, lon])) <= apart_m  # false of a NaN
    return [hit for hit, near in zip(hits, near_K, strict=True) if not near]


def _hit(images: LabelledImages, number: int, score: float) -> Hit:
    facts, (lat, lon) = images.facts[number], images.place(number)
    return Hit(
        key=facts["key"],
        location=facts["location"],
        view=View(facts["view"]),
        lat=lat,
        lon=lon,
        score=score,
    )
