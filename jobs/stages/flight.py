"""Photos of one flight -> answers given all of them: the part of jobs/locate.py behind --track.

In: embedded photos of any storage, an index with its calibration, and the map's pixels where they
are at hand. Each photo is searched and matched by itself first. The track passes through refined
places and tiles; a photo that it puts at a tile is matched there, and the track is found once more.
"""

from collections.abc import Sequence
from dataclasses import replace

from jobs.encoding.queries import Query
from jobs.stages.matching import match_photos
from jobs.stages.settings import LocateSettings
from pipeline.core.errors import InputError
from pipeline.core.filters import Filter
from pipeline.index.searcher import Index
from pipeline.locate.calibration import Calibration
from pipeline.locate.flight import PhotoFacts, apply_track, motion_for_gallery
from pipeline.locate.gallery_map import GalleryMap
from pipeline.locate.locate import Answer, answers_from_hits, search_views
from pipeline.locate.odometry import Travelled, read_odometry
from pipeline.locate.photo_files import parse_time, read_times
from pipeline.locate.refined import refine_at, with_refinement
from pipeline.locate.track import TRACK_CANDIDATES, TrackStart
from pipeline.matching.map_windows import MapWindows
from pipeline.matching.photo_pose import pose_of_photo
from pipeline.matching.refine import Refinement


def search_queries(
    queries: Sequence[Query],
    index: Index,
    gallery: GalleryMap,
    calibration: Calibration | None,
    k: int,
    where: Filter | None,
) -> list[Answer]:
    """One answer per query, by tiles, with its `k` best candidates."""
    decoded = [(one.views_VD, one.level) for one in queries if one.views_VD is not None]
    views, levels = [views_VD for views_VD, _ in decoded], [level for _, level in decoded]
    hits = search_views(index, views, k, where, levels)
    found = answers_from_hits(hits, k, calibration, gallery.spacing_m, gallery.finest_side_m)
    pairs = zip(queries, found, strict=True)
    return [replace(answer, framing=query.framing) for query, answer in pairs]


def locate_flight(
    queries: Sequence[Query],
    index: Index,
    gallery: GalleryMap,
    calibration: Calibration,
    windows: MapWindows | None,
    settings: LocateSettings,
) -> list[Answer]:
    """One answer per query, given the whole flight, or with --online given the photos up to it.

    Without a gate in the calibration, nobody knows how probably a refinement is right: the track
    goes by tiles alone then, and its photos are matched where it puts them.
    """
    k = max(settings.top, TRACK_CANDIDATES)
    answers = search_queries(queries, index, gallery, calibration, k, None)
    facts = _facts(queries, settings)
    gated = windows is not None and calibration.matching is not None
    if windows and gated:
        found = match_photos(queries, answers, windows, settings)
        facts = _with_refinements(facts, found, calibration)
    tracked = _track(queries, answers, facts, gallery, calibration, settings)
    if windows is None:
        return tracked
    # At these the path takes a tile, although the photo was perhaps matched elsewhere.
    at_tiles = [
        number
        for number, answer in enumerate(tracked)
        if answer.position is not None and answer.position.how == "track"
    ]
    found = match_photos(
        [queries[number] for number in at_tiles],
        [tracked[number] for number in at_tiles],
        windows,
        settings,
        refine_at,
    )
    if not gated:
        for number, refinement in zip(at_tiles, found, strict=True):
            tracked[number] = with_refinement(
                tracked[number], refinement, calibration, of_flight=True
            )
        return tracked
    again = _with_refinements([facts[number] for number in at_tiles], found, calibration)
    for number, one in zip(at_tiles, again, strict=True):
        facts[number] = one
    return _track(queries, answers, facts, gallery, calibration, settings)


def _track(
    queries: Sequence[Query],
    answers: Sequence[Answer],
    facts: Sequence[PhotoFacts],
    gallery: GalleryMap,
    calibration: Calibration,
    settings: LocateSettings,
) -> list[Answer]:
    near = settings.near
    start = TrackStart(lat=near.lat, lon=near.lon, radius_m=near.radius_m) if near else None
    motion = motion_for_gallery(gallery, settings.max_speed, settings.elsewhere)
    times_s = _times_s(queries)
    return apply_track(answers, times_s, calibration, motion, start, facts, settings.online)


def _times_s(queries: Sequence[Query]) -> list[float]:
    return [parse_time(query.taken_at or "0") for query in queries]


def _facts(queries: Sequence[Query], settings: LocateSettings) -> list[PhotoFacts]:
    """What tags and tables say of each photo."""
    ways: list[Travelled | None] = [None] * len(queries)
    if settings.odometry:
        times_s = _times_s(queries)
        order = sorted(range(len(queries)), key=lambda number: times_s[number])
        names = [queries[number].name for number in order]
        for number, way in zip(order, read_odometry(settings.odometry, names), strict=True):
            ways[number] = way
    # The size of the photo is about its lens, which plays no part here.
    return [
        PhotoFacts(pose=pose_of_photo(query.tags, (1, 1), settings), travelled=way)
        for query, way in zip(queries, ways, strict=True)
    ]


def _with_refinements(
    facts: Sequence[PhotoFacts], found: Sequence[Refinement | None], calibration: Calibration
) -> list[PhotoFacts]:
    """The facts with those refinements that the gate lets pass; others stay as they are."""
    gate = calibration.matching.gate if calibration.matching else None
    return [
        replace(one, refinement=refinement)
        if refinement is not None and gate is not None and gate.admits(refinement)
        else one
        for one, refinement in zip(facts, found, strict=True)
    ]


def with_times(queries: Sequence[Query], settings: LocateSettings) -> list[Query]:
    """The queries with their times: from the table, else by the interval, else from the cameras'
    tags.

    Raises InputError where the time of one is not known.
    """
    names = [query.name for query in queries]
    if settings.times:
        times = read_times(settings.times, names)
    elif settings.interval:
        times = {name: str(at * settings.interval) for at, name in enumerate(sorted(names))}
    else:
        times = {query.name: query.taken_at for query in queries if query.taken_at is not None}
    unknown = [name for name in names if name not in times]
    if unknown:
        raise InputError(
            f"{len(unknown)} of {len(names)} photos have no time in their tags, {unknown[0]} among "
            "them; expected times for --track; give --times TABLE or --interval SECONDS"
        )
    return [
        replace(query, tags=replace(query.tags, taken_at=times[query.name])) for query in queries
    ]
