"""Answers -> files for other programs: GeoJSON with a point per photo and a line per flight, and
CSV.

In: the answers of photos. Out: bytes. An unknown answer has no geometry, so that a map shows only
answers above the threshold; the best guess is among its properties.
"""

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from pipeline.core.records import Rejection
from pipeline.locate.locate import Answer

PROPERTIES = (
    "photo",
    "taken_at",
    "known",
    "probability",
    "within_m",
    "lat",
    "lon",
    "radius_m",
    "how",
    "heading_deg",
    "inliers",
    "dense",
    "camera_lat",
    "camera_lon",
    "camera_height_m",
    "location",
    "agreeing",
    "framing",
)
"Columns of the CSV that a feature of the GeoJSON has as properties."

CAMERA = ("camera_lat", "camera_lon", "camera_height_m")
"Columns of the camera's own place, where matching and the lens tell it."

CSV_COLUMNS = (*PROPERTIES, "candidate", "score", "reason", "found")


@dataclass(frozen=True, kw_only=True)
class LocatedPhoto:
    """A photo, or several of one location, with the answer."""

    name: str
    "Path or URI of the photo; of the folder, where its photos are one query."
    photos: tuple[str, ...]
    "Paths of the photos that the answer belongs to."
    answer: Answer | None = None
    "None where no photo could be decoded."
    rejected: tuple[Rejection, ...] = ()
    "Its photos that could not be decoded."
    taken_at: str | None = None
    "Time of the photo, where known."


def to_geojson(located: Sequence[LocatedPhoto], about: dict[str, Any], track: bool) -> bytes:
    """A FeatureCollection (RFC 7946) with a feature per answer, and with `track` first a LineString
    through the known ones.

    `about` is the member `pvda` beside the features: index, encoder, threshold.
    """
    features = [_feature(one) for one in located]
    if track:
        features.insert(0, _track_feature(located))
    collection = {"type": "FeatureCollection", "pvda": about, "features": features}
    return (json.dumps(collection, indent=1) + "\n").encode()  # ASCII: names need not be Unicode


def _feature(one: LocatedPhoto) -> dict[str, Any]:
    row = _row(one)
    point = None
    if row["known"] and row["lat"] is not None:
        point = {"type": "Point", "coordinates": [row["lon"], row["lat"]]}
    candidates = [asdict(hit) for hit in one.answer.candidates] if one.answer else []
    position = one.answer.position if one.answer else None
    refinement = one.answer.refinement if one.answer else None
    properties = {name: row[name] for name in PROPERTIES} | {
        "ellipse": asdict(position.ellipse) if position and position.ellipse else None,
        "footprint": _ring(refinement.footprint) if refinement else None,
        "photos": one.photos,
        "candidates": candidates,
        "rejected": [asdict(rejection) for rejection in one.rejected],
    }
    return {"type": "Feature", "geometry": point, "properties": properties}


def _ring(footprint: Sequence[tuple[float, float]]) -> list[list[float]]:
    """Corners as a closed ring of longitudes and latitudes, counter-clockwise from above."""
    ring = [[lon, lat] for lat, lon in footprint]
    return [*ring, ring[0]][::-1]


def _track_feature(located: Sequence[LocatedPhoto]) -> dict[str, Any]:
    """The flight's line; without geometry where fewer than two photos are known, since a line has
    two ends."""
    known = [
        (one, one.answer.position)
        for one in located
        if one.answer and one.answer.known and one.answer.position
    ]
    points = [[position.lon, position.lat] for _, position in known]
    return {
        "type": "Feature",
        "geometry": {"type": "LineString", "coordinates": points} if len(points) > 1 else None,
        "properties": {
            "track": True,
            "photos": [one.name for one, _ in known],
            "times": [one.taken_at for one, _ in known],
        },
    }


def to_csv(located: Sequence[LocatedPhoto]) -> bytes:
    """CSV with a row per answer; unknown values are empty."""
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=CSV_COLUMNS, lineterminator="\n")
    writer.writeheader()
    for one in located:
        row = _row(one)
        writer.writerow(row | {"known": str(row["known"]).lower()})
    return text.getvalue().encode("utf-8", "surrogateescape")


def _row(one: LocatedPhoto) -> dict[str, Any]:
    row: dict[str, Any] = dict.fromkeys(CSV_COLUMNS)
    row |= {"photo": one.name, "taken_at": one.taken_at, "known": False}
    if one.rejected:
        row |= {"reason": one.rejected[0].reason, "found": one.rejected[0].found}
    if answer := one.answer:
        row |= {
            name: getattr(answer, name)
            for name in ("known", "probability", "within_m", "location", "agreeing", "framing")
        }
        if position := answer.position:
            row |= {name: getattr(position, name) for name in ("lat", "lon", "radius_m", "how")}
        if found := answer.refinement:
            row |= {name: getattr(found, name) for name in ("heading_deg", "inliers", "dense")}
            if found.camera:
                row |= dict(zip(CAMERA, found.camera, strict=True))
        if answer.candidates:
            row |= {"candidate": answer.candidates[0].key, "score": answer.candidates[0].score}
    return row
