"""Photos of known places, located by a region: what can be expected of it."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from jobs.region.folder import Region
from jobs.stages.calibrate_flight import flight_of
from jobs.stages.locate import locate_photos
from jobs.stages.settings import LocateSettings
from pipeline.core.arrays import evenly_spaced
from pipeline.core.records import GeoTag, ImageRecord, View
from pipeline.features.table import open_table
from pipeline.index.searcher import Index
from pipeline.locate.geojson import LocatedPhoto
from pipeline.locate.page import distance_to_m
from pipeline.region.expectation import Expectation, Outcome, expect
from pipeline.region.lookalikes import Lookalike, find_lookalikes
from pipeline.sources.photos import Photos

LOOKALIKES, LOOKALIKE_ROWS, APART_TILES = 6, 1000, 3
"""Pairs on the page, gallery images that are searched for them, and sides of a tile that a pair is
at least apart."""


def located_outcomes(
    region: Region, surface: str | None, tables: Sequence[str], most: int
) -> list[Outcome]:
    """The photos of tables, at most `most` of each, located with and without their tags, against
    the truth."""
    photos = [photo for table in tables for photo in flight_of(table, most)]
    truths = {photo.path: photo.truth for photo in photos}
    return [
        outcome
        for posed, way in ((True, "with-tags"), (False, "without-tags"))
        for outcome in _locate(region, surface, truths, posed, way)
    ]


def real_photos(region: Region, surface: str | None, folder: str | None) -> Expectation | None:
    """The UAV's own photos, located and compared with their GPS; None where they have none."""
    if not folder:
        return None
    source = Photos(location="file", project=True)
    truths = {
        record.path: record.geotag
        for record in source.scan(folder)
        if isinstance(record, ImageRecord) and record.geotag is not None
    }
    if not truths:
        return None
    outcomes = _locate(region, surface, truths, True, "photos")
    return expect("your photos, against their GPS", outcomes)


def _locate(
    region: Region, surface: str | None, truths: Mapping[str, GeoTag], posed: bool, name: str
) -> list[Outcome]:
    """Photos located by the region, against the truth by their paths; the answers and their page
    lie in its folder."""
    settings = LocateSettings(
        photos=tuple(truths), checkpoint=region.encoder, index=region.index, shards=region.tiles,
        surface=surface, pose=posed, out=region.path("expect", f"{name}.geojson"),
        page=region.path("expect", f"{name}.html"),
    )  # fmt: skip
    located = locate_photos(settings, {path: (tag.lat, tag.lon) for path, tag in truths.items()})
    return [outcome_of(one, truths[one.name], posed) for one in located]


def outcome_of(one: LocatedPhoto, truth: GeoTag, posed: bool) -> Outcome:
    """An answer against the truth."""
    answer = one.answer
    error_m = distance_to_m(answer, (truth.lat, truth.lon)) if answer else None
    return Outcome(
        name=one.name,
        error_m=math.inf if error_m is None else error_m,
        known=answer is not None and answer.known,
        probability=answer.probability if answer else None,
        within_m=answer.within_m if answer else None,
        refined=answer is not None and answer.refinement is not None,
        posed=posed,
        height_m=math.nan if truth.altitude_m is None else truth.altitude_m,
        pitch_deg=math.nan if truth.pitch_deg is None else truth.pitch_deg,
    )


def lookalikes(region: Region, tile_sides_m: Sequence[float]) -> list[Lookalike]:
    """Pairs of tiles that resemble each other and show no common ground."""
    index = Index(region.index)
    table = open_table(region.table).select(None, View.SATELLITE)
    labels = table.labels()
    rows = evenly_spaced(table.rows, LOOKALIKE_ROWS)
    positions_N2 = np.stack([labels.lats, labels.lons], axis=1)[rows]
    return find_lookalikes(
        index, [str(key) for key in labels.keys[rows]], positions_N2, table.embeddings()[rows],
        apart_m=max(APART_TILES * tile_sides_m[0], tile_sides_m[-1]), count=LOOKALIKES,
    )  # fmt: skip
