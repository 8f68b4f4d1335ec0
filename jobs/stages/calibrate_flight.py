"""Photos over a map, with the places that they show -> examples to calibrate retrieval and matching
on.

In: a table of photos (that of jobs/fly.py, or of a flight with GPS), an index and the shards of its
tiles. Each photo is searched and matched twice, with what its tags say of the camera and without.
Out: examples for `pipeline/locate/fitting/`.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from jobs.encoding.photo_encoder import PhotoEncoder, decode_photo
from jobs.encoding.queries import Query, encode_photos, read_photo
from jobs.stages.matching import AHEAD, matchable_photo, view_maker
from pipeline.core import storage
from pipeline.core.errors import InputError
from pipeline.core.geo import Circle
from pipeline.core.prefetch import prefetch_map
from pipeline.core.progress import progress
from pipeline.core.records import GeoTag, ImageRecord, Rejection, View
from pipeline.index.searcher import Hit, Index
from pipeline.locate.calibration import Calibration
from pipeline.locate.fitting.calibrate import CalibrationExample
from pipeline.locate.fitting.calibration_data import hits_outside_radius, search_near_and_away
from pipeline.locate.fitting.fit_matching import MatchedExample
from pipeline.locate.gallery_map import GalleryMap
from pipeline.locate.locate import CONSENSUS_CANDIDATES, answers_from_hits
from pipeline.locate.refined import refine_answer
from pipeline.locate.track import TRACK_CANDIDATES
from pipeline.matching.map_windows import MapWindows
from pipeline.matching.photo_features import MatchablePhoto
from pipeline.matching.photo_pose import PoseSettings
from pipeline.matching.refine import Refinement
from pipeline.sources.table import Table

WAYS = (PoseSettings(pose=True), PoseSettings(pose=False))
"What is known of the cameras: their tags, or nothing."


@dataclass(frozen=True, kw_only=True)
class FlightPhoto:
    """A photo with the ground that its middle shows."""

    path: str
    truth: GeoTag


@dataclass(frozen=True, kw_only=True)
class SearchedPhoto:
    """A photo's query, framed in one of the WAYS, with its candidates."""

    query: Query
    way: PoseSettings
    example: CalibrationExample


def flight_of(table: str, most: int) -> list[FlightPhoto]:
    """The first photos of a table that have a position, at most `most`.

    Raises InputError where there are none.
    """
    rows = Table().scan(table)
    found = [
        FlightPhoto(path=row.path, truth=row.geotag)
        for row in rows
        if isinstance(row, ImageRecord) and row.geotag is not None and row.view == View.DRONE
    ]
    if not found:
        raise InputError(
            f"{table} has no photo with a position, expected columns path, lat and lon of the "
            "ground that each photo's middle shows; see docs/sources.md"
        )
    return found[:most]


def selection_of(table: str, most: int) -> str:
    """Which photos a table gives, in words; other rows give other words."""
    digest = hashlib.sha256(storage.read_bytes(table)).hexdigest()[:12]
    return f"{table} ({digest}), at most {most} photos, with and without the camera's tags"


def search_flight(
    photos: Sequence[FlightPhoto],
    encoder: PhotoEncoder,
    index: Index,
    gallery: GalleryMap,
    windows: MapWindows,
) -> list[SearchedPhoto]:
    """The candidates of each photo that can be decoded, in each of the WAYS. The location that it
    shows is the nearest gallery image's; a candidate is of elsewhere if no window around it shows
    the photo's ground."""
    truth = {photo.path: photo.truth for photo in photos}
    searched = []
    for way in WAYS:
        queries = encode_photos(list(truth), encoder, view_maker(windows.tile_sides_m(), way))
        decoded = [(one, one.views_VD) for one in queries if one.views_VD is not None]
        tags = [truth[query.name] for query, _ in decoded]
        found = search_near_and_away(
            index,
            [views_VD for _, views_VD in decoded],
            partial(_elsewhere, windows, tags),
            [query.level for query, _ in decoded],
        )
        for (query, _), tag, (hits, away) in zip(decoded, tags, found, strict=True):
            example = CalibrationExample(
                location=_nearest_location(gallery, tag),
                lat=tag.lat,
                lon=tag.lon,
                inside=tuple(hits[:TRACK_CANDIDATES]),
                outside=tuple(away[:TRACK_CANDIDATES]),
            )
            searched.append(SearchedPhoto(query=query, way=way, example=example))
    return searched


def _elsewhere(
    windows: MapWindows, tags: Sequence[GeoTag], number: int, hits: Sequence[Hit]
) -> list[Hit]:
    """The hits whose windows do not show the ground of photo `number`."""
    away_K = np.array([windows.apart_m(hit.side_m) for hit in hits])
    return hits_outside_radius(hits, tags[number].lat, tags[number].lon, away_K)


def _nearest_location(gallery: GalleryMap, tag: GeoTag) -> str:
    [row] = gallery.nearest(tag.lat, tag.lon, 1).tolist()
    return str(gallery.locations[row])


def match_flight(
    searched: Sequence[SearchedPhoto], windows: MapWindows, calibration: Calibration
) -> list[MatchedExample]:
    """Each photo matched around its candidates, and around those of elsewhere."""
    examples = []
    with progress(len(searched), "matching", "photos") as meter:
        contents = prefetch_map(read_photo, [one.query.name for one in searched], AHEAD, AHEAD)
        for one, data in zip(searched, contents, strict=True):
            if not isinstance(data, Rejection):  # else it was removed since it was embedded
                photo = matchable_photo(decode_photo(data), one.query.tags, one.way)
                example = one.example
                inside = _match(photo, example.inside, windows, calibration)
                outside = _match(
                    photo, example.outside, windows, calibration, _ground_of(example, windows)
                )
                examples.append(MatchedExample(searched=example, inside=inside, outside=outside))
            meter.advance()
    return examples


def _ground_of(example: CalibrationExample, windows: MapWindows) -> Circle | None:
    """Where windows show the ground of a photo."""
    if example.lat is None or example.lon is None:
        return None
    return Circle(lat=example.lat, lon=example.lon, radius_m=windows.apart_m(None))


def _match(
    photo: MatchablePhoto,
    hits: Sequence[Hit],
    windows: MapWindows,
    calibration: Calibration,
    away_from: Circle | None = None,
) -> Refinement | None:
    [answer] = answers_from_hits([hits], CONSENSUS_CANDIDATES, calibration)
    return refine_answer(answer, photo, windows, away_from)
