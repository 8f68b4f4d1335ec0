"""Answers -> files that other programs read: GeoJSON with a point per photo and a line per flight,
and CSV.

In: what was found of each photo. Out: bytes. An unknown place has no geometry: what a map draws is
what is believed. The best guess stands among its properties.
"""

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from pipeline.core.records import Rejection
from pipeline.locate.locate import Answer

CSV_COLUMNS = (
    "photo",
    "taken_at",
    "known",
    "probability",
    "lat",
    "lon",
    "radius_m",
    "location",
    "agreeing",
    "candidate",
    "score",
    "reason",
    "found",
)


@dataclass(frozen=True, kw_only=True)
class LocatedPhoto:
    """A photo, or several of one place, and what is said of it."""

    name: str
    "Path or URI of the photo; of the folder where its photos were taken together."
    photos: tuple[str, ...]
    "Paths of the photos that the answer is of."
    answer: Answer | None = None
    "None where no photo could be decoded."
    rejected: tuple[Rejection, ...] = ()
    "Photos of it that could not be decoded."
    taken_at: str | None = None
    "When, as far as it is known."


def to_geojson(located: Sequence[LocatedPhoto], about: dict[str, Any], track: bool) -> bytes:
    """A FeatureCollection (RFC 7946): a feature per answer, and with `track` first a LineString
    through those that are known.

    `about` stands beside the features, under `pvda`: index, network, calibration.
    """
    features = [_feature(one) for one in located]
    if track:
        features.insert(0, _track_feature(located))
    collection = {"type": "FeatureCollection", "pvda": about, "features": features}
    return (
        json.dumps(collection, indent=1) + "\n"
    ).encode()  # ASCII: file names need not be Unicode


def _feature(one: LocatedPhoto) -> dict[str, Any]:
    row = _row(one)
    candidates = [asdict(hit) for hit in one.answer.candidates] if one.answer else []
    properties = {name: row[name] for name in CSV_COLUMNS[: CSV_COLUMNS.index("candidate")]}
    properties |= {
        "photos": one.photos,
        "candidates": candidates,
        "rejected": [asdict(refused) for refused in one.rejected],
    }
    point = (
        {"type": "Point", "coordinates": [row["lon"], row["lat"]]}
        if row["known"] and row["lat"] is not None
        else None
    )
    return {"type": "Feature", "geometry": point, "properties": properties}


def _track_feature(located: Sequence[LocatedPhoto]) -> dict[str, Any]:
    """The flight; without geometry where fewer than two photos are known, since a line has two
    ends.
    """
    known = [one for one in located if one.answer and one.answer.known and one.answer.position]
    points = [
        [one.answer.position.lon, one.answer.position.lat]
        for one in known
        if one.answer and one.answer.position
    ]
    return {
        "type": "Feature",
        "geometry": {"type": "LineString", "coordinates": points} if len(points) > 1 else None,
        "properties": {
            "track": True,
            "photos": [one.name for one in known],
            "times": [one.taken_at for one in known],
        },
    }


def to_csv(located: Sequence[LocatedPhoto]) -> bytes:
    """CSV with a row per answer; empty is unknown."""
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=CSV_COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(
        _row(one) | {"known": str(bool(one.answer and one.answer.known)).lower()} for one in located
    )
    return text.getvalue().encode("utf-8", "surrogateescape")


def _row(one: LocatedPhoto) -> dict[str, Any]:
    answer = one.answer
    row: dict[str, Any] = dict.fromkeys(CSV_COLUMNS) | {
        "photo": one.name,
        "taken_at": one.taken_at,
        "known": False,
    }
    if one.rejected:
        row |= {"reason": one.rejected[0].reason, "found": one.rejected[0].found}
    if answer:
        row |= {
            name: getattr(answer, name) for name in ("known", "probability", "location", "agreeing")
        }
        if answer.position:
            row |= asdict(answer.position)
        if answer.candidates:
            row |= {"candidate": answer.candidates[0].key, "score": answer.candidates[0].score}
    return row
